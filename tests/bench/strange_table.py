"""Whole runs on a table that is not ours, in real time: wires that misbehave, readings that lie, a drive's own cycle.

python tests/bench/strange_table.py --table PATH                        readings that lie; TCP, RTU; cycles 0, 2, 10 ms
python tests/bench/strange_table.py --table PATH --proxy PATH           and the modes of a misbehaving proxy
python tests/bench/strange_table.py --table PATH --kinds none --runs 5  runs one after the other on a table left enabled
python tests/bench/strange_table.py ... --wires rtu --cycles 0.01 --kinds frozen,zeros --phases ramp --verbose

The table is a program that speaks Modbus TCP as Kinco drives do, unit ids 1, 2, 3 for x, y, z with 65536, 1296000 and
8388608 counts a turn, and a STIM300 on another port: `PATH --port N --stimtcp M --cycle S --answer --motion LOG`. LOG
gets a line "UNIX-TIME moves" or "... rests" whenever the first axis begins to turn or the last one stands. It is kept
for all runs of one wire and cycle, so that each run meets what the run before has left.

The proxy is a program that misbehaves in the replies of Modbus TCP: `python PATH LISTEN TARGET MODE ARGUMENT`.
Between table and station sits a bridge: it carries TCP or RTU on a pseudo-terminal, and from the strike on freezes
readings or leads through the proxy. A cell is the time from the strike until the table stands (bar: 1.5 s), or "runs"
for a run that went through to its verdict; what is wrong is marked with "!".
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import math
import os
import socket
import sys
import tempfile
import time
import tty
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "support"))

from pymodbus.framer import FramerRTU

BENCH = """\
name = "a table that is not ours"
[site]
latitude = "45 deg"
heading = "30 deg"
[table]
protocol = "modbus"
link = "{table}"
gimbals = ["z", "y", "x"]
[table.x]
unit_id = 1
counts_per_turn = 65536
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.y]
unit_id = 2
counts_per_turn = 1296000
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.z]
unit_id = 3
counts_per_turn = 8388608
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[[imu]]
name = "stim300"
protocol = "stim300"
link = "tcp://127.0.0.1:{imu}"
array = "triad"
rate = "500 Hz"
[imu.datasheet]
arw = "0.0025 deg/s/rtHz"
bias = "1 deg/s"
scale_factor_error = "5 %"
misalignment = "20 mrad"
[limits]
nis_low = 0.5
nis_high = 2.0
"""
SCRIPT = """\
step = [
    { kind = "rest", duration = "0.5 s" },
    { kind = "rotate", axis = "x", rate = "-20 deg/s", duration = "5 s", acceleration = "40 deg/s2" },
    { kind = "rest", duration = "0.5 s" },
]
"""
AT_REST_S = 1.5
PHASES = {"homing": (0x1F, 0.3), "ramp": (0x3F, 0.25), "steady": (0x3F, 1.5)}
"""By phase: the controlword that begins it, and how long after that the strike is."""
CONTROLWORD, STATUSWORD, POSITION, RATE = 0x3100, 0x3200, 0x3700, 0x3B00
READINGS = (STATUSWORD, POSITION, RATE)
FROZEN: Mapping[str, tuple[tuple[int, ...], bool]] = {
    "frozen": (READINGS, False),
    "frozen position": ((POSITION,), False),
    "frozen rate": ((RATE,), False),
    "frozen position and rate": ((POSITION, RATE), False),
    "frozen status": ((STATUSWORD,), False),
    "zeros": ((POSITION, RATE), True),
    "zero position": ((POSITION,), True),
    "zero rate": ((RATE,), True),
}
"""Which registers tell always the same from the strike on, and whether that is zero."""
TRUE_UNTIL_THE_END = ("frozen rate", "frozen status")
"""What nobody can see until the end of a steady turn: until then it is true. The move ends as it was commanded."""
PROXIED = {
    "late": "300", "late1in20": "500", "tid": "1", "tid0": "0", "split": "1", "dup": "1", "unit": "1", "fc": "1",
    "len": "1", "count": "1", "stale": "1", "flip": "20", "garbage": "20", "drop": "1", "droponce": "1", "hole": "1",
    "exc6": "1", "exc5": "1", "exc11": "1", "exc6read": "1",
}  # fmt: skip
"""Modes of the proxy with their arguments."""


@dataclass
class Case:
    """One run: what misbehaves and from when; how it ended."""

    wire: str
    cycle_s: float
    kind: str
    phase: str
    struck_s: float = 0.0
    rest_s: float = 0.0
    outcome: str = ""
    reason: str = ""
    error: str = ""

    @property
    def wrong(self) -> str:
        """What is wrong, empty if nothing is."""
        if "Traceback" in self.error or "defect of the station" in self.reason:
            return "defect"
        if self.kind == "none":
            return "" if self.outcome in ("PASS", "FAIL") else self.outcome or "no verdict"
        if not self.struck_s:
            return "not struck"
        if self.kind in FROZEN and self.phase != "homing" and self.outcome != "FAULT":
            return "not seen"
        if self.kind in TRUE_UNTIL_THE_END:
            return "" if self.outcome == "FAULT" and math.isfinite(self.rest_s) else "not seen"
        if self.outcome not in ("PASS", "FAIL") and self.rest_s > AT_REST_S:
            return f"at rest after {self.rest_s:.2f} s"
        if self.kind in FROZEN and self.phase != "homing" and "keeps turning" in self.reason:
            return "said to turn"
        return ""

    @property
    def cell(self) -> str:
        """What stands in the matrix."""
        said = "runs" if self.outcome in ("PASS", "FAIL") else f"{self.rest_s:.2f}"
        return f"! {self.wrong}" if self.wrong else said


@dataclass
class Bridge:
    """Carries Modbus requests of one station, TCP or RTU, to a TCP port; misbehaves from the strike on."""

    target: int
    case: Case
    proxy: int = 0
    _held: dict[tuple[int, int], bytes] = field(default_factory=dict)
    _upstream: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
    _through_proxy: bool = False

    @property
    def struck(self) -> bool:
        return 0.0 < self.case.struck_s <= time.time()

    def hear(self, pdu: bytes) -> None:
        """Note the controlword that begins the phase in which the strike is to be."""
        word, after_s = PHASES.get(self.case.phase, (-1, 0.0))
        if (
            not self.case.struck_s
            and pdu[0] == 6
            and pdu[1:] == CONTROLWORD.to_bytes(2) + word.to_bytes(2, signed=word < 0)
        ):
            self.case.struck_s = time.time() + after_s

    async def exchange(self, request: bytes) -> AsyncIterator[bytes]:
        """Send a request with its MBAP header; yield what comes back until it is answered, or the line is silent."""
        self.hear(request[7:])
        through = self.struck and self.proxy > 0
        if self._upstream is None or through != self._through_proxy:
            self.hang_up()
            self._upstream = await asyncio.open_connection("127.0.0.1", self.proxy if through else self.target)
            self._through_proxy = through
        reader, writer = self._upstream
        writer.write(request)
        while True:
            data = await reader.read(4096)
            if not data:
                self.hang_up()
                raise ConnectionError
            yield self.changed(request, data)

    def changed(self, request: bytes, reply: bytes) -> bytes:
        """Return a reply as the station is to get it."""
        registers, zero = FROZEN.get(self.case.kind, ((), False))
        address = int.from_bytes(request[8:10])
        if request[7] != 3 or address not in registers or len(reply) < 10 or reply[7] != 3:
            return reply
        words = reply[9:]
        if not self.struck:
            self._held[request[6], address] = words
            return reply
        return reply[:9] + (bytes(len(words)) if zero else self._held.get((request[6], address), words))

    def hang_up(self) -> None:
        """Close the connection to the table."""
        if self._upstream is not None:
            self._upstream[1].close()
            self._upstream = None


async def serve_tcp(bridge: Bridge, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Serve one connection of the station."""
    answering: asyncio.Task[None] | None = None
    with contextlib.suppress(OSError, asyncio.IncompleteReadError):
        while True:
            header = await reader.readexactly(6)
            request = header + await reader.readexactly(int.from_bytes(header[4:6]))
            if answering is not None:
                answering.cancel()

            async def answer(request: bytes = request) -> None:
                try:
                    async for data in bridge.exchange(request):
                        writer.write(data)
                except OSError:
                    writer.transport.abort()

            answering = asyncio.ensure_future(answer())
    if answering is not None:
        answering.cancel()
    bridge.hang_up()
    writer.close()


