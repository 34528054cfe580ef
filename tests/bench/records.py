"""Many recordings: how long the index of a folder takes to be made, to be opened, and to be made anew after harm.

python tests/bench/records.py                  1,000 recordings
python tests/bench/records.py --count 10000    as many as a bench leaves in years
python tests/bench/records.py --folder FOLDER  in a folder that is kept, and filled only if it is not there

Recordings are copies of one run on twins, each cut to 20 rows a dataset and with its own number, date, outcome and
states. Nothing is made faster by that but the disk: what is read for the index is whole.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import io
import os
import random
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
from support import station

from station.cli import main
from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry
from station.screen.archive.index import index_file

_TURN = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "60 deg/s"\nacceleration = "50 deg/s2"\nduration = "6 s"\n'
_DAY_S = 86_400
_LAST_UTC_S = 1_795_262_400  # 2026-11-21 12:00:00 UTC
_OUTCOMES = ("PASS",) * 17 + ("FAIL", "ABORTED", "FAULT")


def small_recording(path: Path) -> None:
    """Write a recording as a run leaves it, without most of its rows: three turns of the built-in twins."""
    script, whole = path.with_name("tiny.toml"), path.with_name("whole.h5")
    script.write_text('[[step]]\nkind = "rest"\nduration = "6 s"\n' + "".join(map(_TURN.format, "xyz")))
    with contextlib.redirect_stdout(io.StringIO()):
        main(["run", "--json", "--script", str(script), "--output", str(whole), "--serial-number", "SN-0"])
    with h5py.File(whole) as source, h5py.File(path, "w") as small:
        small.attrs.update(source.attrs)

        def copy(name: str, item: h5py.Dataset | h5py.Group) -> None:
            if isinstance(item, h5py.Dataset):
                rows = item[()] if not item.shape or name.startswith("calibration") else item[:20]
                made = small.create_dataset(name, data=rows, dtype=item.dtype)
            else:
                made = small.require_group(name)
            made.attrs.update(item.attrs)

        source.visititems(copy)
    whole.unlink()


def fill(folder: Path, count: int, devices: int = 100) -> None:
    """Write recordings of so many devices, a day apart each, the oldest first; one in 50 has moved by ten sigmas."""
    chance = np.random.default_rng(0)
    small = folder.with_name("small.h5")
    small_recording(small)
    content = small.read_bytes()
    for number in range(count):
        below = folder / f"device-{number % devices:03d}"
        below.mkdir(parents=True, exist_ok=True)
        path = below / f"run-{number:05d}.h5"
        path.write_bytes(content)
        with h5py.File(path, "r+") as file:
            when = _LAST_UTC_S - (count - number) * _DAY_S / devices
            told = {"device_serial": f"SN-{number % devices:04d}", "outcome": _OUTCOMES[chance.integers(20)]}
            file.attrs.update({**told, "clock_zero_utc_s": when})
            states, sd = file["calibration/states"], file["calibration/sd"][()]
            moved = 10.0 * (chance.random() < 0.02)
            states[...] = states[()] + sd * (chance.standard_normal(sd.shape) + moved)


def listed(folder: Path) -> tuple[float, list[Entry]]:
    """Return how long the list of a folder takes in a program that has just begun, in s, and the list."""

    async def go() -> tuple[float, list[Entry]]:
        archive, began = Archive(), time.monotonic()
        found = [entry async for entry in archive.entries(folder)]
        took = time.monotonic() - began
        await archive.close()
        return took, found

    return asyncio.run(go())


def harmed(index: Path, times: int) -> Iterator[str]:
    """Harm an index at random bytes, once for each of so many tries; yield in what way."""
    chance, whole = random.Random(0), index.read_bytes()
    for _ in range(times):
        content = bytearray(whole)
        count = chance.choice((1, 10, 1000))
        for _ in range(count):
            content[chance.randrange(len(content))] = chance.randrange(256)
        if cut := chance.random() < 0.3:
            del content[chance.randrange(len(content)) :]
        index.write_bytes(content)
        yield f"{count} random bytes{', cut' if cut else ''}"
    index.write_bytes(whole)


def measure(folder: Path, count: int, harms: int) -> None:
    """Print what takes how long; AssertionError where a list is not as the files say."""
    took, truth = listed(folder)
    print(f"{len(truth)} recordings: index made in {took / count * 1000:.1f} s per 1,000, {_load()}", flush=True)
    assert len(truth) == count
    index = index_file(folder)
    print(f"index: {index.stat().st_size / 1e6:.1f} MB")
    took = min(_as(truth, folder) for _ in range(5))
    print(f"opened in {took:.2f} s (best of 5), {_load()}", flush=True)
    for options in ([], ["--serial", "SN-0007"], ["--csv"]):
        began = time.monotonic()
        assert station("history", folder, *options).returncode == 0
        print(f"station history {' '.join(options)}: {time.monotonic() - began:.2f} s, Python's start in it")
    for what in harmed(index, harms):
        print(f"after {what}: {_as(truth, folder):.1f} s", flush=True)
    index.unlink()
    print(f"after its deletion: {_as(truth, folder):.1f} s")


def _load() -> str:
    return "load " + " ".join(f"{load:.1f}" for load in os.getloadavg())


def _as(truth: list[Entry], folder: Path) -> float:
    """Return how long the list of a folder takes, in s; AssertionError if it is not this one."""
    took, found = listed(folder)
    assert sorted(map(repr, found)) == sorted(map(repr, truth))
    return took


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--harms", type=int, default=10)
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        os.environ["XDG_STATE_HOME"] = str(Path(name, "state"))
        recordings = arguments.folder or Path(name, "recordings")
        if not recordings.exists():
            recordings.parent.mkdir(parents=True, exist_ok=True)
            fill(recordings, arguments.count)
        measure(recordings, arguments.count, arguments.harms)
