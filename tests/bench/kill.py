"""kill -9 at any time of a run against twins in another process: what is recovered, and what is lost.

Kills are uniform over the whole script, the paper's of 360 s unless another is given. Each has twins of its own. A
listener of our own on the CAN bus keeps every sample that was sent, with the instant at which the kernel had it. After
each kill:

- the recording is opened, and the journal beside it is used: it is gone then;
- no sample is missing that was on the bus 20 ms before the kill or earlier, by the clock of the host at every scale;
- a copy whose HDF5 file is cut at a random byte gives the same samples: the journal alone is enough;
- the table comes to rest: the guard stops it, for the drives of the twins have no watchdog.

It ends with 1 if any of that was missed. What a busy machine costs is its own: the load is printed beside each figure.

    python tests/bench/kill.py --times 200 --scale 10
    python tests/bench/kill.py --times 20 --scale 1 --at-once 2
"""

from __future__ import annotations

import argparse
import asyncio
import difflib
import json
import logging
import math
import os
import random
import shutil
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import msgpack
import numpy as np
from numpy.typing import NDArray
from pymodbus.client import AsyncModbusTcpClient
from support import TwinProcess, command

from estimator.errors import RecordingError
from estimator.recordings.journal import journal_of
from estimator.recordings.recovery import recover
from estimator.recordings.safe_open import probe
from station.bench.bench import default_bench_text
from station.scripts.script import load_script, paper_script

SCRIPT = """
[[step]]
kind = "rest"
duration = "1 s"
""" + "".join(
    f"""
[[step]]
kind = "rotate"
axis = "{axis}"
rate = "40 deg/s"
acceleration = "40 deg/s2"
duration = "10 s"
"""
    for axis in "xyz"
)
"""Turns from its beginning on."""
RATE = 0x3B00  # Kinco map
AT_REST_WITHIN_S = 6.0
RAW_RPS = math.radians(0.005)  # of the bus
REACH_S = 0.02
GYROS = range(0x101, 0x105)
_SO_TIMESTAMPNS = 35
_SAME, _WINDOW = 12, 300  # samples in a row that are not the same by chance; compared at once where some differ


@dataclass(frozen=True, slots=True, kw_only=True)
class Kill:
    """What one kill left."""

    after_s: float
    """Since the script began, by the clock of the host."""
    load: float
    """Load average of the machine at the kill."""
    turning: bool
    at_rest: bool
    had_journal: bool
    used_journal: bool
    opened: bool
    torn_opened: bool
    """Whether the copy with the torn HDF5 file has as many samples."""
    outcome: str
    live_s: float
    """How long before its last sample the live filter's rows end, in seconds of the run; nan if there are none."""
    sent: int
    """Samples on the bus while it recorded, all gyros, that were due: there ``reach_s`` before the kill."""
    lost: int
    """Of those that were due, how many came after the last that is in the recording."""
    missed: int
    """How many are not in the recording though later ones are: an overloaded computer drops frames of its bus."""
    told_lost: int
    """How many of these the recording itself says are lost."""
    gaps_s: list[float]
    """How long before the kill those that are lost were on the bus, the last of them."""
    lost_s: float
    """How long before the kill the first sample was on the bus after the last recorded one, the worst of the gyros."""


