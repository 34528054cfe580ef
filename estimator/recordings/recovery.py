"""A recording whose run died is made whole from its journal when it is next opened."""

import logging
import os
import shutil
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np

from estimator.errors import RecordingError, first_line
from estimator.packaged import sentence
from estimator.recordings.journal import ARRIVED, ATTRIBUTES, ROWS, Entry, journal_of, lock, read_journal, sync
from estimator.recordings.recording import FORMAT, IDENTITY
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import RecordingWriter, plain, write_attributes
from estimator.types import Floats

_log = logging.getLogger(__name__)

_MOST_NAMES = 2000  # of groups, columns and attributes
_ENTRY_BYTES, _PENDING_BYTES = 1000, 1 << 24  # of an entry without its rows; of rows that are written together
_ROWS_AT_ONCE = 65536
_PATIENCE_S = 60.0  # for another process that recovers in the same folder
_MOST_ZEROS = 8
"""Samples in a row that a coarse sensor reads as zeros by chance; a lost sector of a disk has 21 or more."""
_RECOVERED = "recovered"
_RESULTS = frozenset({"outcome", "reason"})
"""Attributes of the file that change when a run ends: they do not tell one run from another."""


def recover(path: Path) -> None:
    """Merge the journal beside a recording into it, if a run left one; a message goes to the log and into the file.

    A new file replaces the recording when it is complete, so that an interruption changes nothing. The previous content
    is saved beside it, unless the new file contains all of it. A recording with more samples than its journal keeps its
    rows and takes only counts from the journal. It stays unchanged, with a message in the log, if the journal belongs
    to another run or user, is unusable, or is damaged and has no more samples. The journal is removed once all its
    samples are in the recording.

    RecordingError if the run has not ended, another process recovers in the folder for long, or nothing can be written.
    """
    journal = journal_of(path)
    if not journal.is_file():
        return
    try:
        _check_owner(path, journal.stat())
        with _alone_in(path.parent), journal.open("rb") as file:
            _check_owner(path, os.fstat(file.fileno()))
            if not lock(file, alone=False):
                raise RecordingError(f"{path} is still being written: its run has not ended")
            _log.warning(_fold_in_journal(path, journal, file))
    except RecordingError:
        raise
    except FileNotFoundError:
        return  # another was faster
    except Exception as error:  # anybody may have made the journal
        _log.warning(f"{journal} is not used: {first_line(error)}")


def _check_owner(path: Path, journal: os.stat_result) -> None:
    """Check that a journal belongs to the recording's owner, this user or root; ValueError if not.

    Readers of a recording know its number, and in a shared folder anybody can put a journal beside it. Nothing is
    checked without a recording, or on Windows.
    """
    if os.name == "posix" and path.exists() and journal.st_uid not in (path.stat().st_uid, os.geteuid(), 0):
        raise ValueError(sentence("recordings.other_owner", path=path.name))


def _fold_in_journal(path: Path, journal: Path, file: BinaryIO) -> str:
    """Replace the recording by one with the journal's content, delete the journal, and return in words what was done.

    A recording that holds all of it already stays, one with more samples gets only the journal's counts, and one that
    is replaced but holds other data is kept under a free name. ValueError for a journal that is not used: of another
    run, or damaged and no longer than the recording. RecordingError if nothing can be written.
    """
    found = _JournalContent(file)
    readable = path.exists() and _is_readable(path)
    if readable and not found.is_of(path):
        raise ValueError(sentence("recordings.other_run", path=path.name))
    part = path.with_name(f".{path.name}.recovery.part")
    try:
        part.unlink(missing_ok=True)  # of a recovery that was killed itself
        told = f"{path}: its run did not end; {found.write(part, file)}"
        told += "; damaged or unknown parts of the journal were skipped" * found.damaged
        if readable and _holds_all_of(path, part):
            told = f"{path}: its run did not end properly; the file already holds everything in its journal"
        elif readable and found.damaged and not _is_longer(part, path):
            raise ValueError(sentence("recordings.no_more", path=path.name))
        elif readable and _holds_more_than(path, part):
            told = f"{path}: its run did not end properly; the file holds more samples than its journal"
            found.add_to_copy(path, part, told)
            part.replace(path)
        else:
            if path.exists() and not (readable and _holds_all_of(part, path, names_only=True)):
                kept = _free_name(path.with_name(f"{path.name}.before"))
                told += f"; the previous content was saved as {kept.name}"
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


