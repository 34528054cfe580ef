"""Cuts at any moment of a run, up to its end: what is left is recovered, with every sample that was due.

`strace` records each write, fdatasync and unlink of a run against twins in another process: by default of the paper's
script of 360 s. At random moments of that log, uniform in time over the whole run, the disk is what a cut may leave:

- power: all that was synchronised before is sure; of what was written later each write survives or not, by itself, and
  some are torn. The samples due are those that had arrived 20 ms before the last sync that ended before the cut.
- torn: all that was written is there, as after kill -9, but the journal, the HDF5 file, or each of them is cut at a
  random byte. The samples due are those that had arrived 20 ms before the cut, or before the last record of a torn
  journal that is whole was written, and all that the HDF5 file itself shows if it can be read.

It ends with 1 if a recording was not opened though samples were due, if one that was due is lost, or if one is wrong.

    python tests/bench/cuts.py --times 200 --scale 10
"""

from __future__ import annotations

import argparse
import logging
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray
from support import TwinProcess, command

from estimator.errors import RecordingError
from estimator.recordings.journal import journal_of
from estimator.recordings.recovery import recover
from estimator.recordings.safe_open import probe

REACH_S, SECTOR = 0.02, 512
CALLS = "openat,write,pwrite64,ftruncate,fsync,fdatasync,unlink,unlinkat"
LINE = re.compile(r"(?P<at>[\d.]+) (?P<call>\w+)\((?P<what>.*)\) += (?P<gave>-?\d+)\S*.* <(?P<took>[\d.]+)>$")


@dataclass(frozen=True, slots=True)
class Call:
    """One call on a file of the run: when it was done, of which file, and for a write where and what."""

    began_s: float
    done_s: float
    kind: str
    name: str
    offset: int = 0
    data: bytes = b""


def plain(text: str) -> bytes:
    """Return what strace wrote as hexadecimal escapes."""
    return bytes.fromhex(text.replace("\\x", "")) if text.startswith("\\x") else text.encode()


def calls_of(log: Path, names: set[str]) -> Iterator[Call]:
    """Yield what one thread did with the files of the run; those that grow only are written at their end."""
    for line in log.open():
        match = LINE.match(line)
        if match is None or int(match["gave"]) < 0:
            continue
        words = re.search(r"<([^>]*)>", match["what"]) or re.search(r'"([^"]*)"', match["what"])
        name = Path(plain(words[1]).decode(errors="replace")).name if words else ""
        kind = match["call"]
        if name not in names or kind == "openat":
            continue
        began, done = float(match["at"]), float(match["at"]) + float(match["took"])
        if kind in ("write", "pwrite64"):
            data = plain((re.search(r', "([^"]*)"', match["what"]) or [b"", ""])[1])
            offset = int(match["what"].rsplit(", ", 1)[1]) if kind == "pwrite64" else -1
            yield Call(began, done, "write", name, offset, data[: int(match["gave"])])
        elif kind == "ftruncate":
            yield Call(began, done, kind, name, int(match["what"].rsplit(", ", 1)[1]))
        else:
            yield Call(began, done, "sync" if "sync" in kind else "unlink", name)


def log_of(folder: Path, scale: float, script: Path | None) -> tuple[list[Call], Path]:
    """Make a run under strace; return its calls in order, and its recording."""
    path = folder / "run.h5"
    speed = ["--scale", str(scale)] if scale != 1 else []
    steps = ["--script", str(script)] if script else []
    with TwinProcess(*speed) as twin:
        run = command("run", *twin.options("table", "array"), *speed, *steps, "-o", path, "--json")
        traced = [
            "strace",
            "-ff",
            "--seccomp-bpf",
            "-y",
            "-ttt",
            "-T",
            "-xx",
            "-s",
            "100000000",
            "-e",
            f"trace={CALLS}",
        ]
        done = subprocess.run(
            [*traced, "-e", f"trace={CALLS}", "-o", folder / "log", *run], capture_output=True, text=True, check=False
        )
    print(f"the run ended with {done.returncode}: {done.stdout.strip()[:200]}")
    names = {path.name, journal_of(path).name}
    calls = sorted((c for log in folder.glob("log.*") for c in calls_of(log, names)), key=lambda call: call.done_s)
    ends: dict[str, int] = {}
    for i, call in enumerate(calls):
        if call.kind == "write":
            at = ends.get(call.name, 0) if call.offset < 0 else call.offset
            calls[i] = Call(call.began_s, call.done_s, "write", call.name, at, call.data)
            ends[call.name] = max(ends.get(call.name, 0), at + len(call.data))
    return calls, path


