"""Recordings made elsewhere: external files and a mapping become one recording, or are refused with a reason."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.clocks.arrivals import by_motion
from estimator.importing.clocks.two_clocks import ahead_by_motion, clocks_apart
from estimator.importing.columns import read_table
from estimator.importing.external_rows import ExternalRows, external_reference, reference_rows
from estimator.importing.gains import fitted
from estimator.importing.log import Log, timed, wanted
from estimator.importing.mapping.columns import UNITS, Columns
from estimator.importing.mapping.mapping import Mapping, ReferenceFile
from estimator.importing.mapping.reference import ExternalReference, Gravity, Measured, Rests, StatedTurns
from estimator.importing.resting import Rest, earth_note, rest_rates, rest_text, rests_of
from estimator.importing.spans import Refused, Span, turn_spans
from estimator.importing.table import Table
from estimator.observations.defects.faults import updates
from estimator.observations.defects.odd_samples import without_odd
from estimator.observations.poses import accelerometer_note, directions_up
from estimator.observations.turned import Turned
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Poses, RateReadings, Reference, Turns
from estimator.types import Floats

SOURCE = "imu"
"""Name of the one source of an imported recording."""
_BESIDE_S = 1.0  # of a reference in a file of its own, kept before and behind the samples
_EQUAL_RPS, _COARSE_SHARE = 1e-9, 1 / 3  # of samples equal to the one before: at 0.28 a step is one sigma
_GAPS_SHARE = 0.1  # of the rows; where more are further apart the sampling is uneven
_MOST_ALIKE = 3  # files whose notes are printed one by one, if their numbers differ
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")
_GAP_S = 10.0  # between files that follow each other: longer than any filter or correlation within one
_UNIT_ROW = {"rad/s": ("rad/s", "rps"), "deg/s": ("deg/s", "dps", "°/s", "degree/s", "degrees/s")}


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """The result of an import; ``notes`` are also stored in the recording.

    ``refused`` are files and sections that were left out, ``lost_files`` counts files without any data.
    """

    recording: Recording
    refused: tuple[Refused, ...]
    notes: tuple[str, ...] = ()
    lost_files: int = 0


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Part:
    """The data of one file, with instants from its first sample, and notes."""

    log: Log
    t_s: Floats
    rate_rps: Floats
    accel_mps2: Floats | None
    temperature_c: Floats | None
    reference: ExternalRows | None
    spans: Sequence[Span]
    rests: Sequence[Rest]
    notes: Sequence[str]


def import_recording(mapping: Mapping, data_paths: Sequence[Path]) -> Imported:
    """Return one recording of all files, in the order given, what was refused, notes, and the number of lost files.

    A file that cannot be used is refused and the others are imported; reference files among ``data_paths`` are skipped.
    RecordingError, with every reason, if nothing is left; also if no file is given or gyros are mixed up.
    """
    if not data_paths:
        raise RecordingError("no data file is given. Name at least one after the mapping")
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
    recording, notes = _joined_recording(mapping, parts, refused)
    return Imported(recording, tuple(refused), tuple(notes), len(data_paths) - len(parts))


def _read_part(mapping: Mapping, path: Path) -> tuple[_Part | None, list[Refused]]:
    """Return the data of one file (None if no section is left) and its refused sections; RecordingError if unusable.
    Left out are rows without the gyro, as in logs of several devices, rows that repeat it, and samples far off others.
    """
    reference, beside, array = mapping.reference, mapping.reference_file, mapping.gyro.array
    measured = reference if isinstance(reference, Measured) and not beside else None
    label = None if isinstance(reference, Measured) else reference.cuts.column
    table = read_table(path, mapping.format, wanted(mapping.timing, mapping.names, (label,) if label else ()))
    rate = table.values(mapping.gyro.columns, "[gyro] columns")
    felt = mapping.accelerometer if not mapping.accelerometer_file else None
    accel = table.values(felt, "[accelerometer] columns") if felt else None
    warmth = table.values(mapping.temperature, "[temperature] column") if mapping.temperature else None
    told = reference_rows(measured, table) if measured else None
    others = {"accelerometer": accel, "temperature": warmth, "reference": told}
    for what, other in others.items():
        if other is not None and len(other) != len(rate):
            raise RecordingError(f"{path.name} has {len(rate)} gyro rows but {len(other)} {what} rows")
    log = timed(path, table, mapping.timing, mapping.format, np.hstack([rate, *_present(others.values())]))
    time, left_out = log.time, list[Refused]()
    if not np.isfinite(rate[time.rows]).any(axis=0).all():
        raise RecordingError(f"{path.name} has a gyro column without any number. Check [gyro] columns")
    notes = [*log.notes, *_unit_notes(mapping, table)]
    if mapping.accelerometer_file and mapping.accelerometer:
        accel = _felt_beside(mapping.accelerometer_file, mapping.accelerometer, log, len(rate), notes)
    spans, rests, found, known = list[Span](), list[Rest](), list[str](), None
    if isinstance(reference, StatedTurns):
        spans, left_out = turn_spans(mapping, reference, log, rate)
    own = np.flatnonzero(np.isfinite(rate[time.rows]).any(axis=1))
    own = own[_new_rows("the gyro", time.t_s[own], rate[time.rows[own]], notes)]
    kept, odd = without_odd("gyro", time.t_s[own], rate[time.rows[own]], array.names)
    notes += [*_missing_notes(time.t_s[own]), *odd, *_coarse_notes(array.names, rate[time.rows[own]])]
    own = own[kept]
    rate, t_s = rate[time.rows[own]], time.t_s[own]
    accel, warmth = _interpolated(log, own, accel, "accelerometer"), _interpolated(log, own, warmth, "temperature")
    if isinstance(reference, Rests):
        rests, left_out, found = rests_of(mapping, reference, log, own, rate, accel)
        known = t_s, rest_rates(rests, len(rate), mapping.site if reference.earth_rate else None)
        notes += found
    elif isinstance(reference, Measured) and beside:
        known = _rows_beside(mapping, reference, beside, log, (t_s, rate), notes)
    elif told is not None and measured:
        known = _readings(measured, time.t_s, told[time.rows], notes)
    if isinstance(reference, Measured) and known is not None and time.other_s is not None:
        (t_s, known), told_of = _samples_settled(mapping, reference, log, (t_s, rate), known)
        notes += [told_of] if told_of else []
        log = replace(log, time=replace(time, text=told_of or time.text))
    if not (spans or rests or isinstance(reference, Measured)):
        return None, left_out
    warm = None if warmth is None else warmth[:, 0]
    return _Part(
        log=log,
        t_s=t_s,
        rate_rps=rate,
        accel_mps2=accel,
        temperature_c=warm,
        reference=known,
        spans=spans,
        rests=rests,
        notes=notes,
    ), left_out


def _new_rows(quantity: str, t_s: Floats, values: Floats, notes: list[str]) -> NDArray[np.intp]:
    """Return the numbers of the rows at which values (rows, c) are new.

    All, unless values are held for several rows: then those that are not repetitions, with a note on ``quantity`` in
    ``notes``.
    """
    if (fresh := updates(values)) is None:
        return np.arange(len(values))
    each_hz = (len(fresh) - 1) / float(t_s[fresh[-1]] - t_s[fresh[0]])
    often = f"one row of {len(t_s) / len(fresh):.2g} ({each_hz:.3g} Hz)"
    notes.append(f"{quantity} is new in {often}; rows between were skipped")
    return fresh


def _readings(reference: Measured, t_s: Floats, values: Floats, notes: list[str]) -> ExternalRows:
    """Return instants (k,) in s and rows (k, c) of a reference without held values, spikes and repetitions.

    What was left out is appended to ``notes``.
    """
    fresh = _new_rows("the reference", t_s, values, notes)
    t_s, values = t_s[fresh], values[fresh]
    turned = reference.kind == "angle"  # 359 deg after 0 is no spike
    kept, odd = without_odd("reference", t_s, np.hstack([np.cos(values), np.sin(values)]) if turned else values)
    notes += odd
    return t_s[kept], values[kept]


def _rows_beside(
    mapping: Mapping, reference: Measured, other: ReferenceFile, log: Log, gyros: ExternalRows, notes: list[str]
) -> ExternalRows:
    """Return instants (k,) in s and rows (k, c) of a reference in its own file, on the time of the data file ``log``.

    Held values, spikes and repetitions are left out. ``gyros`` are instants and rates of the data file. The offset
    between the files is stated, by stamps of one clock, or by the motion. Stamps of two clocks are corrected if they
    drift apart; where stamps scatter, the motion decides between them and an even grid. Rows more than 1 s before or
    after the data file are left out. Notes are appended to ``notes``. RecordingError if the files do not overlap, or
    the other one cannot be read or has no usable row.
    """
    path, time, name = other.beside(log.path), log.time, other.beside(log.path).name
    table = read_table(path, other.format, wanted(other.timing, reference.columns.names))
    values = reference_rows(reference, table)
    own = timed(path, table, other.timing, other.format, values)
    of_grid = len(notes)
    notes += [f"{name}: {note}" for note in [own.time.text, *own.notes]]
    shift_s = other.offset_s or 0.0
    t_s, values = _readings(reference, own.time.t_s + shift_s, values[own.time.rows], notes)
    stamped_s = t_s.copy()
    if own.time.zero_s is not None and time.zero_s is not None:
        t_s += own.time.zero_s - time.zero_s
    outputs, array = Turned.of_rates(_ns(gyros[0]), gyros[1]), mapping.gyro.array
    signed = not mapping.gyro.sign_from_data

    def body() -> Turned:
        return Turned.of_reference(external_reference(reference, _ns(t_s), values), None)

    if other.offset_s is None:
        t_s -= ahead_by_motion(outputs, body(), array.p, signed=signed)
        when = f"{abs(t_s[0] - time.t_s[0]):.4g} s {'before' if t_s[0] < time.t_s[0] else 'after'}"
        notes.append(f"{name} begins {when} {log.path.name}, by the motion")
    first, last = float(time.t_s[0]), float(time.t_s[-1])
    shared = (t_s >= first - _BESIDE_S) & (t_s <= last + _BESIDE_S)
    if shared.sum() < 2:
        raise RecordingError(
            f"{name} lasts from {t_s[0]:.6g} to {t_s[-1]:.6g} s of the time of {log.path.name}, whose samples last "
            f"from {first:.6g} to {last:.6g} s: check unit, or state offset_s, which is added to its stamps, in "
            "[reference.time]"
        )
    t_s, values, stamped_s = t_s[shared], values[shared], stamped_s[shared]
    if own.time.other_s is not None:
        at = np.searchsorted(own.time.t_s + shift_s, stamped_s)
        other_s = t_s + own.time.other_s[at] - own.time.t_s[at]
        tried = [(gyros[0], (each_s, values)) for each_s in (t_s, other_s)]
        (_, (t_s, values)), told_of = _decided_by_motion(mapping, reference, own, gyros[1], tried)
        notes[of_grid] = told_of or notes[of_grid]
    if apart := clocks_apart(outputs, body(), array.p, signed=signed):
        notes.append(apart.told(name, max(first, float(t_s[0]))))
        t_s = apart.put_right(t_s)
    missing = max(t_s[0] - first, 0.0) + max(last - t_s[-1], 0.0)
    if missing > _BESIDE_S:
        notes.append(f"{name} does not cover {missing:.3g} of {last - first:.6g} s")
    return t_s, values


def _decided_by_motion(
    mapping: Mapping,
    reference: Measured,
    log: Log,
    rate: Floats,
    tried: Sequence[tuple[Floats, ExternalRows]],
) -> tuple[tuple[Floats, ExternalRows], str]:
    """Return the instants of samples (n,) and the rows of a reference: those of ``tried`` that the motion supports.

    ``log`` must have alternative instants (``time.other_s``). ``rate`` (n, m) are the samples. ``tried`` has two: the
    times as they were fitted in ``log``, and the alternative, since stamps that scatter are either of samples or of
    arrivals. Also returns a sentence on it, "" if the fitted times on the grid are kept.
    """
    instants = [(_ns(each_s), external_reference(reference, _ns(told_s), values)) for each_s, (told_s, values) in tried]
    other = by_motion(mapping.gyro.array, rate, instants) == 1
    time = log.time
    if time.on_grid and not other:
        return tried[0], ""
    assert time.other_s is not None
    grid_s = time.t_s if time.on_grid else time.other_s
    rate_hz = 1 / float(np.median(np.diff(grid_s)))
    scatter_ms = 1e3 * time.scatter_s
    if other == time.on_grid:
        told = sentence("importing.uneven", file=log.path.name, scatter_ms=scatter_ms, rate_hz=rate_hz)
    else:
        told = sentence("importing.arrivals", file=log.path.name, scatter_ms=scatter_ms, rate_hz=rate_hz)
    return tried[1 if other else 0], told


def _samples_settled(
    mapping: Mapping, reference: Measured, log: Log, gyros: ExternalRows, known: ExternalRows
) -> tuple[tuple[Floats, ExternalRows], str]:
    """Return the instants of samples with scattering stamps, and the rows of the reference, as the motion shows.

    ``gyros`` and ``known`` are instants and rows of both; the instants are as fitted or the alternative, which ``log``
    must have (``time.other_s``). A reference in the same file has the same stamps and changes with them. Also returns a
    sentence on it, "" if the fitted times are those of the grid and stay.
    """
    time, (t_s, rate), (told_s, values) = log.time, gyros, known
    other_s = time.other_s
    assert other_s is not None

    def others(each_s: Floats) -> Floats:
        at = np.clip(np.searchsorted(time.t_s, each_s), 0, len(time.t_s) - 1)
        return each_s + other_s[at] - time.t_s[at]

    others_told_s = told_s if mapping.reference_file else others(told_s)
    tried = [(t_s, (told_s, values)), (others(t_s), (others_told_s, values))]
    return _decided_by_motion(mapping, reference, log, rate, tried)


def _felt_beside(other: ReferenceFile, accelerometer: Columns, log: Log, rows: int, notes: list[str]) -> Floats:
    """Return specific forces (rows, 3) from a separate file at the instants of the gyro's rows.

    They are interpolated between its complete rows, at its stamps, by the same clock, plus the offset stated. NaN
    beyond its ends, and in rows of the data file that are not kept. Notes are appended to ``notes``. RecordingError if
    the files do not overlap, or the other one cannot be read.
    """
    path = other.beside(log.path)
    table = read_table(path, other.format, wanted(other.timing, accelerometer.names))
    values = table.values(accelerometer, "[accelerometer] columns")
    own = timed(path, table, other.timing, other.format, values)
    notes += [f"{path.name}: {note}" for note in [own.time.text, *own.notes]]
    t_s, values = own.time.t_s + (other.offset_s or 0.0), values[own.time.rows]
    if own.time.zero_s is not None and log.time.zero_s is not None:
        t_s = t_s + own.time.zero_s - log.time.zero_s
    whole = np.isfinite(values).all(axis=1)
    at_s = log.time.t_s
    if whole.sum() < 2 or t_s[whole][0] > at_s[-1] or t_s[whole][-1] < at_s[0]:
        raise RecordingError(
            f"{path.name} has no sample within the time of {log.path.name}. "
            "Check its columns and "
            "unit, or state offset_s, "
            "which is added to its stamps, in [accelerometer.time]"
        )
    felt = np.full((rows, 3), np.nan)
    felt[log.time.rows] = np.column_stack(
        [np.interp(at_s, t_s[whole], c, left=np.nan, right=np.nan) for c in values[whole].T]
    )
    return felt


def _unit_notes(mapping: Mapping, table: Table) -> list[str]:
    """Return notes if the file's row of units contradicts the unit of the gyro in the mapping; none for counts."""
    columns = mapping.gyro.columns
    said = {table.units.get(name, "").lower() for name in columns.names}
    return [
        f"the row of units says {unit} for the gyro, but the mapping does not. Check unit in [gyro]"
        for unit, spellings in _UNIT_ROW.items()
        if not columns.raw and columns.scale != UNITS["rate"][unit] and said & set(spellings)
    ]