def _is_readable(path: Path) -> bool:
    """Return whether a file can be read completely, tried in a separate process, and has the format of a recording.

    False for a missing file, and for one that takes that process too long.
    """
    try:
        probe(path)
        with h5py.File(path, "r") as file:
            return bool(plain(file.attrs.get("format")) == FORMAT)
    except (RecordingError, OSError):
        return False


def _holds_all_of(path: Path, other: Path, *, names_only: bool = False) -> bool:
    """Return whether a recording begins with all rows of another, and has all of its groups and attributes.

    ``names_only``: values of attributes may differ. The attribute of a recovery does not count.
    """
    with h5py.File(path, "r") as file, h5py.File(other, "r") as part:
        names = ["/"]
        part.visit(names.append)
        for name in names:
            item, own = part[name], file.get(name)
            if type(own) is not type(item) and name != "/":
                return False
            if isinstance(item, h5py.Dataset):
                if not _begins_with(own, item):
                    return False
                continue  # its attribute is the unit
            for key, value in item.attrs.items():
                if key != _RECOVERED and (key not in own.attrs or not (names_only or _same(own.attrs[key], value))):
                    return False
    return True


def _begins_with(rows: h5py.Dataset, beginning: h5py.Dataset) -> bool:
    """Return whether the first rows of a dataset are all those of another, bit by bit, and types and widths are equal.

    One without dimensions, a single value, must be equal.
    """
    if not beginning.shape or not rows.shape:
        return bool(rows.shape == beginning.shape and np.array_equal(rows[()], beginning[()]))
    if rows.dtype != beginning.dtype or rows.shape[1:] != beginning.shape[1:] or len(rows) < len(beginning):
        return False
    return all(
        rows[at : min(at + _ROWS_AT_ONCE, len(beginning))].tobytes() == beginning[at : at + _ROWS_AT_ONCE].tobytes()
        for at in range(0, len(beginning), _ROWS_AT_ONCE)
    )


def _is_longer(path: Path, other: Path) -> bool:
    """Return whether a recording has samples that another has not, by their number."""
    with h5py.File(path, "r") as file, h5py.File(other, "r") as before:
        counts = {name: len(source["t_ns"]) for name, source in file.get("imu", {}).items() if "t_ns" in source}
        return any(len(before.get(f"imu/{name}/t_ns", ())) < count for name, count in counts.items())


def _holds_more_than(path: Path, other: Path) -> bool:
    """Return whether a recording has all samples of another and more, and all of them were really written.

    After a power cut a file may count rows that never reached the disk: they read as zeros. So the further samples must
    have increasing times, and no more than a few zeros in a row unless those before have many. Sources without rates in
    the other are passed over.
    """
    more = False
    with h5py.File(path, "r") as file, h5py.File(other, "r") as part:
        for name, source in part.get("imu", {}).items():
            if "rate_rps" not in source:
                continue
            own = file.get(f"imu/{name}", {})
            if not {"rate_rps", "t_ns"} <= own.keys() or not _begins_with(own["rate_rps"], source["rate_rps"]):
                return False
            n = len(source["rate_rps"])
            rate_rps, t_ns = own["rate_rps"][:], own["t_ns"][:]
            if len(t_ns) != len(rate_rps) or np.any(np.diff(t_ns[max(n - 1, 0) :]) <= 0):
                return False
            usual = _longest_zeros(rate_rps[:n])
            most = _MOST_ZEROS if usual else 0
            if usual <= _MOST_ZEROS and _longest_zeros(rate_rps[n:]) > most:
                return False
            more = more or len(rate_rps) > n
    return more


def _longest_zeros(rate_rps: Floats) -> int:
    """Return how many samples in a row are zeros in all channels, at most."""
    others = np.flatnonzero(np.append(rate_rps.any(axis=1), True))
    return int(np.diff(others, prepend=-1).max()) - 1