class SerialEnd:
    """Serves Modbus RTU at the far end of a pseudo-terminal, by a bridge to TCP."""

    def __init__(self, bridge: Bridge, descriptor: int) -> None:
        """Listen until ``close``."""
        self.bridge, self._descriptor = bridge, descriptor
        self._received, self._number = b"", 0
        self._answering: asyncio.Task[None] | None = None
        asyncio.get_running_loop().add_reader(descriptor, self._read)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._descriptor)
        if self._answering is not None:
            self._answering.cancel()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            self._received += os.read(self._descriptor, 4096)
        while len(self._received) >= 8:
            size = 9 + self._received[6] if self._received[1] == 16 else 8
            if len(self._received) < size:
                return
            frame, self._received = self._received[:size], self._received[size:]
            if not FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:])):
                self._received = b""
                return
            if self._answering is not None:
                self._answering.cancel()
            self._answering = asyncio.ensure_future(self._answer(frame[:-2]))

    async def _answer(self, unit_and_pdu: bytes) -> None:
        self._number = (self._number + 1) & 0xFFFF
        header = self._number.to_bytes(2) + bytes(2) + len(unit_and_pdu).to_bytes(2)
        with contextlib.suppress(OSError):
            async for data in self.bridge.exchange(header + unit_and_pdu):
                while len(data) > 7:
                    size = 6 + int.from_bytes(data[4:6])
                    frame, data = data[6:size], data[size:]
                    os.write(self._descriptor, frame + FramerRTU.compute_CRC(frame).to_bytes(2))


