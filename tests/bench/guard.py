"""kill -9 at random moments of motion, without a watchdog in the drives: when the table rests, if its power is off.

The twins are in this process, the station is in another, with real sockets and pseudo-terminals between them. The true
motion is that of the twin's model, not what the station or a controller says.

    python tests/bench/guard.py --times 40                      by turns on modbus, rtu, galil and acutrol
    python tests/bench/guard.py --times 40 --without-guard      the guard is killed first: as it was before it was built
    python tests/bench/guard.py --times 12 --without-guard --watchdog 1   the drives' own watchdog alone
    python tests/bench/guard.py --times 10 --kill group         everything in the station's process group
    python tests/bench/guard.py --times 10 --kill hosted        a session as the operator's screen starts it
    python tests/bench/guard.py --times 10 --kill stopped       the guard has been stopped (SIGSTOP) before
    python tests/bench/guard.py --times 10 --kill held          nobody reads what station and guard write to stderr
    python tests/bench/guard.py --times 10 --kill forked        a child of the station's has its end of the guard's pipe
    python tests/bench/guard.py --times 10 --table BINARY       against a table of others, which logs its motion

A table has to be at rest within its braking time, from the rate that it had, and one second; without a guard also the
time of its watchdog.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol

from support import command

from drivers.links.reopen import reopen
from station.bench.bench import default_bench_text, load_bench
from station.opening import open_bench, with_links
from station.opening.serving import Serving
from station.opening.twins import Twins
from station.run.event_loop.loops import ScaledLoop
from station.run.guard.guard import guard_log_of

_DATA = Path(__file__).parents[1] / "data" / "benches"
_EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
_ACCELERATION_RPS2 = math.radians(50)  # of all the tables here, also when they brake
_GRACE_S, _WAIT_S = 1.0, 20.0
_LOOK_S = 0.002
KILLS = ("process", "group", "hosted", "stopped", "held", "forked")
_FORKS_ON_SIGNAL = """
import os, signal, time

def fork(number, frame):
    if os.fork() == 0:
        time.sleep(60)
        os._exit(0)

signal.signal(signal.SIGUSR1, fork)
"""
"""A plug-in that has the station fork a child without ``exec``, as ``multiprocessing`` may."""
USUAL = ("modbus", "rtu", "galil", "acutrol")
AXES = {"numbered": "z", "aerosmith": "z"}


def script_of(axes: str, turn_s: float) -> str:
    """Return a script that turns each axis at 40 deg/s for so long."""
    turn = 'kind = "rotate"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\n'
    steps = [f'[[step]]\n{turn}axis = "{axis}"\nduration = "{turn_s} s"\n' for axis in axes]
    return '[[step]]\nkind = "rest"\nduration = "0.5 s"\n' + "".join(steps)


def bench_text(protocol: str, watchdog_s: float) -> str:
    """Return a bench with a table of this protocol whose drives watch for their master's silence (0: they do not)."""
    if protocol == "modbus":
        text = default_bench_text().replace('watchdog = "0 s"', "")
    elif protocol == "rtu":
        text = (_DATA / "rtu_stim300.toml").read_text().replace("100 Hz", "125 Hz")
    elif protocol == "acutrol":
        text = (_DATA / "acutrol_vectornav.toml").read_text()
    else:
        text = (_DATA / "galil_xsens.toml").read_text()
    if protocol in AXES:
        begins, ends = text.index("[table]"), text.index("[[imu]]")
        limits = '[table.z]\nmax_rate = "100 deg/s"\nmax_acceleration = "50 deg/s2"\n'
        text = f'{text[:begins]}[table]\nprotocol = "{protocol}"\ngimbals = ["z"]\n{limits}\n{text[ends:]}'
        text = text.replace('start = ["3 deg", "-2 deg", "1.5 deg"]', 'start = ["0 deg"]')
    if protocol == "numbered":
        text = f'plugins = ["{_EXAMPLES / "numbered_table.py"}"]\n{text}'
    return text.replace("[twin]\n", f'[twin]\nwatchdog = "{watchdog_s} s"\n')