def _free_name(path: Path) -> Path:
    """Return a path, or one with a number at its end, that nothing has yet."""
    number, free = 1, path
    while os.path.lexists(free):
        number += 1
        free = path.with_name(f"{path.name}-{number}")
    return free


class _JournalContent:
    """The content of a journal; ``damaged`` if something before its end was skipped."""

    def __init__(self, file: BinaryIO) -> None:
        """Read the journal once; ValueError if it is not a journal, holds no samples, or has more names than a
        recording.

        What was skipped at its end is no damage.
        """
        self.samples, self.damaged, self._last_ns = 0, False, 0
        self._attributes: dict[str, dict[str, Any]] = {}
        self._first: dict[str, Any] = {}
        self._shapes: dict[str, tuple[str, tuple[int, ...]]] = {}
        passed_over = has_arrived = False
        for entry in read_journal(file):
            if entry is None or not self._take(entry):
                passed_over = True
                continue
            self.damaged = self.damaged or passed_over
            has_arrived = has_arrived or entry[0] == ARRIVED
            if len(self._shapes) + sum(1 + len(own) for own in self._attributes.values()) > _MOST_NAMES:
                raise ValueError("it is damaged: it has more groups than a recording")
        if "/" not in self._attributes or not (has_arrived or self.samples):
            raise ValueError("it is damaged, or not a journal: it holds no samples")

    def _take(self, entry: Entry) -> bool:
        """Store the attributes of an entry, or count its samples; return whether it fits the entries before it.

        Attributes of a group do not fit after its rows. Of the recording itself, those of the first entry are kept,
        too.
        """
        kind, group, values = entry
        if kind == ATTRIBUTES:
            if group in self._shapes:
                return False
            if group == "/":
                self._first = self._first or dict(values)
            self._attributes.setdefault(group, {}).update(values)
        elif not self._fits(group, values):
            return False
        elif kind == ROWS and group.startswith("imu/") and {"rate_rps", "t_ns"} <= values.keys():
            self._count(values)
        return True

    def _fits(self, group: str, values: Mapping[str, Any]) -> bool:
        """Return whether rows have the types and shapes of those before them, and note them for the next.

        Also false for samples of a source that is not declared, and for a group where there is a dataset.
        """
        if group.startswith("imu/") and group not in self._attributes:
            return False
        parts = group.split("/")
        if any("/".join(parts[:end]) in self._shapes for end in range(1, len(parts) + 1)):
            return False  # a group where there is a dataset
        shapes = {}
        for name, rows in values.items():
            shape = ("S" if rows.dtype.kind == "S" else rows.dtype.str, rows.shape[1:])
            if self._shapes.get(f"{group}/{name}", shape) != shape:
                return False
            shapes[f"{group}/{name}"] = shape
        self._shapes |= shapes
        return True

    def _count(self, values: Mapping[str, Any]) -> None:
        self.samples += len(values["rate_rps"])
        self._last_ns = max(self._last_ns, *map(int, values["t_ns"][-1:]), 0)

    def is_of(self, path: Path) -> bool:
        """Return whether a recording belongs to this journal's run: both have the same identity.

        Older files have none: they belong together if their common attributes of the beginning agree, those apart that
        the journal changes later.
        """
        root = self._attributes["/"]
        with h5py.File(path, "r") as file:
            about = dict(file.attrs.items())
        if IDENTITY in root and IDENTITY in about:
            return _same(root[IDENTITY], about[IDENTITY])
        begun = {name: value for name, value in self._first.items() if name not in _RESULTS and name in about}
        return all(_same(about[name], value) or not _same(root[name], value) for name, value in begun.items())

    def write(self, part: Path, file: BinaryIO) -> str:
        """Write a complete recording to ``part`` from the journal ``file`` and sync it; return a sentence about it.

        OSError or RecordingError if that fails.
        """
        root = self._attributes["/"]
        writer = RecordingWriter(part, {})
        try:
            for group, attributes in self._attributes.items():
                writer.set_attributes(attributes, group)
            self._write_rows(writer, file)
            told = f"{self.samples} samples recovered from its journal, the last at {self._last_ns * 1e-9:.3f} s"
            with suppress(ValueError, TypeError, LookupError, ArithmeticError, OSError):  # no such time of day
                at_utc_s = float(root["clock_zero_utc_s"]) + self._last_ns * 1e-9 / float(root.get("time_scale", 1.0))
                told += f" ({datetime.fromtimestamp(at_utc_s, UTC):%Y-%m-%d %H:%M:%S} UTC)"
            writer.set_attributes({_RECOVERED: told})
            writer.flush()
        finally:
            writer.close()
        if not writer.complete:
            raise OSError("it could not be closed completely")
        sync(part)
        return told

    def add_to_copy(self, path: Path, part: Path, recovery: str) -> None:
        """Make ``part`` a copy of the recording with the attributes of its sources that only the journal has, and sync
        it.

        These are counts of an unfinished run. ``recovery`` is the description of the recovery to store.
        """
        part.unlink()
        with path.open("rb") as recording, part.open("xb") as copy:
            shutil.copyfileobj(recording, copy)
        with h5py.File(path, "r") as file:
            sources = {name: source.attrs for name, source in file.get("imu", {}).items()}
            lacking = {
                name: {key: value for key, value in self._attributes.get(f"imu/{name}", {}).items() if key not in own}
                for name, own in sources.items()
            }
        write_attributes(part, {_RECOVERED: recovery}, *lacking.items())
        sync(part)

    def _write_rows(self, writer: RecordingWriter, file: BinaryIO) -> None:
        """Write all rows of the journal that fit to the datasets; others are skipped.

        Samples that had arrived but had no time yet get times by their arrival, and are added to ``samples``.
        """
        timed: dict[str, Mapping[str, Any]] = {}
        waiting: dict[str, list[Mapping[str, Any]]] = {}
        pending_bytes = 0
        for kind, group, values in filter(None, read_journal(file)):
            if kind == ATTRIBUTES or not self._fits(group, values):
                continue
            if kind == ARRIVED:
                if len(values["arrival_ns"]):
                    waiting.setdefault(group, []).append(values)
                continue
            writer.append_rows(group, values)
            if group in waiting and len(values.get("t_ns", ())) and len(values.get("arrival_ns", ())):
                timed[group], last_ns = values, values["arrival_ns"][-1]
                waiting[group] = [block for block in waiting[group] if block["arrival_ns"][-1] >= last_ns]
            pending_bytes += _ENTRY_BYTES + sum(rows.nbytes for rows in values.values())
            if pending_bytes > _PENDING_BYTES:
                writer.flush()
                pending_bytes = 0
        for group, blocks in waiting.items():
            if rows := _by_arrival(blocks, timed.get(group)):
                self.samples += len(rows["t_ns"])
                self._last_ns = max(self._last_ns, int(rows["t_ns"][-1]))
                writer.append_rows(group, rows)


