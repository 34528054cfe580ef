"""Recordings made elsewhere: foreign files and a mapping become one recording, or are refused with a reason."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.clocks.spans import Refused, Span, turn_spans
from estimator.importing.clocks.timefit import TimeFit, fit_times, regular_times
from estimator.importing.clocks.two_clocks import ahead_by_motion, clocks_apart
from estimator.importing.columns import Table, read_table
from estimator.importing.fitting import fitted
from estimator.importing.foreign_rows import ForeignRows, foreign_reference, reference_rows
from estimator.importing.mapping.columns import UNITS
from estimator.importing.mapping.mapping import Extent, FileFormat, Mapping, ReferenceFile, Timing
from estimator.importing.mapping.reference import Gravity, Measured, Rests
from estimator.importing.rest_import import PartRests, earth_note, part_rests, rests_text
from estimator.importing.text_rows import Wanted
from estimator.observations.defects.held import updates
from estimator.observations.defects.odd_samples import without_odd
from estimator.observations.poses import accelerometer_note, directions_up
from estimator.observations.turned import Turned
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Poses, RateReadings, Reference, Turns
from estimator.types import Floats

SOURCE = "imu"
"""Name of the one source of an imported recording."""
_BESIDE_S = 1.0  # of a reference in a file of its own before and behind the samples that is kept
_LEAST_STEP_S, _LARGEST_STEP_S = 1e-6, 3600.0  # no samples are nearer or further apart
_LEAST_USUAL_S, _LARGEST_USUAL_S = 5e-5, 2.0
_EQUAL_RPS, _COARSE_SHARE = 1e-9, 1 / 3  # of samples equal to the one before: at 0.28 a step is one sigma
_GAPS_SHARE = 0.1  # of the rows; where more are further apart the sampling is uneven
_GAP_S = 10.0  # between files that follow each other: longer than what corrects or correlates within one
_UNIT_ROW = {"rad/s": ("rad/s", "rps"), "deg/s": ("deg/s", "dps", "°/s", "degree/s", "degrees/s")}


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """What became of foreign files; ``notes`` tell what a person should know of it, also kept in the recording.

    ``refused`` are files and sections of files, ``lost_files`` how many files gave nothing.
    """

    recording: Recording
    refused: tuple[Refused, ...]
    notes: tuple[str, ...] = ()
    lost_files: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """One file: what was measured, with instants from its first sample, and what is to be told of it."""

    name: str
    time: TimeFit
    skipped_lines: int
    t_s: Floats
    rate_rps: Floats
    accel_mps2: Floats | None
    temperature_c: Floats | None
    reference: ForeignRows | None
    spans: tuple[Span, ...]
    rests: PartRests | None
    notes: tuple[str, ...]


def import_recording(mapping: Mapping, data_paths: Sequence[Path]) -> Imported:
    """Return one recording of the files, in the order given, and what was refused.

    A file that cannot be used is refused and the others are taken. Raises RecordingError, with every reason,
    when nothing is left.
    """
    if not data_paths:
        raise RecordingError("no data files are given: name at least one beside the mapping")
    if mapping.reference_file:  # "*.csv" names the references, too
        others = {other for path in data_paths if (other := mapping.reference_file.beside(path)) != path}
        data_paths = [path for path in data_paths if path not in others]
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
    return replace(_joined(mapping, parts, tuple(refused)), lost_files=len(data_paths) - len(parts))


def _read_part(mapping: Mapping, path: Path) -> tuple[_Part | None, list[Refused]]:
    table = _read_columns(mapping, path)
    gyro, reference = mapping.gyro, mapping.reference
    rate = table.values(gyro.columns, "[gyro] columns")
    accel = table.values(mapping.accelerometer, "[accelerometer] columns") if mapping.accelerometer else None
    warmth = table.values(mapping.temperature, "[temperature] column") if mapping.temperature else None
    told = reference_rows(reference, table) if isinstance(reference, Measured) and not mapping.reference_file else None
    for what, other in (("accelerometer", accel), ("temperature", warmth), ("reference", told)):
        if other is not None and len(other) != len(rate):
            raise RecordingError(f"{path.name} has {len(rate)} gyro rows but {len(other)} {what} rows")
    beside = [other for other in (accel, warmth, told) if other is not None]
    time = _times(mapping.timing, mapping.format, table, np.hstack([rate, *beside]))
    if not np.isfinite(rate[time.rows]).any(axis=0).all():
        raise RecordingError(f"{path.name} has a gyro column without a single number: check [gyro] columns")
    notes = [*_line_notes(table, time), *_unit_notes(mapping, table)]
    spans, refused = turn_spans(mapping, path, table, time, rate)
    # Logs of several devices have rows without this one; a gyro that is read too often repeats itself.
    own = np.flatnonzero(np.isfinite(rate[time.rows]).any(axis=1))
    fresh = updates(rate[time.rows[own]])
    if fresh is not None:
        notes.append(_held_note("the gyro", fresh, time.t_s[own]))
        own = own[fresh]
    kept, odd = without_odd("gyro", time.t_s[own], rate[time.rows[own]], gyro.array.names)
    notes += [*_missing_notes(time.t_s[own]), *odd, *_coarse_notes(gyro.array.names, rate[time.rows[own]])]
    own = own[kept]
    rows, t_s = time.rows[own], time.t_s[own]
    accel, warmth = (_filled(table, time, own, v, w) for v, w in ((accel, "accelerometer"), (warmth, "temperature")))
    rests = None
    if isinstance(reference, Rests):
        rests, left_out = part_rests(mapping, reference, path, table, time, own, rate[rows], accel)
        refused = [*refused, *left_out]
        notes.extend(rests.notes)
    if spans == [] or (rests is not None and not rests.rests):
        return None, refused
    known: ForeignRows | None = None
    if rests is not None:
        known = t_s, rests.rate_rps
    elif mapping.reference_file is not None:
        known = _rows_beside(mapping, mapping.reference_file, path, time, (t_s, rate[rows]), notes)
    elif told is not None:
        known = _readings(mapping, time.t_s, told[time.rows], notes)
    warm = None if warmth is None else warmth[:, 0]
    measured = (time, table.skipped_lines, t_s, rate[rows], accel, warm)
    return _Part(path.name, *measured, known, tuple(spans or ()), rests, tuple(notes)), refused


def _readings(mapping: Mapping, t_s: Floats, values: Floats, notes: list[str]) -> ForeignRows:
    """Return the rows of a reference that are readings: neither held, nor spikes, nor the one before again."""
    if (fresh := updates(values)) is not None:
        notes.append(_held_note("the reference", fresh, t_s))
        t_s, values = t_s[fresh], values[fresh]
    assert isinstance(mapping.reference, Measured)
    turned = mapping.reference.kind == "angle"  # 359 deg beside 0 is no spike
    kept, odd = without_odd("reference", t_s, np.hstack([np.cos(values), np.sin(values)]) if turned else values)
    notes += odd
    return t_s[kept], values[kept]


def _rows_beside(
    mapping: Mapping, other: ReferenceFile, path: Path, time: TimeFit, gyros: ForeignRows, notes: list[str]
) -> ForeignRows:
    """Return the rows of a reference in a file of its own, on the time of the data file ``path``.

    Two columns of stamps are of clocks that may run apart; without stamps on one side both files begin together.
    """
    name = other.beside(path).name
    assert isinstance(mapping.reference, Measured)
    table = read_table(other.beside(path), other.format, _wanted(other.timing, mapping.reference.columns.names))
    values = reference_rows(mapping.reference, table)
    fit = _times(other.timing, other.format, table, values)
    notes += [f"{name}: {note}" for note in [fit.text, *_line_notes(table, fit)]]
    t_s, values = _readings(mapping, fit.t_s + (other.offset_s or 0.0), values[fit.rows], notes)
    if fit.zero_s is not None and time.zero_s is not None:
        t_s += fit.zero_s - time.zero_s
    outputs, array = Turned.of_rates(_ns(gyros[0]), gyros[1]), mapping.gyro.array
    if other.offset_s is None:
        body = _turned(mapping, t_s, values)
        t_s -= ahead_by_motion(outputs, body, array.p, signed=not mapping.gyro.sign_from_data)
        when = f"{abs(t_s[0] - time.t_s[0]):.4g} s {'before' if t_s[0] < time.t_s[0] else 'after'}"
        notes.append(f"{name} begins {when} {path.name}, by the motion")
    first, last = float(time.t_s[0]), float(time.t_s[-1])
    shared = (t_s >= first - _BESIDE_S) & (t_s <= last + _BESIDE_S)
    if shared.sum() < 2:
        raise RecordingError(
            f"{name} lasts from {t_s[0]:.6g} to {t_s[-1]:.6g} s of the time of {path.name}, whose samples last from "
            f"{first:.6g} to {last:.6g} s: check unit, or state offset_s, which is added to its stamps, in "
            "[reference.time]"
        )
    t_s, values = t_s[shared], values[shared]
    body = _turned(mapping, t_s, values)
    if apart := clocks_apart(outputs, body, array.p, signed=not mapping.gyro.sign_from_data):
        notes.append(apart.told(name, max(first, float(t_s[0]))))
        t_s = apart.put_right(t_s)
    missing = max(t_s[0] - first, 0.0) + max(last - t_s[-1], 0.0)
    if missing > _BESIDE_S:
        notes.append(f"{name} does not cover {missing:.3g} of {last - first:.6g} s")
    return t_s, values


def _turned(mapping: Mapping, t_s: Floats, values: Floats) -> Turned:
    assert isinstance(mapping.reference, Measured)
    return Turned.of_reference(foreign_reference(mapping.reference, _ns(t_s), values), None)


def _wanted(timing: Timing, others: Sequence[str], labels: tuple[str, ...] = ()) -> Wanted:
    needed = timing.stamps.names if timing.stamps else (timing.rate,) if isinstance(timing.rate, str) else ()
    return Wanted(needed, tuple(others), labels, timing.calendar)


def _read_columns(mapping: Mapping, path: Path) -> Table:
    others, reference = list(mapping.gyro.columns.names), mapping.reference
    others += mapping.accelerometer.names if mapping.accelerometer else ()
    others += mapping.temperature.names if mapping.temperature else ()
    if isinstance(reference, Measured) and mapping.reference_file is None:
        others += reference.columns.names
    label = None if isinstance(reference, Measured) else reference.cuts.column
    return read_table(path, mapping.format, _wanted(mapping.timing, others, (label,) if label else ()))


def _times(timing: Timing, file_format: FileFormat, table: Table, values: Floats) -> TimeFit:
    """Return the instants of the part of the file that is read; its rows are numbered as in the file."""
    position = np.arange(len(values)) if table.position is None else table.position
    extent = file_format.extent
    read = np.flatnonzero((position >= extent.from_row) & (position < extent.until_row))
    if len(read) < 2:
        check = "check from_row and until_row in [file]" if file_format.extent != Extent() else "record more"
        raise RecordingError(f"{table.name} has {len(values)} row{'s' * (len(values) != 1)} to read: {check}")
    time = _all_times(timing, table, position, read, values)
    kept = (time.t_s >= extent.from_s) & (time.t_s <= extent.until_s)
    if kept.sum() < 2:
        raise RecordingError(f"{table.name} lasts {time.t_s[-1]:.6g} s: check from_s and until_s in [file]")
    return replace(time, t_s=time.t_s[kept], rows=read[time.rows][kept])


def _all_times(
    timing: Timing, table: Table, position: NDArray[np.int64], read: NDArray[np.intp], values: Floats
) -> TimeFit:
    if timing.stamps is not None:
        stamps = table.values(timing.stamps, "[time] column")[:, 0]
        if timing.wraps_at < np.inf:
            stamps = np.unwrap(stamps, period=timing.wraps_at * timing.stamps.scale)
        if len(stamps) != len(values):
            raise RecordingError(f"{table.name} has {len(values)} rows but {len(stamps)} stamps")
        try:
            fit = fit_times(stamps[read], values[read], position[read])
        except RecordingError as error:
            raise RecordingError(f"{table.name} {error}") from None
        if not _LEAST_STEP_S < (step_s := float(np.median(np.diff(fit.t_s)))) < _LARGEST_STEP_S:
            raise RecordingError(f"{table.name}: its samples are {step_s:.6g} s apart by [time]: correct its unit")
        return fit
    rate_hz = table.number(timing.rate) if isinstance(timing.rate, str) else timing.rate
    if rate_hz <= 0:
        raise RecordingError(f"{table.name}: {timing.rate} is {rate_hz}, not a sample rate in Hz")
    return regular_times(position[read], rate_hz)


def _line_notes(table: Table, time: TimeFit) -> list[str]:
    notes = [*table.notes]
    if table.skipped_lines:
        lines = "line is" if table.skipped_lines == 1 else "lines are"
        notes.append(f"{table.skipped_lines} broken {lines} left out, the first is {table.first_skipped}")
    if time.doubled:
        notes.append(f"{time.doubled} rows are left out that were written twice")
    if not _LEAST_USUAL_S < (step_s := float(np.median(np.diff(time.t_s)))) < _LARGEST_USUAL_S:
        notes.append(f"its samples are {step_s:.3g} s apart by [time]: if that is not so, correct its unit")
    return notes


def _unit_notes(mapping: Mapping, table: Table) -> list[str]:
    columns = mapping.gyro.columns
    said = {table.units.get(name, "").lower() for name in columns.names}
    return [
        f"the row of units says {unit} of the gyro, the mapping does not: check unit in [gyro]"
        for unit, spellings in _UNIT_ROW.items()
        if not columns.raw and columns.scale != UNITS["rate"][unit] and said & set(spellings)
    ]


def _coarse_notes(names: Sequence[str], rate: Floats) -> list[str]:
    notes = []
    for name, steps in zip(names, np.abs(np.diff(rate, axis=0)).T, strict=True):
        step = float(np.degrees(steps[steps > _EQUAL_RPS].min(initial=np.inf)))
        if np.isfinite(step) and np.mean(steps <= _EQUAL_RPS) > _COARSE_SHARE:
            notes.append(
                f"{name}: its steps of {step:.3g} deg/s are coarser than its noise: at a steady rate, means of many "
                "samples are no better than a step"
            )
    return notes


def _held_note(what: str, fresh: NDArray[np.intp], t_s: Floats) -> str:
    each_hz = (len(fresh) - 1) / float(t_s[fresh[-1]] - t_s[fresh[0]])
    return f"{what} is new in one row of {len(t_s) / len(fresh):.2g} ({each_hz:.3g} Hz); rows between are left out"


def _missing_notes(t_s: Floats) -> list[str]:
    """Return, in words, how many samples are missing between others."""
    steps = np.diff(t_s)
    short = np.round(steps / np.median(steps)) - 1
    if not 0 < (gaps := int(np.count_nonzero(short > 0))) < _GAPS_SHARE * len(t_s):
        return []
    count, worst = int(short[short > 0].sum()), int(np.argmax(steps))
    return [
        f"{count} samples ({100 * count / (len(t_s) + count):.1f} %) are missing in {gaps} gaps, the longest "
        f"{steps[worst]:.3g} s at {t_s[worst] + np.median(steps):.4g} s"
    ]


def _filled(table: Table, time: TimeFit, own: NDArray[np.intp], values: Floats | None, what: str) -> Floats | None:
    """Return values (rows, m) at the rows of the gyro, with blanks filled from their neighbours in time."""
    if values is None:
        return None
    kept = values[time.rows]
    whole = np.asarray(np.isfinite(kept).all(axis=1))
    if not whole.any():
        raise RecordingError(f"{table.name} has not one whole row of the {what}: check [{what}]")
    if whole[own].all():
        return kept[own]
    at, t_s = time.t_s[own], time.t_s[whole]
    return np.column_stack([np.interp(at, t_s, column) for column in kept[whole].T])


def _joined(mapping: Mapping, parts: list[_Part], refused: tuple[Refused, ...]) -> Imported:
    starts_s = [-float(parts[0].time.t_s[0])]
    for before, part in pairwise(parts):
        starts_s.append(starts_s[-1] + float(before.time.t_s[-1]) + _GAP_S - float(part.time.t_s[0]))
    placed = list(zip(parts, starts_s, strict=True))
    data = ImuData(
        mapping.gyro.array,
        np.concatenate([_ns(part.t_s + start) for part, start in placed]),
        np.vstack([part.rate_rps for part in parts]),
        temperature_c=_stack([part.temperature_c for part in parts]),
        accel_mps2=_stack([part.accel_mps2 for part in parts]),
    )
    earth = mapping.earth_rate
    poses = _poses(mapping.reference.gravity, placed) if isinstance(mapping.reference, Rests) else None
    reference = poses or _reference(mapping, placed)
    recording = Recording({SOURCE: data}, reference, mapping.site if earth else None)
    recording, found, factors = fitted(recording, SOURCE, mapping.gyro)
    notes = [f"{part.name}: {note}" if len(parts) > 1 else note for part in parts for note in part.notes] + found
    notes += [accelerometer_note(poses)] if poses else []
    if earth and isinstance(mapping.reference, Rests):
        notes += earth_note(mapping, [part.rests for part in parts if part.rests])
    elif mapping.site and not earth:
        add = isinstance(mapping.reference, Rests) or (
            isinstance(mapping.reference, Measured) and mapping.reference.kind == "angle"
        )
        how = "add earth_rate = true to [reference]" if add else "Earth rate is for kind = angle and rest"
        notes.append(f"the site is not used: {how}")
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
        "imported": "\n".join(notes),
        "rests": rests_text([(part.rests, start) for part, start in placed if part.rests]),
        "gyro_factor": factors,
    }
    kept = {key: value for key, value in attributes.items() if isinstance(value, (int, np.ndarray)) or value}
    return Imported(Recording(recording.sources, recording.reference, recording.site, kept), refused, tuple(notes))


def _reference(mapping: Mapping, placed: list[tuple[_Part, float]]) -> Reference:
    rows = [(part.reference, start) for part, start in placed if part.reference]
    if rows:
        t_ns = np.concatenate([_ns(t_s + start) for (t_s, _), start in rows])
        values = np.vstack([values for (_, values), _ in rows])
        if isinstance(mapping.reference, Measured):
            return foreign_reference(mapping.reference, t_ns, values)
        return RateReadings(t_ns, values)
    spans = [(span, start) for part, start in placed for span in part.spans]
    return Turns(
        _ns(np.array([start + span.start_s for span, start in spans])),
        _ns(np.array([start + span.end_s for span, start in spans])),
        np.array([span.turn_rad for span, _ in spans]),
        np.array([span.sd_rad for span, _ in spans]),
    )


def _poses(gravity: Gravity | None, placed: list[tuple[_Part, float]]) -> Poses | None:
    """Return the rests of all files with the directions up that their accelerometer gives."""
    if gravity is None:
        return None
    force: list[Floats] = []
    limits_s: list[Floats] = []
    for part, start in placed:
        if part.rests is not None and part.accel_mps2 is not None:
            force += [np.nanmean(part.accel_mps2[rest.first : rest.stop], axis=0) for rest in part.rests.rests]
            limits_s += [np.array(own) + start for own in part.rests.limits_s]
    limits = np.array(limits_s)
    up, doubt, shifts = directions_up(np.array(force), from_rests=gravity.from_rests)
    sd = np.full(len(up), np.hypot(doubt, gravity.sd_rad))
    return Poses(_ns(limits[:, 0]), _ns(limits[:, 1]), up, sd, shifts)


def _ns(t_s: Floats) -> NDArray[np.int64]:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)


def _stack(parts: list[Floats | None]) -> Floats | None:
    present = [part for part in parts if part is not None]
    return np.concatenate(present) if present else None
