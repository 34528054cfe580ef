"""Writing of a recording as an HDF5 file: at once, or during the run.

The layout is documented in docs/pages/reference/recording.md. Files are plain HDF5 (no filters, default library
bounds), which is what survives a process that dies between two flushes.
"""

import math
import os
import secrets
import shutil
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, astuple, fields
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError, first_line
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior
from estimator.packaged import sentence
from estimator.recordings.datasets import create, extend
from estimator.recordings.journal import ARRIVED, ATTRIBUTES, ROWS, Entry, Journal, is_sound, journal_of, sync
from estimator.recordings.recording import (
    DEVICES,
    FORMAT,
    FORMAT_VERSION,
    IDENTITY,
    LAYOUT,
    ImuData,
    Recording,
)
from estimator.recordings.reference import Reference, TableUncertainty
from estimator.recordings.reserved_space import Ballast
from estimator.types import Floats
from estimator.untrusted import harmless

_RESERVE_BYTES = 2_000_000  # reserved on the disk: for pending rows, and for HDF5 to close a file completely
_CLOSING_BYTES = 300_000  # of them, HDF5's own
_ATTRIBUTES_BYTES = 100_000  # and for attributes, in addition
_PLENTY_BYTES = 100_000_000  # more than another program takes while one block is written
_CACHE_BYTES = 131_072  # of each dataset: rows go to its end
TEXT_BYTES = 240