def _coarse_notes(names: Sequence[str], rate: Floats) -> list[str]:
    notes = []
    for name, steps in zip(names, np.abs(np.diff(rate, axis=0)).T, strict=True):
        step = float(np.degrees(steps[steps > _EQUAL_RPS].min(initial=np.inf)))
        if np.isfinite(step) and np.mean(steps <= _EQUAL_RPS) > _COARSE_SHARE:
            notes.append(sentence("importing.coarse_steps", name=name, step_dps=step))
    return notes


def _missing_notes(t_s: Floats) -> list[str]:
    """Return a note on samples missing between instants ``t_s``, by the usual step.

    Empty if there are none, or if gaps are the rule, at a tenth of the rows and more.
    """
    steps = np.diff(t_s)
    short = np.round(steps / np.median(steps)) - 1
    if not 0 < (gaps := int(np.count_nonzero(short > 0))) < _GAPS_SHARE * len(t_s):
        return []
    count, worst = int(short[short > 0].sum()), int(np.argmax(steps))
    return [
        f"{count} samples ({100 * count / (len(t_s) + count):.1f} %) are missing in {gaps} gaps, the longest "
        f"{steps[worst]:.3g} s at {t_s[worst] + np.median(steps):.4g} s"
    ]


def _interpolated(log: Log, gyro_rows: NDArray[np.intp], values: Floats | None, quantity: str) -> Floats | None:
    """Return values (n, m) at the gyro's rows ``gyro_rows`` (n,), with blanks interpolated in time; None for None.

    ``values`` (rows, m) are those of all rows of the file, ``gyro_rows`` are numbers among the kept ones. If one of
    these rows is blank, all are interpolated between complete rows, and beyond them the nearest holds. ``quantity``
    names the values. RecordingError if no row is complete.
    """
    if values is None:
        return None
    kept = values[log.time.rows]
    whole = np.asarray(np.isfinite(kept).all(axis=1))
    if not whole.any():
        raise RecordingError(f"{log.table.name} has no complete row of the {quantity}. Check [{quantity}]")
    if whole[gyro_rows].all():
        return kept[gyro_rows]
    at, t_s = log.time.t_s[gyro_rows], log.time.t_s[whole]
    return np.column_stack([np.interp(at, t_s, column) for column in kept[whole].T])