class Table(Protocol):
    """A table whose true motion is known."""

    bench: Path
    links: dict[str, str]

    def turning(self) -> bool:
        """Whether an axis turns now, in truth."""

    def fastest_rps(self) -> float:
        """Return the highest rate of an axis now, or the highest that there can be."""


class TwinTable:
    """Twins in this process."""

    def __init__(self, bench: Path, twins: Twins, links: dict[str, str]) -> None:
        self.bench, self._model, self.links = bench, twins.table, links

    def turning(self) -> bool:
        return not self._model.at_rest()

    def fastest_rps(self) -> float:
        return max(abs(self._model.rate_rps(axis)) for axis in self._model.motion)


class TableOfOthers:
    """A table in a process of its own that writes a line each time its motion begins or ends."""

    def __init__(self, bench: Path, links: dict[str, str], motion: Path) -> None:
        self.bench, self.links, self._motion = bench, links, motion

    def turning(self) -> bool:
        lines = self._motion.read_text().splitlines() if self._motion.exists() else []
        return bool(lines) and lines[-1].endswith("moves")

    def fastest_rps(self) -> float:
        return math.radians(40)


@asynccontextmanager
async def twin_table(protocol: str, folder: Path, watchdog_s: float) -> AsyncIterator[Table]:
    """Serve the twins of a bench, the first IMU and the table."""
    path = folder / f"{protocol}.toml"
    path.write_text(bench_text(protocol, watchdog_s), encoding="utf-8")
    bench = load_bench(path)
    async with AsyncExitStack() as stack:
        twins = Twins(bench, stack, 1.0)
        serving = Serving(twins, stack, "127.0.0.1")
        imu = bench.imus[0]
        links = {"table": str((await serving.table(0))["link"])}
        links[imu.name] = str((await serving.imu(imu))["link"])
        yield TwinTable(path, twins, links)


_BENCH_OF_OTHERS = """
[table]
protocol = "modbus"
gimbals = ["z", "y", "x"]
""" + "".join(
    f"""
[table.{axis}]
unit_id = {unit}
counts_per_turn = {counts}
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
"""
    for unit, axis, counts in ((1, "x", 65536), (2, "y", 1296000), (3, "z", 8388608))
)


