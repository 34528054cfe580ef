"""A recording whose run died is made whole from its journal when it is next opened."""

import logging
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from estimator.errors import RecordingError, first_line
from estimator.recordings.journal import ARRIVED, ATTRIBUTES, ROWS, journal_of, lock, read_journal, sync
from estimator.recordings.recording import LAYOUT
from estimator.recordings.writing import RecordingWriter

_log = logging.getLogger(__name__)

_GROUP = re.compile(r"/|table|steps|events|imu/(?!\.{1,2}$)[^/\0]{1,200}")
_COLUMNS = {*LAYOUT, "label", "text", "kind"}
_MOST_NAMES = 2000  # of groups and of attributes
_AT_ONCE = 4000  # entries of rows that are written together


def recover(path: Path) -> None:
    """Fold the journal beside a recording into it, if a run left one; told in the log, and in the file.

    A new file takes the recording's place when all is in it, so whoever is killed meanwhile changes nothing. Where the
    journal is damaged, or the recording is the larger, that is kept beside it. A journal of which nothing can be made
    is told of and left.

    Raises RecordingError if the run has not ended, or nothing can be written there.
    """
    journal = journal_of(path)
    if not journal.is_file():
        return
    with _alone_in(path.parent), suppress(FileNotFoundError), journal.open("rb") as file:  # gone: another was faster
        if not lock(file, alone=False):
            raise RecordingError(f"{path} is being written: its run has not ended")
        try:
            _log.warning(_fold(path, journal, file))
        except (ValueError, TypeError, LookupError, ArithmeticError, RuntimeError) as error:
            _log.warning(f"{journal} is not used: it is damaged, or no journal ({first_line(error)})")


def _fold(path: Path, journal: Path, file: BinaryIO) -> str:
    found = _Found(file)
    part = path.with_name(f".{path.name}.recovery.part")
    try:
        part.unlink(missing_ok=True)  # of a recovery that was killed itself
        told = f"{path}: its run did not end; {found.write(part, file)}"
        told += "; part of the journal is damaged and left out" * found.damaged
        if path.exists() and (found.damaged or path.stat().st_size > part.stat().st_size):
            kept = path.with_name(f"{path.name}.before")
            told += f"; what it held before is kept as {kept.name}"
            if not kept.exists():
                path.replace(kept)
        part.replace(path)
        sync(path.parent)
        journal.unlink()
    except (OSError, RecordingError) as error:
        raise RecordingError(
            f"{path} lacks what its run left in {journal.name} beside it, {found.samples} samples, and nothing can be "
            f"written there ({first_line(error)}): copy both to a folder that can be written and has room"
        ) from None
    finally:
        with suppress(OSError):
            part.unlink()
    return told


