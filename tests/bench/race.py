"""Runs in real time on a busy machine, gyros on CAN: how many end ABORTED by themselves, and why.

python tests/bench/race.py --runs 200 --at-once 4            some 20 minutes, and a heavy load for two cores
python tests/bench/race.py --runs 30 --kinds socketcand

Each run is `station run` on its own twin in another process; the kinds of wire take turns. The bar: 0 ABORTED of 200.
Nobody stops these runs, so whatever ends ABORTED did so by itself. FAIL and FAULT are counted and told, too: a computer
that does not keep up may lose samples or answers, and says so.

Threads take turns every 5 ms, so two of them seldom meet in one place. With a shorter ``--switch`` they meet more
often, and the computer keeps up less well.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from support import TwinProcess

from station.bench.bench import default_bench_text

KINDS = ("slcan", "socketcand")
SCRIPT = """
[[step]]
kind = "rest"
duration = "{rest_s:g} s"
label = "rest"
[[step]]
kind = "rotate"
axis = "z"
rate = "20 deg/s"
duration = "{turn_s:g} s"
label = "z"
"""


def bench_of(kind: str, rate_hz: float) -> str:
    """Return the bench file of one kind of wire, for four gyros."""
    text = re.sub(
        r"^\[limits\].*?(?=^\[|\Z)", "", default_bench_text(), flags=re.DOTALL | re.MULTILINE
    )  # not judged here
    wired = text.replace('rate = "100 Hz"', f'rate = "{rate_hz:g} Hz"', 1)
    return wired.replace("[twin]\n", f'[twin.wires]\narray = "{kind}"\n\n[twin]\n', 1)


def run_once(kind: str, seconds: float, rate_hz: float, switch_s: float) -> tuple[str, str]:
    """Run once; return the outcome and its reason."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.toml").write_text(bench_of(kind, rate_hz))
        (folder / "script.toml").write_text(SCRIPT.format(rest_s=seconds / 2, turn_s=seconds / 2))
        twin = TwinProcess("--bench", folder / "bench.toml")
        try:
            words = station_command(
                switch_s,
                "run", "--bench", folder / "bench.toml", "--script", folder / "script.toml", "--device", "array",
                "--json", "-o", folder / "run.h5", *twin.options("table", "array"),
            )  # fmt: skip
            done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=20 * seconds + 120)
        finally:
            end(twin.process)
    try:
        found = json.loads(done.stdout)
    except ValueError:
        return "no answer", f"exit code {done.returncode}: {done.stderr[-500:]}"
    return str(found.get("outcome")), str(found.get("reason")) + done.stderr.partition("note: ")[2][:300]


def station_command(switch_s: float, *arguments: str | Path) -> list[str]:
    """Return the command line of a station whose threads take turns so often."""
    code = f"import sys; sys.setswitchinterval({switch_s!r}); from station.cli import main; sys.exit(main())"
    return [sys.executable, "-c", code, *map(str, arguments)]


def end(twin: subprocess.Popen[str]) -> None:
    """End a twin; one that takes more than 15 s on this busy machine is killed: it is not what is judged."""
    twin.terminate()
    try:
        twin.wait(15)
    except subprocess.TimeoutExpired:
        print("a twin did not end within 15 s and was killed", flush=True)
        twin.kill()
        twin.wait()
    if twin.stdout is not None:
        twin.stdout.close()


def main() -> None:
    """Run, count, and fail if a run ended ABORTED."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--at-once", type=int, default=4, help="runs side by side: the load")
    parser.add_argument("--seconds", type=float, default=10.0, help="of the script")
    parser.add_argument("--rate", type=float, default=500.0, help="samples a second of each gyro")
    parser.add_argument("--switch", type=float, default=0.005, help="s between turns of the station's threads")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    arguments = parser.parse_args()
    kinds = [arguments.kinds[i % len(arguments.kinds)] for i in range(arguments.runs)]
    with ThreadPoolExecutor(arguments.at_once) as pool:
        tried = partial(run_once, seconds=arguments.seconds, rate_hz=arguments.rate, switch_s=arguments.switch)
        ends = [(kind, *end) for kind, end in zip(kinds, pool.map(tried, kinds), strict=True)]
    for (kind, outcome, reason), count in Counter(ends).most_common():
        if outcome != "ESTIMATED":
            print(f"{count} x {kind}: {outcome}: {reason}")
    counts = Counter(outcome for _, outcome, _ in ends)
    load = ", ".join(f"{value:.1f}" for value in os.getloadavg())
    print(f"{len(ends)} runs, {arguments.at_once} at once, load {load}: {dict(counts)}")
    sys.exit(1 if counts["ABORTED"] or counts["no answer"] else 0)


if __name__ == "__main__":
    main()
