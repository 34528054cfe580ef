"""Recordings made elsewhere: foreign files and a mapping become one recording, or are refused with a reason."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.columns import Table, read_table
from estimator.errors import RecordingError
from estimator.mapping import AttitudeColumns, Mapping, RateColumns, SectionTurns
from estimator.recording import ImuData, Recording
from estimator.reference import AttitudeReadings, RateReadings, Reference, Turns
from estimator.spans import Refused, Span, turn_spans
from estimator.timefit import TimeFit, fit_times, regular_times

Floats = NDArray[np.float64]

SOURCE = "imu"
"""Name of the one source of an imported recording."""
_GAP_S = 1.0  # between files that follow each other in one recording
_NORM_OFF = 0.05  # an attitude whose length is this far from 1 is a lost one


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """What became of foreign files."""

    recording: Recording
    refused: tuple[Refused, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One file: instants from its first sample, and what was measured then."""

    name: str
    time: TimeFit
    skipped_lines: int
    rate_rps: Floats
    accel_mps2: Floats | None
    temperature_c: Floats | None
    reference: Floats | None
    spans: tuple[Span, ...]


def import_recording(mapping: Mapping, data_paths: Sequence[Path]) -> Imported:
    """Return one recording of the files, in the order given, and what was refused.

    A file that cannot be used is refused and the others are taken. Raises RecordingError, with every reason,
    when nothing is left.
    """
    if not data_paths:
        raise RecordingError("no data files are given: name at least one beside the mapping")
    parts: list[_Part] = []
    refused: list[Refused] = []
    for path in data_paths:
        try:
            part, left_out = _read_part(mapping, path)
        except RecordingError as error:
            refused.append(Refused(path.name, str(error).removeprefix(path.name).removeprefix(":").strip()))
            continue
        refused.extend(left_out)
        if part is not None:
            parts.append(part)
    if not parts:
        raise RecordingError("nothing to import: " + "; ".join(str(r) for r in refused))
    return Imported(_joined(mapping, parts, refused), tuple(refused))


def _read_part(mapping: Mapping, path: Path) -> tuple[_Part | None, list[Refused]]:
    table = _read_columns(mapping, path)
    n = len(mapping.array)
    rate = table.values(mapping.gyro, n, "[gyro] columns")
    if not np.isfinite(rate).any(axis=0).all():
        raise RecordingError(f"{path.name} has a gyro column without a single number: check [gyro] columns")
    accel = table.values(mapping.accelerometer, 3, "[accelerometer] columns") if mapping.accelerometer else None
    warmth = table.values(mapping.temperature, 1, "[temperature] column")[:, 0] if mapping.temperature else None
    reference = _reference_rows(mapping, table)
    for what, other in (("accelerometer", accel), ("temperature", warmth), ("reference", reference)):
        if other is not None and len(other) != len(rate):
            raise RecordingError(f"{path.name} has {len(rate)} gyro rows but {len(other)} {what} rows")
    time = _times(mapping, table, rate)
    kept = time.rows
    spans, refused = turn_spans(mapping, path, table, time, rate)
    if spans is not None and not spans:
        return None, refused
    return (
        _Part(
            path.name,
            time,
            table.skipped_lines,
            rate[kept],
            None if accel is None else accel[kept],
            None if warmth is None else warmth[kept],
            None if reference is None else reference[kept],
            tuple(spans or ()),
        ),
        refused,
    )


def _read_columns(mapping: Mapping, path: Path) -> Table:
    needed = list(mapping.gyro.names)
    for columns in (mapping.accelerometer, mapping.temperature, mapping.timing.stamps):
        needed += columns.names if columns else ()
    if mapping.timing.rate_variable:
        needed.append(mapping.timing.rate_variable)
    reference = mapping.reference
    blank_ok = list(reference.columns.names) if isinstance(reference, (AttitudeColumns, RateColumns)) else []
    label = reference.column if isinstance(reference, SectionTurns) else None
    return read_table(path, mapping.format, needed, blank_ok, [label] if label else [])