class _Found:
    """What a journal holds; ``damaged`` if something in its midst was passed over."""

    def __init__(self, file: BinaryIO) -> None:
        """Look through it; ValueError if it is none, or nothing was taken."""
        self.samples, self.damaged, self._last_ns = 0, False, 0
        torn = taken = False
        self._attributes: dict[str, dict[str, Any]] = {}
        for entry in read_journal(file):
            self.damaged, torn = self.damaged or (torn and entry is not None), torn or entry is None
            if entry is None:
                continue
            kind, group, values = entry
            if not _GROUP.fullmatch(group) or (kind != ATTRIBUTES and not values.keys() <= _COLUMNS):
                raise ValueError("a name that no recording has")
            if kind == ATTRIBUTES:
                self._attributes.setdefault(group, {}).update(values)
                if len(self._attributes) + sum(map(len, self._attributes.values())) > _MOST_NAMES:
                    raise ValueError("more names than a recording has")
            elif kind == ROWS and group not in self._attributes and group not in ("steps", "events"):
                raise ValueError(f"{group} is not declared")
            elif kind == ROWS and "rate_rps" in values and group != "table":
                self.samples += len(values["rate_rps"])
                self._last_ns = max(self._last_ns, int(values["t_ns"][-1]))
            taken = taken or kind == ARRIVED
        if "/" not in self._attributes or not (taken or self.samples):
            raise ValueError("it holds no samples")

    def write(self, part: Path, file: BinaryIO) -> str:
        """Write a recording of all of it, and see that the disk has it; return in words what it is."""
        root = self._attributes["/"]
        writer = RecordingWriter(part, {})
        try:
            for group, attributes in self._attributes.items():
                writer.set_attributes(attributes, group)
            self._write_rows(writer, file)
            told = f"{self.samples} samples recovered from its journal, the last at {self._last_ns * 1e-9:.3f} s"
            if "clock_zero_utc_s" in root:
                at_utc_s = float(root["clock_zero_utc_s"]) + self._last_ns * 1e-9 / float(root.get("time_scale", 1.0))
                told += f" ({datetime.fromtimestamp(at_utc_s, UTC):%Y-%m-%d %H:%M:%S} UTC)"
            writer.set_attributes({"recovered": told})
            writer.flush()
        finally:
            writer.close()
        if not writer.whole:
            raise OSError("it could not be closed whole")
        sync(part)
        return told

    def _write_rows(self, writer: RecordingWriter, file: BinaryIO) -> None:
        timed: dict[str, Mapping[str, Any]] = {}
        waiting: dict[str, list[Mapping[str, Any]]] = {}
        for number, (kind, group, values) in enumerate(filter(None, read_journal(file))):
            if kind == ARRIVED:
                waiting.setdefault(group, []).append(values)
            elif kind == ROWS:
                writer.append_rows(group, values)
                if group in waiting:
                    timed[group], last_ns = values, values["arrival_ns"][-1]
                    waiting[group] = [block for block in waiting[group] if block["arrival_ns"][-1] >= last_ns]
            if number % _AT_ONCE == 0:
                writer.flush()
        for group, blocks in waiting.items():
            if rows := _by_arrival(blocks, timed.get(group)):
                self.samples += len(rows["t_ns"])
                self._last_ns = max(self._last_ns, int(rows["t_ns"][-1]))
                writer.append_rows(group, rows)


def _by_arrival(blocks: Sequence[Mapping[str, Any]], timed: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return rows of samples that had no time yet when the run died, evenly spaced from the last that had one on."""
    if not blocks:
        return {}
    arrival_ns, rate_rps = (np.concatenate([block[key] for block in blocks]) for key in ("arrival_ns", "rate_rps"))
    if timed is None:
        return {"t_ns": arrival_ns, "arrival_ns": arrival_ns, "rate_rps": rate_rps}
    last_ns, t_ns = timed["arrival_ns"][-1], timed["t_ns"]
    new = arrival_ns > last_ns
    new[np.flatnonzero(arrival_ns == last_ns)[np.count_nonzero(timed["arrival_ns"] == last_ns) :]] = True
    count = np.count_nonzero(new)
    if not count:
        return {}
    end_ns = arrival_ns[-1] - round(float(np.mean(timed["arrival_ns"] - t_ns)))
    step_ns = max((end_ns - t_ns[-1]) / count, 1.0)
    rows = {
        "t_ns": t_ns[-1] + np.rint(step_ns * np.arange(1, count + 1)).astype(np.int64),
        "arrival_ns": arrival_ns[new],
        "rate_rps": rate_rps[new],
    }
    for name in timed.keys() - rows.keys():  # a temperature holds until the next is told; else nothing is known
        like = timed[name][-1:]
        unknown = like if name == "temperature_c" else like * np.nan if like.dtype.kind == "f" else like * 0 - 1
        rows[name] = np.repeat(unknown, count, axis=0)
    return rows


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Wait until no other process recovers in a folder."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        yield
        return
    try:
        lock(descriptor, alone=True, wait=True)
        yield
    finally:
        os.close(descriptor)