def left(calls: list[Call], cut_s: float, chance: random.Random, *, power: bool) -> dict[str, bytearray]:
    """Return what the files hold after a cut."""
    done = [call for call in calls if call.done_s <= cut_s]
    sure: dict[str, float] = {}
    for call in done:
        if call.kind == "sync":
            sure[call.name] = call.began_s
    files: dict[str, bytearray] = {}
    for call in done:
        if call.kind == "unlink":
            if not power or chance.random() < 0.5:
                files.pop(call.name, None)
        elif call.kind in ("write", "ftruncate"):
            size = len(call.data)
            if power and call.done_s > sure.get(call.name, 0.0):
                if chance.random() < 0.5:
                    continue
                size = chance.randrange(0, size + 1, SECTOR) if chance.random() < 0.2 else size
            held = files.setdefault(call.name, bytearray())
            end = call.offset + (size if call.kind == "write" else 0)
            held.extend(bytes(max(end - len(held), 0)))
            if call.kind == "write":
                held[call.offset : end] = call.data[:size]
            else:
                del held[end:]
    return files


Samples = dict[str, tuple[NDArray[np.int64], NDArray[np.uint64]]]
"""Of each source: arrivals (n,), and a number made of arrival and rates (n,)."""


def samples(path: Path) -> Samples:
    """Return the samples of a recording."""
    found: Samples = {}
    with h5py.File(path) as file:
        for name, source in file.get("imu", {}).items():
            if "rate_rps" in source:
                n = min(len(source["arrival_ns"]), len(source["rate_rps"]))
                arrival_ns, bits = source["arrival_ns"][:n], source["rate_rps"][:n].view(np.uint64)
                odd = np.uint64(0x9E3779B97F4A7C15) * (2 * np.arange(bits.shape[1], dtype=np.uint64) + np.uint64(1))
                found[name] = arrival_ns, arrival_ns.view(np.uint64) ^ (bits * odd).sum(axis=1)
    return found


def readable(path: Path) -> Samples:
    """Return the samples that an HDF5 file shows by itself; none if it cannot be read."""
    try:
        probe(path)
        return samples(path)
    except (RecordingError, OSError, KeyError):
        return {}


@dataclass(slots=True)
class Found:
    """What the cuts of one kind cost."""

    cuts: int = 0
    enough: int = 0
    """Cuts after which samples were left in the HDF5 file if it can be read, or in whole records of the journal."""
    unread: int = 0
    """Of these, those whose recording was not opened."""
    due: int = 0
    lost: int = 0
    oldest_s: float = 0.0
    """How long before the cut, or what stands for it, the first lost sample had arrived."""
    lost_of_file: int = 0
    """Of those lost, how many the HDF5 file itself had shown."""
    wrong: int = 0

    def missed(self) -> bool:
        return bool(self.unread or self.lost or self.wrong) or not self.enough


