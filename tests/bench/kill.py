"""kill -9 at random moments of a run against twins in another process.

Each time: the recording is recovered, no sample is missing of those that were on the bus 20 ms before or earlier (by
the kernel's stamps of a listener of our own on it), and the table comes to rest by the guard or its own watchdog.

    python tests/bench/kill.py --times 200
"""

from __future__ import annotations

import argparse
import asyncio
import difflib
import json
import math
import random
import subprocess
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import can
import h5py
from pymodbus.client import AsyncModbusTcpClient
from support import TwinProcess, command

from estimator.recordings.journal import journal_of
from estimator.recordings.recovery import recover
from estimator.recordings.safe_open import probe
from station.bench.bench import default_bench_text

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
RATE, POSITION = 0x3B00, 0x3700  # Kinco map
WATCHDOG_AND_RAMP_S = 1.0 + 40 / 50 + 0.5
RAW_RPS = math.radians(0.005)  # of the bus
REACH_S = 0.02


@dataclass(frozen=True, slots=True)
class Kill:
    """What one kill left: seconds into the run, outcome in the file, seconds missing, table at rest."""

    after_s: float
    turning: bool
    outcome: str
    sent: int
    """Samples on the bus while it recorded, all gyros."""
    lost: int
    """Of those that were there 20 ms before the kill, how many are not in the recording as they were sent."""
    gaps_s: list[float]
    """How long before the kill those were on the bus."""
    reach_s: float
    """How long before the kill the last sample was on the bus that is in the recording, the worst of the gyros."""
    at_rest: bool


class Listener:
    """Keeps the raw rates that are sent on a CAN bus by multicast, with the instants at which they were there."""

    def __init__(self, link: str) -> None:
        address, _, query = link.removeprefix("can:udp_multicast:").partition("?")
        self._bus = can.Bus(
            interface="udp_multicast", channel=address, port=int(query.partition("port=")[2].partition("&")[0])
        )
        self.sent: dict[int, list[tuple[float, int]]] = {0x101 + gyro: [] for gyro in range(4)}
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self) -> None:
        while not self._ended.is_set():
            message = self._bus.recv(0.2)
            if message is not None and message.arbitration_id in self.sent:
                raw = int.from_bytes(message.data, "little", signed=True)
                self.sent[message.arbitration_id].append((message.timestamp, raw))

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._bus.shutdown()

    def compare(self, rates: list[Any], killed_at: float, reach_s: float) -> tuple[int, int, list[float], float]:
        """Return how many were due, how many and which of them are lost, how far before the kill the last was sent."""
        sent_in_all, lost, last_s, gaps_s = 0, 0, 0.0, set[float]()
        for sent, rates_rps in zip(self.sent.values(), rates, strict=True):
            there = [round(value / RAW_RPS) for value in rates_rps]
            raw = [value for _, value in sent]
            # Where the recording began on the bus; this listener may have missed a frame of the first twenty itself.
            first = next(i - at for at in range(0, 200, 20) for i in range(len(raw)) if raw[i:][:20] == there[at:][:20])
            due = [value for at, value in sent[max(first, 0) :] if at <= killed_at - reach_s]
            same = difflib.SequenceMatcher(None, due, there, autojunk=False).get_matching_blocks()
            sent_in_all += len(due)
            lost += len(due) - sum(block.size for block in same)
            kept = {i for block in same for i in range(block.a, block.a + block.size)}
            gaps_s |= {round(killed_at - sent[max(first, 0) + i][0], 2) for i in range(len(due)) if i not in kept}
            last_s = max(last_s, killed_at - sent[min(first + len(there), len(sent)) - 1][0])
        return sent_in_all, lost, sorted(gaps_s), last_s


def watched_bench(folder: Path) -> Path:
    """Write the built-in bench with drives that stop when their master falls silent; return where."""
    path = folder / "watched.toml"
    path.write_text(default_bench_text().replace('watchdog = "0 s"', 'watchdog = "1 s"'), encoding="utf-8")
    return path


def kill_once(twin: TwinProcess, path: Path, script: Path, after_s: float, reach_s: float = REACH_S) -> Kill:
    """Start a run, kill it ``after_s`` after its first sample is on file, and look at what is left."""
    run = subprocess.Popen(
        command("run", *twin.options("table", "array"), "--script", script, "-o", path, "--json"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    listener = Listener(twin.links["array"])
    journal = journal_of(path)
    while not journal.exists() or journal.stat().st_size < 50_000:
        if run.poll() is not None:
            raise RuntimeError(f"the run ended by itself with {run.returncode}")
        time.sleep(0.01)
    time.sleep(after_s)
    if run.poll() is not None:
        raise RuntimeError(f"the run ended by itself with {run.returncode}")
    killed_at = time.time()
    run.kill()
    run.wait()
    turning = not table_at_rest(twin.links["table"])
    listener.close()
    recover(path)
    probe(path)  # reads the whole file in a process of its own
    assert not journal.exists()
    with h5py.File(path) as file:
        outcome = str(file.attrs["outcome"])
        found = listener.compare([source["rate_rps"][:, 0] for source in file["imu"].values()], killed_at, reach_s)
    if outcome != "ABORTED":
        raise RuntimeError(f"the run had ended by itself: {outcome}")
    time.sleep(max(WATCHDOG_AND_RAMP_S - (time.time() - killed_at), 0))
    return Kill(after_s, turning, outcome, *found, table_at_rest(twin.links["table"]))


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=30)
    parser.add_argument("--seed", type=int, default=None)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    kills = []
    with tempfile.TemporaryDirectory() as folder, TwinProcess("--bench", watched_bench(Path(folder))) as twin:
        script = Path(folder) / "script.toml"
        script.write_text(SCRIPT)
        for number in range(arguments.times):
            try:
                kill = kill_once(twin, Path(folder) / f"{number}.h5", script, chance.uniform(0.2, 12.0))
            except RuntimeError as error:
                print(error, flush=True)
                continue
            kills.append(kill)
            print(json.dumps(asdict(kill)), flush=True)
    lost, sent, rest = (sum(getattr(kill, name) for kill in kills) for name in ("lost", "sent", "at_rest"))
    reach_ms = max(kill.reach_s for kill in kills) * 1e3
    print(
        f"{len(kills)} kills, {sum(kill.turning for kill in kills)} while turning: every file opened; {lost} of {sent} "
        f"samples lost that had been on the bus for {REACH_S * 1e3:.0f} ms; the last one recorded was there at most "
        f"{reach_ms:.0f} ms before the kill; table at rest {rest} times"
    )


if __name__ == "__main__":
    main()