def _times(mapping: Mapping, table: Table, rate: Floats) -> TimeFit:
    timing = mapping.timing
    if timing.stamps is not None:
        try:
            return fit_times(table.values(timing.stamps, 1, "[time] column")[:, 0], rate)
        except RecordingError as error:
            raise RecordingError(f"{table.name} {error}") from None
    rate_hz = timing.rate_hz
    if timing.rate_variable is not None:
        rate_hz = table.number(timing.rate_variable)
    if rate_hz is None or rate_hz <= 0:
        raise RecordingError(f"{table.name}: {timing.rate_variable} is {rate_hz}, not a sample rate in Hz")
    return regular_times(len(rate), rate_hz)


def _reference_rows(mapping: Mapping, table: Table) -> Floats | None:
    """Return attitudes (rows, 4) as w x y z, body to reference, or rates (rows, 3); None for turns."""
    reference = mapping.reference
    if isinstance(reference, RateColumns):
        return _some(table, table.values(reference.columns, 3, "[reference] columns"))
    if not isinstance(reference, AttitudeColumns):
        return None
    q = table.values(reference.columns, 4, "[reference] columns")
    if reference.order == "xyzw":
        q = q[:, [3, 0, 1, 2]]
    length = np.linalg.norm(q, axis=1, keepdims=True)
    q = np.where(np.abs(length - 1) < _NORM_OFF, q / np.where(length > 0, length, 1.0), np.nan)
    return _some(table, q * [1.0, -1.0, -1.0, -1.0] if reference.inverted else q)


def _some(table: Table, rows: Floats) -> Floats:
    if not np.isfinite(rows).all(axis=1).any():
        raise RecordingError(f"{table.name} has not one usable row of the reference: check [reference] columns")
    return rows


def _joined(mapping: Mapping, parts: list[_Part], refused: list[Refused]) -> Recording:
    starts_s = [0.0]
    for part in parts[:-1]:
        starts_s.append(starts_s[-1] + float(part.time.t_s[-1]) + _GAP_S)
    t_ns = np.concatenate([_ns(part.time.t_s + start) for part, start in zip(parts, starts_s, strict=True)])
    data = ImuData(
        mapping.array,
        t_ns,
        np.vstack([part.rate_rps for part in parts]),
        temperature_c=_stack([part.temperature_c for part in parts]),
        accel_mps2=_stack([part.accel_mps2 for part in parts]),
    )
    reference = _stack([part.reference for part in parts])
    attributes = {
        "device": mapping.device,
        "imported_from": ", ".join(part.name for part in parts),
        "mapping": mapping.text,
        "time_fit": "\n".join(f"{part.name}: {part.time.text}" for part in parts),
        "skipped_lines": sum(part.skipped_lines for part in parts),
        "replayed_rows": sum(part.time.replayed for part in parts),
        "refused": "\n".join(str(r) for r in refused),
        "licence": mapping.licence,
        "source": mapping.source,
    }
    kept = {key: value for key, value in attributes.items() if value != ""}
    return Recording({SOURCE: data}, _reference(mapping, t_ns, reference, parts, starts_s), None, kept)


def _reference(
    mapping: Mapping, t_ns: NDArray[np.int64], rows: Floats | None, parts: list[_Part], starts_s: list[float]
) -> Reference:
    if rows is None:
        spans = [(span, start) for part, start in zip(parts, starts_s, strict=True) for span in part.spans]
        return Turns(
            _ns(np.array([start + span.start_s for span, start in spans])),
            _ns(np.array([start + span.end_s for span, start in spans])),
            np.array([span.turn_rad for span, _ in spans]),
            np.array([span.sd_rad for span, _ in spans]),
        )
    if isinstance(mapping.reference, RateColumns):
        whole = np.isfinite(rows).all(axis=1)
        return RateReadings(t_ns[whole], rows[whole])
    return AttitudeReadings(t_ns, rows)


def _ns(t_s: Floats) -> NDArray[np.int64]:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)


def _stack(parts: list[Floats | None]) -> Floats | None:
    present = [part for part in parts if part is not None]
    return np.concatenate(present) if present else None