class Cuts:
    """Cuts into the log of one run."""

    def __init__(self, folder: Path, calls: list[Call], whole: Path, chance: random.Random) -> None:
        self._folder, self._calls, self._whole, self._chance = folder, calls, whole, chance
        with h5py.File(whole) as file:
            self._zero_s, self._scale = float(file.attrs["clock_zero_utc_s"]), float(file.attrs.get("time_scale", 1.0))
        self._all = samples(whole)
        self._journal = journal_of(whole).name
        self._syncs = [call for call in calls if call.kind == "sync" and call.name == self._journal]
        self._number = 0

    def cut(self, kind: str, found: Found) -> None:
        """Cut once at a random moment, open what is left, and add to what was found."""
        cut_s = self._chance.uniform(self._calls[0].done_s, self._calls[-1].done_s)
        files = left(self._calls, cut_s, self._chance, power=kind == "power")
        into = self._folder / f"cut-{self._number}"
        self._number += 1
        into.mkdir()
        torn = {"torn journal": {self._journal}, "torn HDF5": {self._whole.name}}.get(kind, set())
        if kind == "both torn":
            torn = {self._journal, self._whole.name}
        for name, held in files.items():
            if name in torn:
                del held[self._chance.randrange(len(held) + 1) :]
            (into / name).write_bytes(held)
        path = into / self._whole.name
        if kind == "power":
            until_s = max((call.began_s for call in self._syncs if call.done_s <= cut_s), default=0.0)
        elif self._journal in torn:
            until_s = self._written_s(len(files.get(self._journal, b"")))
        else:
            until_s = cut_s if self._journal in files else 0.0
        due = self._arrived(until_s)
        shown = readable(path) if kind != "power" else {}
        for name, (at_ns, _) in shown.items():
            due[name] = np.union1d(due[name], at_ns)
        there: Samples = {}
        found.cuts += 1
        found.enough += any(map(len, due.values()))
        try:
            recover(path)
            probe(path)
            there = samples(path)
        except Exception as error:
            if any(map(len, due.values())) or not isinstance(error, (RecordingError, OSError)):
                found.unread += 1
                print(f"{kind}, cut at {cut_s - self._calls[0].done_s:.3f} s: {type(error).__name__}: {error}")
        for name, at_ns in due.items():
            lost_ns = at_ns[~np.isin(at_ns, there[name][0] if name in there else ())]
            found.due += len(at_ns)
            found.lost += len(lost_ns)
            if len(lost_ns):
                found.oldest_s = max(found.oldest_s, until_s - self._zero_s - lost_ns[0] * 1e-9 / self._scale)
            found.lost_of_file += int(np.isin(lost_ns, shown[name][0] if name in shown else ()).sum())
        for name, (at_ns, values) in there.items():
            sent_ns, sent = self._all[name]
            found.wrong += int((np.isin(at_ns, sent_ns) & ~np.isin(values, sent)).sum())
        shutil.rmtree(into)

    def _written_s(self, size: int) -> float:
        """Return when the last record of the journal was written that is whole in its first ``size`` bytes."""
        writes = [call for call in self._calls if call.kind == "write" and call.name == self._journal]
        return max((call.began_s for call in writes if call.offset + len(call.data) <= size), default=0.0)

    def _arrived(self, until_s: float) -> dict[str, NDArray[np.int64]]:
        """Return the samples of the whole run that had arrived 20 ms before an instant, by the clock of the host."""
        last_ns = (until_s - REACH_S - self._zero_s) * self._scale * 1e9
        return {name: at_ns[at_ns < last_ns] for name, (at_ns, _) in self._all.items()}


KINDS = ("power", "torn journal", "torn HDF5", "both torn")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=200, help="cuts in all, of the kinds by turns")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--scale", type=float, default=1.0, help="how fast the clocks of run and twins go, 1 to 10")
    parser.add_argument("--script", type=Path, default=None, help="default: the paper's of 360 s")
    parser.add_argument("--kinds", default=",".join(KINDS))
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    logging.getLogger("estimator").addHandler(logging.NullHandler())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calls, whole = log_of(folder, arguments.scale, arguments.script)
        syncs = [c for c in calls if c.kind == "sync" and c.name == journal_of(whole).name]
        took_ms = np.percentile([(call.done_s - call.began_s) * 1e3 for call in syncs], (50, 99, 100))
        print(
            f"{len(calls)} calls in {calls[-1].done_s - calls[0].done_s:.1f} s; {len(syncs)} synchronise the journal: "
        )
        print(f"{took_ms.round(1)} ms (median, 99 %, longest); load average {os.getloadavg()[0]:.1f}", flush=True)
        cuts = Cuts(folder, calls, whole, chance)
        found = {kind: Found() for kind in arguments.kinds.split(",")}
        for number in range(arguments.times):
            kind = list(found)[number % len(found)]
            cuts.cut(kind, found[kind])
            if number % 20 == 19:
                print(f"{number + 1} cuts, load average {os.getloadavg()[0]:.1f}", flush=True)
    for kind, figures in found.items():
        print(
            f"{kind}: {figures.cuts} cuts, {figures.unread} of {figures.enough} unread though enough was left; "
            f"{figures.lost} of {figures.due} samples due are lost, the first {figures.oldest_s * 1e3:.0f} ms "
            f"before, {figures.lost_of_file} of them shown by the HDF5 file; {figures.wrong} wrong"
        )
    sys.exit(any(figures.missed() for figures in found.values()))


if __name__ == "__main__":
    main()