def _joined_recording(mapping: Mapping, parts: list[_Part], refused: list[Refused]) -> tuple[Recording, list[str]]:
    """Return the recording of all files, one after the other with gaps of 10 s, and its notes.

    Signs and scales are taken from the data where the mapping says so. The attributes hold what is known of the import:
    mapping, files and their starts, time fits, counts of rows left out, ``refused``, rests, factors and notes; empty
    ones are left out. The site is kept only if Earth rate counts; else a note says so. RecordingError if gyros are
    mixed up.
    """
    starts_s = [-float(parts[0].log.time.t_s[0])]
    for before, part in pairwise(parts):
        starts_s.append(starts_s[-1] + float(before.log.time.t_s[-1]) + _GAP_S - float(part.log.time.t_s[0]))
    placed = list(zip(parts, starts_s, strict=True))
    reference, earth, rests = mapping.reference, mapping.earth_rate, [rest for part in parts for rest in part.rests]
    data = ImuData(
        mapping.gyro.array,
        np.concatenate([_ns(part.t_s + start) for part, start in placed]),
        np.vstack([part.rate_rps for part in parts]),
        prior=mapping.prior,
        temperature_c=_stack(part.temperature_c for part in parts),
        accel_mps2=_stack(part.accel_mps2 for part in parts),
    )
    poses = _poses(reference.gravity, placed) if isinstance(reference, Rests) and reference.gravity else None
    site = mapping.site if earth else None
    recording = Recording({SOURCE: data}, poses or _reference(reference, placed), site)
    recording, found, factors = fitted(recording, SOURCE, mapping.gyro)
    notes = [*_told_once(parts), *found]
    notes += [accelerometer_note(poses)] if poses else []
    if earth and rests:
        notes += earth_note(mapping, rests)
    elif mapping.site and not earth:
        fixed = (isinstance(reference, Measured) and reference.kind != "angle") or isinstance(reference, StatedTurns)
        how = "Earth rate is available for kind = angle and rest" if fixed else "add earth_rate = true to [reference]"
        notes.append(f"the site is not used: {how}")
    attributes = {
        "device": mapping.device,
        "files_begin_s": np.array([start + float(part.t_s[0]) for part, start in placed]) if len(placed) > 1 else None,
        "imported_from": ", ".join(part.log.path.name for part in parts),
        "mapping": mapping.text,
        "time_fit": "\n".join(f"{part.log.path.name}: {part.log.time.text}" for part in parts),
        "skipped_lines": sum(part.log.table.skipped_lines for part in parts),
        "replayed_rows": sum(part.log.time.replayed for part in parts),
        "refused": "\n".join(str(r) for r in refused),
        "licence": mapping.licence,
        "source": mapping.source,
        "imported": "\n".join(notes),
        "rests": "\n".join(rest_text(rest, start) for part, start in placed for rest in part.rests),
        "gyro_factor": factors,
    }
    kept = {key: value for key, value in attributes.items() if isinstance(value, (int, np.ndarray)) or value}
    return replace(recording, attributes=kept), notes


