"""Two minutes of acquisition at real time over real wires: samples lost, and the share of a core the station takes.

python tests/bench/acquire.py                 2 kHz STIM300 on a pty; four gyros at 1 kHz over slcan and socketcand
python tests/bench/acquire.py --seconds 20

The station runs a script that only rests, with the table polled, HDF5 written and its snapshot looked at ten times a
second; imports and the estimate at the end are counted too. Twins are in another process.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

from support import TwinProcess, command

from station.bench.bench import default_bench_text

BARS = {"stim300": 40, "slcan": 60, "socketcand": 25}


def bench_of(kind: str) -> str:
    """Return the bench file of one kind."""
    text = default_bench_text()
    if kind == "stim300":
        return text.replace('rate = "500 Hz"', 'rate = "2000 Hz"')
    wired = text.replace('rate = "100 Hz"', 'rate = "1000 Hz"', 1)
    return wired.replace("[twin]\n", f'[twin.wires]\narray = "{kind}"\n\n[twin]\n', 1)


def measure(kind: str, seconds: float) -> None:
    """Run one kind and print what it took."""
    device = "stim300" if kind == "stim300" else "array"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "bench.toml").write_text(bench_of(kind))
        (folder / "rest.toml").write_text(f'[[step]]\nkind = "rest"\nduration = "{seconds:g} s"\nlabel = "rest"\n')
        with TwinProcess("--bench", folder / "bench.toml") as twin:
            words = command(
                "run", "--bench", folder / "bench.toml", "--script", folder / "rest.toml", "--device", device,
                "--json", "-o", folder / "run.h5", *twin.options("table", device),
            )  # fmt: skip
            began = time.perf_counter()
            read, write = os.pipe()
            child = os.posix_spawn(words[0], words, os.environ, file_actions=[(os.POSIX_SPAWN_DUP2, write, 1)])
            os.close(write)
            with os.fdopen(read) as said:
                text = said.read()
            _, _, usage = os.wait4(child, 0)
            wall_s = time.perf_counter() - began
    found = json.loads(text)
    if "sources" not in found:
        raise SystemExit(text)
    sources = found["sources"].values()
    samples, lost = sum(s["samples"] for s in sources), sum(s["lost"] for s in sources)
    share = 100 * (usage.ru_utime + usage.ru_stime) / wall_s
    print(
        f"{kind}: {samples} samples, {lost} lost, {share:.0f} % of a core (bar {BARS[kind]}), "
        f"{usage.ru_maxrss / 1024:.0f} MB; {found['outcome']}: {found['reason']}",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kinds", nargs="*", default=list(BARS))
    parser.add_argument("--seconds", type=float, default=120.0)
    arguments = parser.parse_args()
    for kind in arguments.kinds:
        measure(kind, arguments.seconds)