def _same(a: Any, b: Any) -> bool:
    """Return whether two attributes are equal, in the form of a file or of a journal."""
    a, b = (np.asarray([plain(item) for item in np.ravel(value)]) for value in (a, b))
    return bool(np.array_equal(a.astype(str), b.astype(str)))


def _by_arrival(blocks: Sequence[Mapping[str, Any]], timed: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return rows for samples that had no time yet when the run died, evenly spaced after the last timed ones.

    ``blocks`` are the samples as they arrived, ``timed`` the last rows with times; without these the arrivals are the
    times. Empty if all samples were timed. A temperature is held, other unknown columns are NaN or -1.
    """
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
    for name in timed.keys() - rows.keys():  # a temperature holds until the next one; other columns are unknown
        like = timed[name][-1:]
        unknown = like if name == "temperature_c" else like * np.nan if like.dtype.kind == "f" else like * 0 - 1
        rows[name] = np.repeat(unknown, count, axis=0)
    return rows


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Hold a lock on the folder while this context lasts, so that no other process recovers there.

    RecordingError after a minute: anybody who can read a folder can lock it, in a shared folder also a stranger.
    Without locks of folders (Windows) nothing is held.
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        yield
        return
    try:
        give_up_s = time.monotonic() + _PATIENCE_S
        while not lock(descriptor, alone=True):
            if time.monotonic() > give_up_s:
                raise RecordingError(sentence("recordings.not_alone", folder=folder))
            time.sleep(0.02)
        yield
    finally:
        os.close(descriptor)