def _told_once(parts: Sequence[_Part]) -> list[str]:
    """Return the notes on all files; of a single file as they are, else with the name of the file.

    Equal notes of several files are combined with their count, and so are more than three that differ only in numbers.
    """
    if len(parts) == 1:
        return [*parts[0].notes]
    alike: dict[str, list[tuple[str, str]]] = {}
    for part in parts:
        for note in part.notes:
            alike.setdefault(_NUMBER.sub("#", note), []).append((part.log.path.name, note))
    told = []
    for own in alike.values():
        name, note = own[0]
        texts = {text for _, text in own}
        if len(own) > 1 and len(texts) == 1:
            told.append(f"{note} ({len(own)} files, the first {name})")
        elif len(own) > _MOST_ALIKE:
            told.append(f"{name}: {note} (and likewise {len(own) - 1} more files)")
        else:
            told += [f"{other}: {text}" for other, text in own]
    return told


def _reference(stated: ExternalReference, placed: list[tuple[_Part, float]]) -> Reference:
    """Return the reference of all files: their rows, each file at its start in s, or without rows the stated turns.

    Rows of an instrument become its kind of readings, those of rests body rates.
    """
    rows = [(part.reference, start) for part, start in placed if part.reference]
    if rows:
        t_ns = np.concatenate([_ns(t_s + start) for (t_s, _), start in rows])
        values = np.vstack([values for (_, values), _ in rows])
        return external_reference(stated, t_ns, values) if isinstance(stated, Measured) else RateReadings(t_ns, values)
    spans = [(span, start) for part, start in placed for span in part.spans]
    return Turns(
        _ns(np.array([start + span.start_s for span, start in spans])),
        _ns(np.array([start + span.end_s for span, start in spans])),
        np.array([span.turn_rad for span, _ in spans]),
        np.array([span.sd_rad for span, _ in spans]),
    )


def _poses(gravity: Gravity, placed: list[tuple[_Part, float]]) -> Poses:
    """Return the rests of all files with the directions up that the accelerometer measured.

    ``placed`` are files with their starts in s. ``gravity`` states whether its errors are estimated from the rests, and
    its uncertainty.
    """
    rests = [(part.accel_mps2, rest, start) for part, start in placed for rest in part.rests]
    force = [np.nanmean(accel[rest.first : rest.stop], axis=0) for accel, rest, _ in rests if accel is not None]
    limits = np.array([(rest.start_s + start, rest.end_s + start) for _, rest, start in rests])
    up, doubt, shifts = directions_up(np.array(force), from_rests=gravity.from_rests)
    sd = np.full(len(up), np.hypot(doubt, gravity.sd_rad))
    return Poses(_ns(limits[:, 0]), _ns(limits[:, 1]), up, sd, shifts)


def _ns(t_s: Floats) -> NDArray[np.int64]:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)


def _present(parts: Iterable[Floats | None]) -> list[Floats]:
    return [part for part in parts if part is not None]


def _stack(parts: Iterable[Floats | None]) -> Floats | None:
    present = _present(parts)
    return np.concatenate(present) if present else None