class RecordingWriter:
    """Writes a recording during the run.

    Rows are collected until ``flush`` and appended in blocks. With a journal beside it, only data that have not been
    written there can be lost; a file that was closed completely needs none.
    """

    def __init__(self, path: Path, attributes: Mapping[str, Any], *, journal: bool = False) -> None:
        """Create the file with its attributes and reserve space for closing it; folders are created as needed.

        With ``journal`` one is created beside it, and both carry the same identity, so that no other journal is used
        for it: the ``IDENTITY`` in the attributes, or a random one. RecordingError if the file or its journal exists or
        cannot be created, or the disk is full; then no file is left behind.
        """
        self.path = path
        self.complete = False
        """Whether it has been closed with all that was taken; not so once rows have been dropped."""
        self._dropped = False
        self.journal: Journal | None = None
        self._unwritten: list[Entry] = []
        self._noting = threading.Lock()  # ``write_journal`` takes in one thread the notes of others
        self._pending: dict[str, list[Mapping[str, NDArray[Any]]]] = {}
        self._datasets: dict[str, Any] = {}
        self._lengths: dict[str, int] = {}
        self._units: dict[str, str] = {}  # of columns that LAYOUT does not know
        with ExitStack() as undone:
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
                self._ballast = Ballast(path.parent, _RESERVE_BYTES)
                undone.callback(self._ballast.close)
                if not self._ballast.hold():
                    raise self._full()
                if journal:
                    self.journal = Journal(path)
                    undone.callback(self.journal.close, remove=True)
                self._file = h5py.File(path, "x", rdcc_nbytes=_CACHE_BYTES)
            except FileExistsError as error:
                if error.filename != str(journal_of(path)):
                    raise RecordingError(f"cannot create {path}: {first_line(error)}") from None
                raise RecordingError(sentence("recordings.left_journal", journal=error.filename, path=path)) from None
            except (OSError, ValueError) as error:
                raise RecordingError(f"cannot create {path}: {first_line(error)}") from None
            undone.callback(self._remove)
            self._file.attrs.update({"format": FORMAT, "format_version": 1})
            identity = {IDENTITY: secrets.token_hex(16)} if journal and IDENTITY not in attributes else {}
            self.set_attributes(identity | dict(attributes))
            self.flush()
            self.write_journal()
            undone.pop_all()

    def _remove(self) -> None:
        """Close the file, complete or not, and remove it."""
        with suppress(OSError, RuntimeError):
            self._file.close()
        self.path.unlink(missing_ok=True)

    def set_attributes(self, attributes: Mapping[str, Any], group: str = "/") -> None:
        """Set attributes of the file, or of a group, which is created if necessary.

        RecordingError for attributes that the journal cannot hold.
        """
        self._note(ATTRIBUTES, group, attributes)
        self._file.require_group(group).attrs.update(attributes)

    def add_table(
        self, gimbals: tuple[str, ...], uncertainty: TableUncertainty | None = None, rate_window_ns: int = 0
    ) -> None:
        """Declare the table: gimbals outermost first, the window (ns) over which its rates are means, the uncertainty,
        and that of its level only if it is not 0.
        """
        stated = asdict(uncertainty) if uncertainty is not None else {}
        if not stated.get("level_rad"):
            stated.pop("level_rad", None)  # nobody stated it
        attributes = {f"u_{key}": value for key, value in stated.items()}
        named = {"axes": gimbals, "gimbals": gimbals, "rate_window_ns": rate_window_ns}
        self.set_attributes({**attributes, **named}, "table")

    def add_source(self, name: str, array: SensorArray, prior: Prior, attributes: Mapping[str, Any]) -> None:
        """Declare a source with the axes of its channels, and the prior from its data sheet."""
        axes = {"p": array.p, "j": array.j, "k": array.k}
        self.set_source(name, {"prior": astuple(prior), "names": list(array.names), **axes, **attributes})

    def add_accelerometers(self, name: str, axes: Floats) -> None:
        """Declare the axes (c, 3) in the body of the accelerometers of a source, whose outputs are ``accel_mps2``."""
        self.set_attributes({"format_version": FORMAT_VERSION})
        self.set_source(name, {"accel_axes": axes})

    def add_device(self, name: str, columns: Mapping[str, str], attributes: Mapping[str, Any]) -> None:
        """Declare the group ``device/NAME``: its attributes, and the columns of its series with their units.

        RecordingError for a column ``t_ns``, a name with "/", or one that ``LAYOUT`` has for several numbers a row.
        """
        for column in columns:
            known = LAYOUT.get(column, {})
            if "/" in column or column == "t_ns" or known.get("dimensions", 1) > 1:
                raise RecordingError(f"device {name}: a series cannot have a column {column!r}: take another name")
        group = f"{DEVICES}/{name}"
        described = {"columns": list(columns), "units": list(columns.values())} if columns else {}
        self.set_attributes({**attributes, **described}, group)
        self._units |= {f"{group}/{column}": unit for column, unit in columns.items()}

    def append_series(self, name: str, t_ns: int, values: Mapping[str, float]) -> None:
        """Append one row to the series of a device that has been declared."""
        columns = {column: np.array([value], dtype=np.float64) for column, value in values.items()}
        self.append_rows(f"{DEVICES}/{name}", {"t_ns": np.array([t_ns], dtype=np.int64), **columns})

    def set_source(self, name: str, attributes: Mapping[str, Any]) -> None:
        """Set attributes of a source, for instance its counts of lost samples."""
        self.set_attributes(attributes, f"imu/{name}")

    def note_source(self, name: str, attributes: Mapping[str, Any]) -> None:
        """Write to the journal the attributes that a source would get if the run ended now."""
        self._note(ATTRIBUTES, f"imu/{name}", attributes)

    def append_rows(self, group: str, columns: Mapping[str, NDArray[Any]]) -> None:
        """Append rows to datasets of a group, created by the first rows; if interrupted, none are appended.

        They are collected until the next flush. RecordingError for rows that the journal cannot hold.
        """
        self._note(ROWS, group, columns)
        self._pending.setdefault(group, []).append(columns)

    def arrived(self, group: str, arrival_ns: NDArray[Any], rate_rps: NDArray[Any]) -> None:
        """Keep in the journal samples that have no time yet: lost with the process they would be, and were here."""
        self._note(ARRIVED, group, {"arrival_ns": arrival_ns, "rate_rps": rate_rps})

    def _note(self, kind: int, group: str, values: Mapping[str, Any]) -> None:
        if self.journal is None:
            return
        if not is_sound((kind, group, values)):  # written entries must be readable again
            raise RecordingError(sentence("recordings.not_held", group=group, names=", ".join(map(str, values))))
        with self._noting:
            self._unwritten.append((kind, group, values))

    def append_text(
        self, group: str, t_ns: Mapping[str, int], field_name: str, text: str, **more: NDArray[Any]
    ) -> None:
        """Append one row of stamps, one text (cut at 240 bytes) and ``more`` to a group such as events or steps."""
        raw = text.encode()[:TEXT_BYTES].decode(errors="ignore").encode()
        stamps = {key: np.array([value], dtype=np.int64) for key, value in t_ns.items()}
        self.append_rows(group, {**stamps, field_name: np.array([raw], dtype=f"S{TEXT_BYTES}"), **more})

    def write_journal(self) -> None:
        """Write all new entries to the journal, from any thread, with attributes first and rows of a group joined.

        RecordingError if that fails: the journal then lacks these entries. Nothing without a journal or new entries.
        """
        with self._noting:
            entries, self._unwritten = self._unwritten, []
        if self.journal is None or not entries:
            return
        attributes = [entry for entry in entries if entry[0] == ATTRIBUTES]
        rows: dict[tuple[int, str], list[Mapping[str, Any]]] = {}
        for kind, group, values in entries:
            if kind != ATTRIBUTES:
                rows.setdefault((kind, group), []).append(values)
        joined = [(*key, _joined(blocks)) for key, blocks in rows.items()]
        with _told_of(self.path):
            self.journal.write([*attributes, *joined])

    def flush(self) -> None:
        """Write pending rows and hand them to the operating system; RecordingError as for ``flushing``."""
        for _ in self.flushing():
            pass

    def flushing(self) -> Iterator[None]:
        """Flush in parts, one per group; rows may be appended between them, and are then written later.

        A write that fails within HDF5 leaves an unreadable file or ends the process. If the disk is nearly full,
        pending rows are therefore written at once into the reserved space, and RecordingError is raised if that space
        cannot be had again. If they do not fit, or the limit of the file size is near, they are dropped and
        RecordingError is raised.
        """
        wanted = self._pending_bytes()
        if self._allowed_bytes() < wanted + _RESERVE_BYTES:
            self._drop()
            raise RecordingError(sentence("recordings.file_limit", path=self.path))
        free = shutil.disk_usage(self.path.parent).free
        if free > wanted + _PLENTY_BYTES:
            yield from self._writing()
            return
        if free + self._ballast.held_bytes < wanted + _CLOSING_BYTES:
            self._drop()
            raise self._full()
        self._ballast.drop()
        self._write()
        if not self._ballast.hold():
            raise self._full()

    def _drop(self) -> None:
        """Give up the pending rows, which the journal may hold."""
        self._dropped |= bool(self._pending)
        self._pending.clear()

    def _full(self) -> RecordingError:
        kept = f"{_RESERVE_BYTES / 1e6:.0f} MB are reserved for closing the file"
        return _disk_full(self.path, f"{kept}). Free some space, or choose another disk with --output")

    def _allowed_bytes(self) -> float:
        """Return by how much the process may still let the file grow, regardless of the disk; infinite without a
        limit.
        """
        if sys.platform == "win32":
            return math.inf
        import resource

        most, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        return math.inf if most == resource.RLIM_INFINITY else most - self.path.stat().st_size

    def _pending_bytes(self) -> int:
        return sum(rows.nbytes for blocks in self._pending.values() for block in blocks for rows in block.values())

    def _write(self) -> None:
        for _ in self._writing():
            pass

    def _writing(self) -> Iterator[None]:
        """Write the pending rows of one group after the other, yielding after each, then flush the file.

        A write that is interrupted is repeated next time; RecordingError if one fails.
        """
        for group in tuple(self._pending):
            with _told_of(self.path):
                blocks, lengths = self._pending[group], {}
                for name, rows in _joined(blocks).items():
                    path = f"{group}/{name}"
                    if path not in self._datasets:
                        self._datasets[path], lengths[path] = self._created(path, rows), len(rows)
                    else:
                        lengths[path] = extend(self._datasets[path], self._lengths.get(path, 0), rows)
                # At once: an interrupted write is repeated from its beginning the next time.
                self._lengths, self._pending[group] = {**self._lengths, **lengths}, []
            yield
        self._pending = {group: blocks for group, blocks in self._pending.items() if blocks}
        with _told_of(self.path):
            self._file.flush()

    def _created(self, path: str, rows: NDArray[Any]) -> Any:
        dataset = create(self._file, path, rows, growing=True)
        if unit := self._units.get(path):
            dataset.attrs["units"] = unit
        return dataset

    def close(self) -> None:
        """Flush if there is room, and close; harmless if closed already.

        No error is raised: ``complete`` says whether all rows are written.
        """
        if self._file:
            self._ballast.close()
            with suppress(RecordingError):
                room = min(shutil.disk_usage(self.path.parent).free, self._allowed_bytes())
                if room >= self._pending_bytes() + _CLOSING_BYTES:
                    self._write()
            with suppress(RecordingError), _told_of(self.path):
                self._file.close()
                self.complete = not self._pending and not self._dropped

    def finish(self, *, synced: bool = True) -> None:
        """Close the journal, and remove it if the file is ``complete``, after syncing that unless ``synced`` is false.

        To be called after ``close``. The journal of an incomplete file stays, which is no error. That of a file that
        cannot be synced stays, too, with RecordingError; the file then no longer counts as complete. Nothing happens
        without a journal.
        """
        if self.journal is not None:
            try:
                with _told_of(self.path):
                    if self.complete and synced:
                        sync(self.path)
            except RecordingError:
                self.complete = False
                raise
            finally:
                self.journal.close(remove=self.complete)