class Listener:
    """Keeps the raw rates that are sent on a CAN bus by multicast, with the instants at which the kernel had them."""

    def __init__(self, link: str) -> None:
        address, _, query = link.removeprefix("can:udp_multicast:").partition("?")
        self._bus = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        for option in (socket.SO_REUSEADDR, socket.SO_REUSEPORT, _SO_TIMESTAMPNS):
            self._bus.setsockopt(socket.SOL_SOCKET, option, 1)
        self._bus.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
        self._bus.bind(("", int(query.partition("port=")[2].partition("&")[0])))
        group = socket.inet_aton(address) + struct.pack("@I", socket.INADDR_ANY)
        self._bus.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        self._bus.settimeout(0.2)
        self._frames: deque[tuple[bytes, bytes]] = deque()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._ended.is_set():
            try:
                frame, ancillary, _, _ = self._bus.recvmsg(512, 64)
            except TimeoutError:
                continue
            self._frames.append((frame, ancillary[0][2]))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.close()

    def sent(self) -> dict[int, tuple[NDArray[np.float64], NDArray[np.int64]]]:
        """Return the times (s, UTC) and the raw rates of each gyro."""
        found: dict[int, list[tuple[float, int]]] = {gyro: [] for gyro in GYROS}
        for frame, stamp in self._frames:
            message = msgpack.unpackb(frame)
            if message["arbitration_id"] in found:
                seconds, nanoseconds = struct.unpack("@ll", stamp)
                raw = int.from_bytes(message["data"], "little", signed=True)
                found[message["arbitration_id"]].append((seconds + nanoseconds * 1e-9, raw))
        return {
            gyro: (np.array([at for at, _ in frames]), np.array([raw for _, raw in frames], dtype=np.int64))
            for gyro, frames in found.items()
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """What of one gyro's samples on the bus is in a recording."""

    due: int
    gaps_s: NDArray[np.float64]
    """Of those due that came after the last recorded one, how long before the kill they were sent."""
    missed: int
    """Not recorded though later ones are: they never reached the run, or it could not keep them."""
    lost_s: float
    """How long before the kill the first was sent that came after the last recorded one."""


def compared(
    sent: tuple[NDArray[np.float64], NDArray[np.int64]], there: NDArray[np.int64], killed_at: float, reach_s: float
) -> Compared:
    """Compare what was sent with what is there; ``killed_at`` UTC (s), due is what was sent ``reach_s`` before."""
    at_s, raw = sent
    # Where the recording began on the bus; this listener may have missed a frame of the first twenty itself.
    found = [(at, begins) for at in range(0, 200, 20) for begins in _places(raw, there[at : at + 20])[:1]]
    skipped, first = found[0] if found else (0, 0)
    at_s, raw, there = at_s[first:], raw[first:], there[skipped:]
    kept = _kept(raw, there)
    last_kept = int(np.flatnonzero(kept)[-1]) if kept.any() else -1
    is_end = np.arange(len(raw)) > last_kept
    end_s = at_s[is_end & (at_s <= killed_at)]
    due = at_s <= killed_at - reach_s
    return Compared(
        due=int(due.sum()),
        gaps_s=killed_at - at_s[due & is_end],
        missed=int((~kept & ~is_end).sum()),
        lost_s=float(killed_at - end_s[0]) if len(end_s) else 0.0,
    )


def _kept(sent: NDArray[np.int64], there: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of the values sent are there, in the same order."""
    kept = np.zeros(len(sent), dtype=bool)
    i = j = 0
    while i < len(sent) and j < len(there):
        length = min(len(sent) - i, len(there) - j)
        differ = np.flatnonzero(sent[i : i + length] != there[j : j + length])
        same = int(differ[0]) if len(differ) else length
        kept[i : i + same] = True
        i, j = i + same, j + same
        if not len(differ):
            break
        few = [row[at : at + _WINDOW].tolist() for row, at in ((sent, i), (there, j))]
        blocks = difflib.SequenceMatcher(None, *few, autojunk=False).get_matching_blocks()
        if 2 * sum(block.size for block in blocks) >= min(map(len, few)):
            for block in blocks:
                kept[i + block.a : i + block.a + block.size] = True
            last = [block for block in blocks if block.size][-1]
            i, j = i + last.a + last.size, j + last.b + last.size
            continue
        places = _places(sent[i:], there[j : j + _SAME])  # a long gap
        if len(places):
            i += int(places[0])
        else:
            j += 1
    return kept


def _places(row: NDArray[np.int64], few: NDArray[np.int64]) -> NDArray[np.intp]:
    """Return where a few values in a row occur."""
    if not len(few) or len(row) < len(few):
        return np.zeros(0, dtype=np.intp)
    return np.flatnonzero((np.lib.stride_tricks.sliding_window_view(row, len(few)) == few).all(axis=1))


def watched_bench(folder: Path) -> Path:
    """Write the built-in bench with drives that stop when their master falls silent; return where."""
    path = folder / "watched.toml"
    path.write_text(default_bench_text().replace('watchdog = "0 s"', 'watchdog = "1 s"'), encoding="utf-8")
    return path


def kill_once(
    twin: TwinProcess,
    path: Path,
    script: Path | None,
    after_s: float,
    reach_s: float = REACH_S,
    *,
    scale: float = 1.0,
    chance: random.Random | None = None,
) -> Kill:
    """Start a run, kill it ``after_s`` after its script began, and look at what is left.

    RuntimeError if the run ended by itself before.
    """
    listener = Listener(twin.links["array"])
    speed = ["--scale", str(scale)] if scale != 1 else []
    steps = ["--script", str(script)] if script else []
    run = subprocess.Popen(
        command("run", *twin.options("table", "array"), *speed, *steps, "-o", path, "--json"),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        _await_script(run, journal_of(path))
        time.sleep(after_s)
        _still_runs(run)
        killed_at = time.time()
    finally:
        run.kill()
        run.wait()
        if run.stdout is not None:
            run.stdout.close()
    load = os.getloadavg()[0]
    turning = not table_at_rest(twin.links["table"])
    listener.close()
    at_rest = _comes_to_rest(twin.links["table"])
    torn = shutil.copytree(path.parent, path.parent / "torn", ignore=shutil.ignore_patterns("torn")) / path.name
    if torn.exists():
        os.truncate(torn, (chance or random).randrange(torn.stat().st_size))
    had_journal = journal_of(path).exists()
    opened, outcome, rates, live_s, told_lost = _opened(path)
    if opened and outcome != "ABORTED":
        raise RuntimeError(f"the run had ended by itself: {outcome}")
    found = [
        compared(sent, np.rint(there / RAW_RPS).astype(np.int64), killed_at, reach_s)
        for sent, there in zip(listener.sent().values(), rates, strict=False)
    ]
    gaps_s = np.concatenate([each.gaps_s for each in found]) if found else np.zeros(0)
    torn_rates = _opened(torn)[2] if had_journal else rates
    return Kill(
        after_s=round(after_s, 3),
        load=load,
        turning=turning,
        at_rest=at_rest,
        had_journal=had_journal,
        used_journal=had_journal and not journal_of(path).exists(),
        opened=opened,
        torn_opened=list(map(len, torn_rates)) == list(map(len, rates)) and opened,
        outcome=outcome,
        live_s=round(live_s, 2),
        sent=sum(each.due for each in found),
        lost=len(gaps_s),
        missed=sum(each.missed for each in found),
        told_lost=told_lost,
        gaps_s=sorted(set(gaps_s.round(2).tolist()))[-20:],
        lost_s=round(max((each.lost_s for each in found), default=math.inf), 4),
    )


def _await_script(run: subprocess.Popen[str], journal: Path) -> None:
    """Wait until the journal says that the script has begun."""
    seen = 0
    while True:
        _still_runs(run)
        if journal.exists():
            with journal.open("rb") as file:
                file.seek(max(seen - 100, 0))
                block = file.read()
                seen = file.tell()
            if b"script begins" in block:
                return
        time.sleep(0.01)


def _still_runs(run: subprocess.Popen[str]) -> None:
    if run.poll() is not None:
        said = run.stdout.read() if run.stdout is not None else ""
        raise RuntimeError(f"the run ended by itself with {run.returncode}: {said[:200]}")


def _opened(path: Path) -> tuple[bool, str, list[NDArray[np.float64]], float, int]:
    """Open a recording as a user does; return if that could be done, its outcome, rates by gyro, live_s, told_lost."""
    try:
        recover(path)
        probe(path)  # reads the whole file in a process of its own
        with h5py.File(path) as file:
            rates = [source["rate_rps"][:, 0] for source in file["imu"].values()]
            ends_ns = {name: source["t_ns"][-1] for name, source in file["imu"].items()}
            live = [ends_ns[name] - group["t_ns"][-1] for name, group in file.get("innovation", {}).items()]
            told_lost = sum(int(source.attrs.get("lost", 0)) for source in file["imu"].values())
            return True, str(file.attrs["outcome"]), rates, float(max(live, default=math.nan)) * 1e-9, told_lost
    except (RecordingError, OSError, KeyError) as error:
        print(f"not opened: {error}", flush=True)
        return False, "", [], math.nan, 0


def _comes_to_rest(link: str) -> bool:
    """Return whether the table comes to rest within ``AT_REST_WITHIN_S``."""
    give_up_s = time.monotonic() + AT_REST_WITHIN_S
    while not table_at_rest(link):
        if time.monotonic() > give_up_s:
            return False
        time.sleep(0.1)
    return True


def table_at_rest(link: str) -> bool:
    """Ask the table's drives by a client of our own whether they turn."""
    host, port = link.removeprefix("tcp://").split(":")

    async def ask() -> bool:
        client = AsyncModbusTcpClient(host, port=int(port), timeout=1, reconnect_delay=0)
        await client.connect()
        rates = [(await client.read_holding_registers(RATE, count=2, device_id=u)).registers for u in (1, 2, 3)]
        client.close()
        return all(rate == [0, 0] for rate in rates)

    return asyncio.run(ask())


def one_of_many(folder: Path, arguments: argparse.Namespace, chance: random.Random) -> Kill | None:
    """Kill one run at an instant of its script; None, told, if it ended by itself before."""
    script = load_script(arguments.script) if arguments.script else paper_script()
    after_s = chance.uniform(0.0, script.least_s) / arguments.scale
    folder.mkdir()
    speed = ["--scale", str(arguments.scale)] if arguments.scale != 1 else []
    try:
        with TwinProcess(*speed) as twin:
            kill = kill_once(twin, folder / "run.h5", arguments.script, after_s, scale=arguments.scale, chance=chance)
    except (RuntimeError, OSError, subprocess.SubprocessError) as error:
        print(f"no kill at {after_s:.1f} s: {error}", flush=True)
        return None
    finally:
        if not arguments.keep:
            shutil.rmtree(folder, ignore_errors=True)
    print(json.dumps(asdict(kill)), flush=True)
    return kill


def report(kills: list[Kill]) -> bool:
    """Print the figures of a campaign; return whether every bar was met."""
    n = len(kills)
    journals = sum(kill.had_journal for kill in kills)
    lost_ms = np.array([kill.lost_s for kill in kills]) * 1e3
    figures = {
        "opened": (sum(kill.opened for kill in kills), n),
        "journal used": (sum(kill.used_journal for kill in kills), journals),
        "opened from the journal alone": (sum(kill.torn_opened for kill in kills), n),
        f"no sample lost older than {REACH_S * 1e3:.0f} ms": (sum(kill.lost == 0 for kill in kills), n),
        "at rest": (sum(kill.at_rest for kill in kills), n),
    }
    loads = [kill.load for kill in kills]
    print(
        f"{n} kills, {min(k.after_s for k in kills):.1f} to {max(k.after_s for k in kills):.1f} s into the script, "
        f"{sum(kill.turning for kill in kills)} while turning; load average {min(loads):.1f} to {max(loads):.1f}, "
        f"median {np.median(loads):.1f}"
    )
    print("; ".join(f"{name} {count}/{of}" for name, (count, of) in figures.items()))
    print(
        f"lost before the kill: median {np.median(lost_ms):.1f} ms, 90 % {np.percentile(lost_ms, 90):.1f} ms, worst "
        f"{lost_ms.max():.1f} ms; of {sum(kill.sent for kill in kills)} samples due "
        f"{sum(kill.lost for kill in kills)} are lost; {sum(kill.missed for kill in kills)} were missed on the way, "
        f"{sum(kill.told_lost for kill in kills)} of them told by the recordings"
    )
    return n > 0 and journals > 0 and all(count == of for count, of in figures.values())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--scale", type=float, default=1.0, help="how fast the clocks of run and twins go, 1 to 10")
    parser.add_argument("--script", type=Path, default=None, help="default: the paper's of 360 s")
    parser.add_argument("--at-once", type=int, default=1, help="runs at the same time")
    parser.add_argument("--keep", action="store_true", help="leave the files in ./kills")
    arguments = parser.parse_args()
    logging.getLogger("estimator").addHandler(logging.NullHandler())
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(arguments.at_once) as pool:
        folder = Path("kills") if arguments.keep else Path(scratch)
        folder.mkdir(exist_ok=True)
        seeds = random.Random(arguments.seed)
        chances = [random.Random(seeds.random()) for _ in range(arguments.times)]
        made = [
            pool.submit(one_of_many, folder / str(number), arguments, chance) for number, chance in enumerate(chances)
        ]
        kills = [kill for each in made if (kill := each.result()) is not None]
    sys.exit(0 if kills and report(kills) else 1)


if __name__ == "__main__":
    main()
