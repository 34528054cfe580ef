"""Whether a change leaves recordings and answers as they were, byte by byte.

python tests/bench/equal.py --store before.json       the built-in bench and those of tests/data/benches
python tests/bench/equal.py --compare before.json     the same, and each item that is not as it was; 1 if there is one

Every bench is checked, planned, run in virtual time with one seed, and its recording calibrated anew. Each data set and
each group's attributes of the recording is an item with a digest, and so is each key of what ``--json`` prints. What
tells of this computer, of the version or of a file's place is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from typing import Any

import h5py
import numpy as np

BENCHES = Path(__file__).parents[1] / "data" / "benches"
SEED = "7"
REST = """
[[step]]
kind = "rest"
duration = "8 s"
"""
TURN = """
[[step]]
kind = "rotate"
axis = "{axis}"
rate = "20 deg/s"
acceleration = "20 deg/s2"
duration = "12 s"
"""
SCRIPT = 'name = "short"\n' + REST + "".join(TURN.format(axis=axis) + REST for axis in "xyz")
"""Of all benches but the built-in one."""
NOT_COMPARED = {"/": ("software_version",), "check": ("computer",)}
"""What differs between versions or computers: attributes of a group, keys of the output of a command."""


def digest(data: bytes) -> str:
    return sha256(data).hexdigest()[:16]


def of_recording(path: Path) -> Iterator[tuple[str, str]]:
    """Yield every data set and the attributes of every group of a recording, each with its digest."""
    with h5py.File(path, "r") as file:
        names: list[str] = ["/"]
        file.visit(names.append)
        for name in names:
            item = file[name]
            if isinstance(item, h5py.Dataset):
                rows = item[()]
                about = f"{rows.dtype.str} {rows.shape} "
                yield f"data set {name}", digest(about.encode() + np.ascontiguousarray(rows).tobytes())
            left_out = NOT_COMPARED.get(name, ())
            for key in sorted(set(item.attrs) - set(left_out)):
                yield f"attribute {name} {key}", digest(repr(np.asarray(item.attrs[key]).tolist()).encode())


def of_output(command: str, text: str) -> Iterator[tuple[str, str]]:
    """Yield each key of what a command printed, with its digest."""
    printed: Mapping[str, Any] = json.loads(text)
    for key in sorted(set(printed) - set(NOT_COMPARED.get(command, ()))):
        yield f"{command} --json {key}", digest(json.dumps(printed[key], sort_keys=True).encode())


def station(folder: Path, *arguments: str) -> str:
    """Return what a command prints, run in a folder; its exit code is an item of the output already."""
    command = [sys.executable, "-m", "station.cli", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    ended = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)
    if not ended.stdout.strip():
        raise RuntimeError(f"{' '.join(arguments)} printed nothing: {ended.stderr}")
    return ended.stdout


def of_bench(name: str, text: str | None) -> dict[str, str]:
    """Return the items of a bench; without a text it is the built-in one, with its 360 s script."""
    items = {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        bench, script = [], []
        if text is not None:
            (place / "bench.toml").write_text(text)
            (place / "script.toml").write_text(SCRIPT)
            bench, script = ["--bench", "bench.toml"], ["--script", "script.toml"]
        outputs = {
            "check": station(place, "check", *bench[1:], "--json", "--seed", SEED),
            "plan": station(place, "plan", *bench, "--json", *script[1:]),
            "run": station(place, "run", *bench, *script, "--json", "--seed", SEED, "-o", "run.h5"),
        }
        items.update(of_recording(place / "run.h5"))
        outputs["calibrate"] = station(place, "calibrate", "--json", "run.h5")
        for command, output in outputs.items():
            items.update(of_output(command, output))
    return {f"{name}: {item}": value for item, value in items.items()}


def differences(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Return a line for each item that is not as it was."""
    lines = []
    for item in sorted({*before, *now}):
        if item not in now:
            lines.append(f"gone     {item}")
        elif item not in before:
            lines.append(f"new      {item}")
        elif before[item] != now[item]:
            lines.append(f"changed  {item}")
    return lines


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, metavar="FILE", help="write the digests")
    parser.add_argument("--compare", type=Path, metavar="FILE", help="compare with digests that were stored")
    parser.add_argument("--bench", action="append", default=[], metavar="NAME", help="only this bench; may be repeated")
    parser.add_argument("--jobs", type=int, default=2, help="benches at a time")
    arguments = parser.parse_args()
    benches: dict[str, str | None] = {"built_in": None}
    benches |= {path.stem: path.read_text(encoding="utf-8") for path in sorted(BENCHES.glob("*.toml"))}
    if arguments.bench:
        benches = {name: benches[name] for name in arguments.bench}
    with ThreadPoolExecutor(arguments.jobs) as pool:
        found = pool.map(of_bench, benches, benches.values())
        items = {item: value for bench in found for item, value in bench.items()}
    for item, value in items.items():
        print(value, item)
    print(f"{len(items)} items of {len(benches)} benches")
    if arguments.store:
        arguments.store.write_text(json.dumps(items, indent=1), encoding="utf-8")
    if not arguments.compare:
        return 0
    before = json.loads(arguments.compare.read_text(encoding="utf-8"))
    before = {item: value for item, value in before.items() if item.partition(":")[0] in benches}
    lines = differences(before, items)
    print("\n".join([*lines, f"{len(lines)} of {len(items)} items are not as they were"]))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