def _joined(blocks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the columns of blocks of rows, of which not all need to have each."""
    names = dict.fromkeys(name for block in blocks for name in block)
    return {name: np.concatenate([block[name] for block in blocks if name in block]) for name in names}


def write_recording(path: Path | str, recording: Recording) -> None:
    """Write a complete recording, such as an imported one: attributes, site, reference, sources, series of devices.

    Innovations are not written. RecordingError if the file exists, cannot be created, or has no room for all rows; in
    the last case it is removed.
    """
    path = Path(path)
    writer = RecordingWriter(path, recording.attributes)
    try:
        _write_parts(writer, recording)
        writer.flush()
        writer.close()
        if not writer.complete:
            raise RecordingError(sentence("recordings.not_completed", path=path))
    except BaseException:
        writer.close()
        path.unlink(missing_ok=True)
        raise


def _write_parts(writer: RecordingWriter, recording: Recording) -> None:
    """Declare and append all parts of a recording but its attributes and innovations."""
    if recording.site is not None:
        writer.set_attributes(site_attributes(recording.site))
    reference = recording.reference
    table = recording.table
    if table is not None:
        writer.add_table(table.gimbals, table.uncertainty, table.rate_window_ns)
    root = "reference" if table is None else "table"
    writer.append_rows(root, columns_of(reference))
    for source, data in recording.sources.items():
        attributes: dict[str, Any] = {"lost": data.lost} | ({"device": data.device} if data.device else {})
        if data.noise is not None:
            attributes["noise"] = astuple(data.noise)
        attributes |= data.mounting.attributes
        writer.add_source(source, data.array, data.prior, attributes)
        if data.accel_axes is not None:
            writer.add_accelerometers(source, data.accel_axes)
        if data.accel_sheet is not None:
            writer.set_source(source, data.accel_sheet.attributes)
        writer.append_rows(f"imu/{source}", columns_of(data))
    for device, series in recording.series.items():
        writer.add_device(device, series.units, {})
        writer.append_rows(f"{DEVICES}/{device}", {"t_ns": series.t_ns, **series.columns})


def site_attributes(site: Site) -> dict[str, float]:
    """Return the attributes of a recording that state a site; height only if it is not 0, gravity only if stated."""
    attributes = {"site_latitude_rad": site.latitude_rad, "site_heading_rad": site.heading_rad}
    if site.height_m:
        attributes["site_height_m"] = site.height_m
    if site.gravity_mps2 is not None:
        attributes["site_gravity_mps2"] = site.gravity_mps2
    return attributes


def columns_of(readings: ImuData | Reference) -> dict[str, Any]:
    """Return the arrays of a source or a reference by name, those that are there."""
    values = {column.name: getattr(readings, column.name) for column in fields(readings)}
    return {name: column for name, column in values.items() if name in LAYOUT and isinstance(column, np.ndarray)}


def write_results(path: Path, group: str, datasets: Mapping[str, NDArray[Any]], attributes: Mapping[str, Any]) -> None:
    """Write a group of results into an existing recording, replacing an earlier one of this name.

    RecordingError if that fails, also for lack of space.
    """
    wanted = sum(np.asarray(values).nbytes for values in datasets.values())
    with _changing(path, wanted + _CLOSING_BYTES) as file:
        if group in file:
            del file[group]
        held = file.create_group(group)
        held.attrs.update(attributes)
        for name, values in datasets.items():
            create(held, name, np.asarray(values), growing=False)


def write_attributes(path: Path, attributes: Mapping[str, Any], *sources: tuple[str, Mapping[str, Any]]) -> None:
    """Set attributes of an existing recording, and of ``sources`` by name; RecordingError if it cannot be written."""
    with _changing(path, _ATTRIBUTES_BYTES) as file:
        file.attrs.update(attributes)
        for name, own in sources:
            file[f"imu/{name}"].attrs.update(own)


def _disk_full(path: Path, needed: str) -> RecordingError:
    free = shutil.disk_usage(path.parent).free
    return RecordingError(f"the disk of {path} is full ({free / 1e6:.1f} MB left, {needed}")


@contextmanager
def _changing(path: Path, wanted_bytes: int) -> Iterator[Any]:
    """Open an existing recording to write into it; RecordingError, with the file unchanged, if the disk is full."""
    if shutil.disk_usage(path.parent).free < wanted_bytes:
        raise _disk_full(path, f"{wanted_bytes / 1e6:.1f} MB are needed): the file is unchanged. Free some space")
    with _told_of(path), h5py.File(path, "r+") as file:
        yield file


@contextmanager
def _told_of(path: Path) -> Iterator[None]:
    """Turn errors of HDF5 and the system within this context into RecordingError, which names ``path`` and says why."""
    try:
        yield
    except (OSError, RuntimeError) as error:  # HDF5 has both
        number = getattr(error, "errno", None)
        why = os.strerror(number) if number else first_line(error)
        raise RecordingError(f"{path} cannot be written: {why}") from None


def plain(value: Any) -> Any:
    """Return a value from an HDF5 file as Python's own: text, number, or array."""
    if isinstance(value, bytes):
        value = value.decode(errors="replace")
    value = value.item() if isinstance(value, np.generic) else value
    return harmless(value) if isinstance(value, str) else value
