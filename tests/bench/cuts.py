"""Power cuts in the write log of a run: what the disk may then hold is recovered, with every sample that was due.

`strace` records each write, fdatasync and unlink of a run against twins in another process. At random moments of the
log the disk is what a cut may leave: all that was synchronised before is sure; of what was written later each write
survives or not, by itself, and some are torn. With --kill all is there that was written, as after kill -9. The samples
due are those that had arrived 20 ms before the cut, or before the last sync that ended before it, by the recording of
the whole run.

    python tests/bench/cuts.py --times 200
"""

from __future__ import annotations

import argparse
import random
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from support import TwinProcess, command

from estimator.errors import RecordingError
from estimator.recordings.journal import journal_of
from estimator.recordings.recovery import recover
from estimator.recordings.safe_open import probe

SCRIPT = '[[step]]\nkind = "rest"\nduration = "1 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "3 s"\n'
    for axis in "xyz"
)
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


def log_of(folder: Path) -> tuple[list[Call], Path]:
    """Make a run under strace; return its calls in order, and its recording."""
    path, script = folder / "run.h5", folder / "script.toml"
    script.write_text(SCRIPT)
    with TwinProcess() as twin:
        run = command("run", *twin.options("table", "array"), "--script", script, "-o", path, "--json")
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


def samples(path: Path) -> dict[tuple[str, int], Any]:
    """Return the rates of every sample by its source and arrival."""
    with h5py.File(path) as file:
        sources = [(name, source) for name, source in file.get("imu", {}).items() if "rate_rps" in source]
        return {
            (name, int(at)): rate.tobytes()
            for name, source in sources
            for at, rate in zip(source["arrival_ns"][()], source["rate_rps"][()], strict=False)
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=200)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--kill", action="store_true", help="cuts as of kill -9: nothing written is lost")
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calls, whole = log_of(folder)
        with h5py.File(whole) as file:
            zero_s = float(file.attrs["clock_zero_utc_s"])
        all_of_it = samples(whole)
        syncs = [c for c in calls if c.kind == "sync" and c.name == journal_of(whole).name]
        took_ms = np.percentile([(call.done_s - call.began_s) * 1e3 for call in syncs], (50, 99, 100))
        print(f"{len(calls)} calls; {len(syncs)} synchronise: {took_ms.round(1)} ms (median, 99 %, longest)")
        due, lost, wrong, unread = np.zeros(2, dtype=int), np.zeros(2, dtype=int), 0, 0
        for number in range(arguments.times):
            cut_s = calls[chance.randrange(len(calls))].done_s
            into = folder / f"cut-{number}"
            into.mkdir()
            for file_name, held in left(calls, cut_s, chance, power=not arguments.kill).items():
                (into / file_name).write_bytes(held)
            sure_s = max((c.began_s for c in syncs if c.done_s <= cut_s), default=0.0)
            there: dict[tuple[str, int], Any] = {}
            try:
                recover(into / whole.name)
                probe(into / whole.name)
                there = samples(into / whole.name)
            except Exception as error:
                if sure_s > 0 or not isinstance(error, RecordingError):
                    unread += 1
                    print(f"cut at {cut_s}: {type(error).__name__}: {error}")
            for i, until_s in enumerate((cut_s, sure_s)):
                own = [key for key in all_of_it if zero_s + key[1] * 1e-9 < until_s - REACH_S]
                due[i] += len(own)
                lost[i] += sum(key not in there for key in own)
            wrong += sum(all_of_it.get(key, rate) != rate for key, rate in there.items())
            shutil.rmtree(into)
    print(
        f"{arguments.times} cuts: {unread} files not read; samples lost that had arrived {REACH_S * 1e3:.0f} ms before "
        f"the cut {lost[0]} of {due[0]}, the last sync before it {lost[1]} of {due[1]}; {wrong} samples wrong"
    )


if __name__ == "__main__":
    main()