@asynccontextmanager
async def bridged(case: Case, target: int, proxy: int) -> AsyncIterator[str]:
    """Give the link at which the station finds the table."""
    bridge = Bridge(target, case, proxy)
    if case.wire == "rtu":
        far, near = os.openpty()
        tty.setraw(far)
        tty.setraw(near)
        end = SerialEnd(bridge, far)
        try:
            yield f"serial://{os.ttyname(near)}?baud=115200"
        finally:
            end.close()
            os.close(far)
            os.close(near)
    else:
        server = await asyncio.start_server(lambda *ends: serve_tcp(bridge, *ends), "127.0.0.1", 0)
        try:
            yield f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        finally:
            server.close()
    bridge.hang_up()


def free_port() -> int:
    """Return a port that nobody listens at now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@asynccontextmanager
async def process(*words: str | Path, ready: bytes = b"") -> AsyncIterator[asyncio.subprocess.Process]:
    """Run a program, from the line on that it says it is ready by."""
    pipes = {"stdin": asyncio.subprocess.PIPE, "stdout": asyncio.subprocess.PIPE, "stderr": asyncio.subprocess.DEVNULL}
    started = await asyncio.create_subprocess_exec(*map(str, words), **pipes)  # type: ignore[arg-type]
    try:
        assert started.stdout is not None
        while ready not in (line := await started.stdout.readline()):
            assert line, f"{words[0]} has ended"
        yield started
    finally:
        with contextlib.suppress(ProcessLookupError):
            started.kill()
        await started.wait()


async def run_case(case: Case, folder: Path, table: int, imu: int, proxy: Path | None) -> None:
    """Run the script once; the case keeps how it ended."""
    async with contextlib.AsyncExitStack() as stack:
        port = 0
        if case.kind in PROXIED:
            port = free_port()
            words = (sys.executable, proxy or "", str(port), str(table), case.kind, PROXIED[case.kind])
            await stack.enter_async_context(process(*words, ready=b"ready"))
        link = await stack.enter_async_context(bridged(case, table, port))
        (folder / "bench.toml").write_text(BENCH.format(table=link, imu=imu))
        (folder / "script.toml").write_text(SCRIPT)
        recording = folder / "r.h5"
        for left in folder.glob("r.h5*"):
            left.unlink()
        words = (sys.executable, "-m", "station.cli", "run", "--json", "--reset-fault")
        files = ("--bench", folder / "bench.toml", "--script", folder / "script.toml", "-o", recording)
        pipe = asyncio.subprocess.PIPE
        run = await asyncio.create_subprocess_exec(*map(str, (*words, *files)), stdout=pipe, stderr=pipe)
        out, errors = await run.communicate()
    case.error = errors.decode(errors="replace")
    with contextlib.suppress(ValueError):
        told = json.loads(out)
        case.outcome, case.reason = told["outcome"] or "", told["reason"]
    await asyncio.sleep(0.2)
    moved = [line.split() for line in (folder / "motion.log").read_text().splitlines()]
    last_s = max((float(t_s) for t_s, does in moved if does == "rests"), default=0.0)
    turns = bool(moved) and moved[-1][1] == "moves"
    case.rest_s = float("inf") if turns else max(last_s - case.struck_s, 0.0) if case.struck_s else 0.0
    if turns:
        await asyncio.sleep(10.0)  # the move ends by itself


async def run_all(arguments: argparse.Namespace, cases: Sequence[Case]) -> None:
    """Run the cases, a table for each wire and cycle."""
    groups = dict.fromkeys((case.wire, case.cycle_s) for case in cases)
    for wire, cycle_s in groups:
        with tempfile.TemporaryDirectory() as place:
            folder, table, imu = Path(place), free_port(), free_port()
            words = (arguments.table, "--port", str(table), "--stimtcp", str(imu), "--answer", "--start", "-5,-8,-3")
            more = ("--cycle", str(cycle_s), "--motion", folder / "motion.log")
            async with process(*words, *more, *arguments.option, ready=b"stim300"):
                for case in cases:
                    if (case.wire, case.cycle_s) == (wire, cycle_s):
                        await run_case(case, folder, table, imu, arguments.proxy)
                        print(f"{wire} {cycle_s * 1e3:g} ms, {case.kind}, {case.phase}: {case.cell}", file=sys.stderr)
                        if arguments.verbose or case.wrong:
                            print(f"    {case.outcome}: {case.reason} {case.error[-500:]}", file=sys.stderr)


def matrix(cases: Sequence[Case]) -> str:
    """Return kinds and phases by wires and cycles."""
    columns = list(dict.fromkeys((case.wire, case.cycle_s) for case in cases))
    lines = [f"{'':36s}" + "".join(f"{f'{wire} {cycle * 1e3:g} ms':>22s}" for wire, cycle in columns)]
    for kind, phase in dict.fromkeys((case.kind, case.phase) for case in cases):
        cells = []
        for column in columns:
            same = [c for c in cases if (c.kind, c.phase, (c.wire, c.cycle_s)) == (kind, phase, column)]
            worst = next((case for case in same if case.wrong), same[-1])
            cells.append(worst.cell[:20] if len(same) == 1 else f"{sum(not c.wrong for c in same)} of {len(same)}")
        lines.append(f"{', '.join(filter(None, (kind, phase))):36s}" + "".join(f"{cell:>22s}" for cell in cells))
    return "\n".join(lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, required=True, help="program of the table")
    parser.add_argument(
        "--proxy", type=Path, help="program that misbehaves in the replies; without it only readings lie"
    )
    parser.add_argument("--option", action="append", default=[], help="another word for the table's program")
    parser.add_argument("--wires", default="tcp,rtu")
    parser.add_argument("--cycles", default="0,0.002,0.010", help="of the drives, in seconds")
    parser.add_argument(
        "--kinds", default="", help="names, with commas, none for runs that nothing disturbs; all if left out"
    )
    parser.add_argument("--phases", default=",".join(PHASES))
    parser.add_argument("--runs", type=int, default=1, help="of each case, one after the other")
    parser.add_argument("--verbose", action="store_true")
    given = parser.parse_args()
    kinds = given.kinds.split(",") if given.kinds else ["none", *FROZEN, *(PROXIED if given.proxy else ())]
    every = [
        Case(wire, float(cycle), kind, phase)
        for wire in given.wires.split(",")
        for cycle in given.cycles.split(",")
        for kind in kinds
        for phase in (given.phases.split(",") if kind != "none" else [""])
        for _ in range(given.runs)
    ]
    asyncio.run(run_all(given, every))
    print(matrix(every))
    wrong = sum(bool(case.wrong) for case in every)
    print(f"{len(every) - wrong} of {len(every)} ended as they should; load {os.getloadavg()[0]:.1f}")
    sys.exit(1 if wrong else 0)
