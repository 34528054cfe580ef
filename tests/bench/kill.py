"""kill -9 at random moments of a run against twins in another process.

Each time: the recording opens, at most half a second of samples is missing, and the table comes to rest by its
own watchdog.

    python tests/bench/kill.py --times 30
"""

from __future__ import annotations

import argparse
import asyncio
import json
import random
import subprocess
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
from pymodbus.client import AsyncModbusTcpClient
from support import TwinProcess, command

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


@dataclass(frozen=True, slots=True)
class Kill:
    """What one kill left: seconds into the run, outcome in the file, seconds missing, table at rest."""

    after_s: float
    turning: bool
    outcome: str
    missing_s: float
    at_rest: bool


def watched_bench(folder: Path) -> Path:
    """Write the built-in bench with drives that stop when their master falls silent; return where."""
    path = folder / "watched.toml"
    path.write_text(default_bench_text().replace('watchdog = "0 s"', 'watchdog = "1 s"'), encoding="utf-8")
    return path


def kill_once(twin: TwinProcess, path: Path, script: Path, after_s: float) -> Kill:
    """Start a run, kill it ``after_s`` after its first sample is on file, and look at what is left."""
    run = subprocess.Popen(
        command("run", *twin.options("table", "array"), "--script", script, "-o", path, "--json"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    while not path.exists() or path.stat().st_size < 100_000:
        if run.poll() is not None:
            raise RuntimeError(f"the run ended by itself with {run.returncode}")
        time.sleep(0.01)
    time.sleep(after_s)
    killed_at = time.time()
    run.kill()
    run.wait()
    turning = not table_at_rest(twin.links["table"])
    probe(path)  # reads the whole file in a process of its own
    with h5py.File(path) as file:
        zero, outcome = float(file.attrs["clock_zero_utc_s"]), str(file.attrs["outcome"])
        last_s = [len(source["rate_rps"]) and source["t_ns"][-1] * 1e-9 for source in file["imu"].values()]
    missing = killed_at - (zero + min(last_s))
    time.sleep(WATCHDOG_AND_RAMP_S)
    return Kill(after_s, turning, outcome, missing, table_at_rest(twin.links["table"]))


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
            kill = kill_once(twin, Path(folder) / f"{number}.h5", script, chance.uniform(0.2, 12.0))
            kills.append(kill)
            print(json.dumps(asdict(kill)), flush=True)
    print(
        f"{len(kills)} kills, {sum(k.turning for k in kills)} while turning: every file opened, at most "
        f"{max(k.missing_s for k in kills):.3f} s missing, table at rest {sum(k.at_rest for k in kills)} times"
    )


if __name__ == "__main__":
    main()