@asynccontextmanager
async def table_of_others(binary: str, folder: Path, watchdog_s: float) -> AsyncIterator[Table]:
    """Start a CiA 402 table with a STIM300 on it, of which only the command line is known."""
    path, motion = folder / "others.toml", folder / "motion.log"
    text = (_DATA / "rtu_stim300.toml").read_text()
    path.write_text(_BENCH_OF_OTHERS + text[text.index("[[imu]]") : text.index("[undeclared]")], encoding="utf-8")
    ports = [_free_port(), _free_port()]
    words = ["--port", ports[0], "--stimtcp", ports[1], "--answer", "--cycle", 0.002, "--motion", motion]
    process = subprocess.Popen(
        [binary, *map(str, words), "--watchdog", str(watchdog_s), "--qs-auto"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdout is not None
    for _ in ports:
        process.stdout.readline()
    links = {"table": f"tcp://127.0.0.1:{ports[0]}", "stim300": f"tcp://127.0.0.1:{ports[1]}"}
    try:
        yield TableOfOthers(path, links, motion)
    finally:
        process.kill()
        process.wait()


def _free_port() -> int:
    with socket.socket() as asked:
        asked.bind(("127.0.0.1", 0))
        return int(asked.getsockname()[1])


@dataclass(frozen=True, slots=True, kw_only=True)
class Kill:
    """What one kill left. ``rest_s``: when the table was at rest after it, infinity if not within 20 s."""

    protocol: str
    after_s: float
    """From the first motion."""
    rate_dps: float
    rest_s: float
    limit_s: float
    energised: str
    """Axes whose power is on, seen by a driver of our own when all is over."""
    guard_mb: float
    """Resident memory of the guard before the kill, NaN without one."""
    guard_cpu_s: float
    """Processor time of the guard until the kill, its start included."""
    log: str

    @property
    def good(self) -> bool:
        return self.rest_s <= self.limit_s and not self.energised


def guards_of(pid: int) -> list[int]:
    """Return the guard processes of a station."""
    found = []
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        with suppress(OSError):
            if b"station.run.guard" in Path(f"/proc/{child}/cmdline").read_bytes():
                found.append(int(child))
    return found


def alive(pid: int) -> bool:
    """Return whether a process runs; one that has ended and waits to be looked at does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def fill(pipe: int) -> None:
    """Write to a pipe until it takes no more: whoever writes to it then waits for a reader."""
    os.set_blocking(pipe, False)
    with suppress(BlockingIOError):
        while True:
            os.write(pipe, b" ")
    os.set_blocking(pipe, True)


async def forked(pid: int) -> int:
    """Have a station that loaded ``_FORKS_ON_SIGNAL`` fork; return the child's number."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    before = set(children.read_text().split())
    os.kill(pid, signal.SIGUSR1)
    while not (new := set(children.read_text().split()) - before):
        await asyncio.sleep(_LOOK_S)
    return int(new.pop())


def cost_of(pid: int) -> tuple[float, float]:
    """Return resident megabytes, and seconds of processor time."""
    status = Path(f"/proc/{pid}/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS"))
    times = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return int(resident.split()[1]) / 1024, sum(map(int, times)) / os.sysconf("SC_CLK_TCK")


async def kill_once(
    protocol: str,
    table: Table,
    folder: Path,
    after_s: float,
    *,
    how: str = "process",
    guarded: bool = True,
    watchdog_s: float = 0.0,
    recording: Path | None = None,
) -> Kill:
    """Start a run, kill it ``after_s`` after the table first turns, as soon as it turns then, and watch the table.

    ``watchdog_s`` is added to the time that the table may take.
    """
    script, recording = folder / "script.toml", recording or folder / f"{random.randrange(1 << 60)}.h5"
    axes = AXES.get(protocol, "xyz")
    script.write_text(script_of(axes, 18.0 / len(axes)))
    (imu,) = [name for name in table.links if name != "table"]
    options = [word for name, link in table.links.items() for word in ("--link", f"{name}={link}")]
    words: list[str | Path] = ["run", "--bench", table.bench, *options, "--device", imu]
    words += ["--script", script, "-o", recording, "--json", *(["--host"] if how == "hosted" else [])]
    if how == "forked":
        plugin = folder / "forks.py"
        plugin.write_text(_FORKS_ON_SIGNAL)
        words += ["--plugin", plugin]
    said = folder / "said"
    unread, stderr = os.pipe()
    with said.open("wb") as output:
        errors = stderr if how == "held" else output
        run = subprocess.Popen(command(*words), stdout=output, stderr=errors, start_new_session=True)
    child = 0

    async def until_turning() -> None:
        while not table.turning():
            if run.poll() is not None:
                raise RuntimeError(f"the run ended by itself with {run.returncode}: {said.read_text()[-300:]}")
            await asyncio.sleep(_LOOK_S)

    try:
        await until_turning()
        await asyncio.sleep(after_s)
        await until_turning()
        guards = guards_of(run.pid)
        cost = cost_of(guards[0]) if guards else (math.nan, math.nan)
        if not guarded:
            run.send_signal(signal.SIGSTOP)  # or it would start another
            for pid in guards:
                os.kill(pid, signal.SIGKILL)
        if how == "stopped":
            for pid in guards:
                os.kill(pid, signal.SIGSTOP)
        elif how == "held":
            fill(stderr)
        elif how == "forked":
            child = await forked(run.pid)
        rate_rps = table.fastest_rps()
        killed = time.monotonic()
        if how == "group":
            os.killpg(run.pid, signal.SIGKILL)
        else:
            run.kill()
    finally:
        if run.poll() is None:
            run.kill()
        run.wait()
    while table.turning() and time.monotonic() < killed + _WAIT_S:
        await asyncio.sleep(_LOOK_S)
    rest_s = math.inf if table.turning() else time.monotonic() - killed
    for pid in guards:
        while alive(pid) and time.monotonic() < killed + 90:
            await asyncio.sleep(0.01)
    for end in (unread, stderr):
        os.close(end)
    if child:
        os.kill(child, signal.SIGKILL)
    log = guard_log_of(recording)
    return Kill(
        protocol=protocol,
        after_s=round(after_s, 3),
        rate_dps=round(math.degrees(rate_rps), 2),
        rest_s=round(rest_s, 3),
        limit_s=round(rate_rps / _ACCELERATION_RPS2 + _GRACE_S + watchdog_s, 3),
        energised=", ".join(await energised(table, imu)),
        guard_mb=round(cost[0], 1),
        guard_cpu_s=cost[1],
        log=log.read_text().splitlines()[-1] if log.exists() else "",
    )


async def energised(table: Table, imu: str) -> list[str]:
    """Ask the controller itself which axes have power."""
    bench = with_links(load_bench(table.bench), table.links, [imu])
    async with open_bench(bench) as opened:
        await reopen(opened.table)  # the controller may take a moment after the guard has gone
        found = [axis for axis in opened.table.limits if (await opened.table.status(axis)).enabled]
        opened.table.close()
    return found


async def campaign(arguments: argparse.Namespace) -> list[Kill]:
    chance = random.Random(arguments.seed)
    kills: list[Kill] = []
    protocols = ["others"] if arguments.table else arguments.protocols.split(",")
    while len(kills) < arguments.times:
        protocol = protocols[len(kills) % len(protocols)]
        with tempfile.TemporaryDirectory() as folder:
            if arguments.table:
                made = table_of_others(arguments.table, Path(folder), arguments.watchdog)
            else:
                made = twin_table(protocol, Path(folder), arguments.watchdog)
            async with made as table:
                after_s = chance.uniform(0.0, 12.0)
                guarded = not arguments.without_guard
                try:
                    kill = await kill_once(
                        protocol,
                        table,
                        Path(folder),
                        after_s,
                        how=arguments.kill,
                        guarded=guarded,
                        watchdog_s=0.0 if guarded else arguments.watchdog,
                    )
                except RuntimeError as error:  # nobody was killed, so this shows nothing
                    print(error, flush=True)
                    continue
        kills.append(kill)
        print(json.dumps(asdict(kill) | {"good": kill.good}), flush=True)
    return kills


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=8)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--protocols", default=",".join(USUAL), help="also numbered, a plug-in, and aerosmith")
    parser.add_argument("--table", metavar="BINARY", help="a table of others, in place of twins")
    parser.add_argument("--watchdog", type=float, default=0.0, help="of the drives, in s")
    parser.add_argument("--kill", choices=KILLS, default="process")
    parser.add_argument("--without-guard", action="store_true")
    arguments = parser.parse_args()
    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        kills = runner.run(campaign(arguments))
    good = sum(kill.good for kill in kills)
    cpu_s, load = max(kill.guard_cpu_s for kill in kills), os.getloadavg()[0]
    over_s = max(kill.rest_s - kill.limit_s + _GRACE_S for kill in kills)
    memory = max(kill.guard_mb for kill in kills)
    print(
        f"{good} of {len(kills)} at rest within braking time (+ watchdog) + {_GRACE_S:g} s, without power; "
        f"at the latest {over_s:.2f} s after the braking time; guard: at most {memory} MB resident, "
        f"{cpu_s:.2f} s of processor time with its start; load {load:.1f}"
    )
    return 0 if good == len(kills) else 1


if __name__ == "__main__":
    sys.exit(main())
