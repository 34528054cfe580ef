"""The outputs of accelerometers that can be used, and those that no calibration must hide."""

from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.accelerometers.force_runs import ForceSamples, force_at_place
from estimator.geometry.array import SensorArray, accelerometer_array, accelerometer_names
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2
from estimator.geometry.noise import SD_OF_MEDIAN
from estimator.observations.defects.limits import limits_of
from estimator.observations.defects.odd_samples import without_odd
from estimator.observations.defects.stuck import longest_by_chance
from estimator.observations.health import Excluded, at_limits, widened
from estimator.packaged import sentence
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import TableReadings
from estimator.types import Flags, Floats, Stamps, runs_of

_MOST_ROWS = 20000
_FAR_OFF = 0.2  # of 1: a scale this far from it is a wrong unit or range, not a scale factor error
_UNIT = 0.05  # of itself: how near a wrong scale is to that of a unit to be called by its name
_DEAD = 0.1
_LOST = 0.02  # share of samples without a number that is told
_LONGEST_ARM_M, _ALLOWED = 1.0, 3.0
_HELD_S, _CHANGED_MPS2 = 1.0, 1.0  # a value that is held for longer while the force changes by more is stuck
_STILL_MPS2 = 0.1  # the force stays: it changes by less
_MOST_PARTS = 0.75  # share of the parts of a run at rest in which no more samples equal the one before
_ALONG = 0.8  # cosine above which an accelerometer lies along a body axis


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Checked:
    """The accelerometers of a source that can be calibrated (None if none can), those that cannot, and notes.

    ``doubts`` are notes that question what comes of it.
    """

    samples: ForceSamples | None
    excluded: tuple[Excluded, ...]
    notes: tuple[str, ...]
    doubts: tuple[str, ...] = ()


def checked(data: ImuData, table: TableReadings) -> Checked:
    """Return the accelerometers of a source, each compared with gravity on the table before anything is estimated.

    Excluded, with the reason, are those that are dead or stuck, along another axis than stated, of the wrong sign or in
    the wrong unit; and all if they are not three and their axes are not stated. Samples are put in the order of time,
    spikes and repetitions left out; single values that are at a limit, stuck or beyond any force become NaN. Notes say
    so, and doubts what was stuck for a time. ``samples`` is None if none is left.
    """
    assert data.accel_mps2 is not None
    assert data.accel_sheet is not None
    names = accelerometer_names(data.accel_mps2.shape[1])
    if data.accel_axes is None and len(names) != 3:
        reason = (
            "its axis is not stated, and three axes of the body can only be taken for those of three accelerometers"
        )
        return Checked(samples=None, excluded=tuple(Excluded(name, reason) for name in names), notes=())
    axes = np.eye(3) if data.accel_axes is None else data.accel_axes
    array = accelerometer_array(axes, data.array)
    order = np.argsort(data.t_ns, kind="stable")
    t_ns, outputs = data.t_ns[order], data.accel_mps2[order]
    kept, notes = without_odd("accelerometer", np.asarray(t_ns * 1e-9, dtype=np.float64), outputs, names)
    t_ns, outputs = t_ns[kept], outputs[kept]
    outputs, impossible = _without_impossible(outputs, names, table)
    notes += impossible
    samples = ForceSamples(array=array, t_ns=t_ns, output_mps2=outputs, prior=data.accel_sheet.prior)
    excluded, limited, stuck = _compared(samples, table)
    notes += [sentence("estimation.accelerometer_limit", name=name) for name in limited if name not in stuck]
    wrong = {one.name for one in excluded}
    good = [number for number, name in enumerate(names) if name not in wrong]
    if not good:
        return Checked(samples=None, excluded=tuple(excluded), notes=tuple(notes))
    within = outputs[:, good].copy()
    for name, flags in limited.items():
        if name not in wrong:
            within[flags, good.index(names.index(name))] = np.nan
    together = np.isfinite(within).all(axis=1).mean()
    for column, number in enumerate(good):
        lost = 1 - np.isfinite(within[:, column]).mean()
        if lost > max(_LOST, 0.5 * (1 - together)):
            notes.append(sentence("estimation.accelerometer_lost", name=names[number], share=lost))
    samples = replace(samples, array=array.select(good), output_mps2=within)
    return Checked(samples=samples, excluded=tuple(excluded), notes=tuple(notes), doubts=tuple(stuck.values()))


def _without_impossible(outputs: Floats, names: tuple[str, ...], table: TableReadings) -> tuple[Floats, list[str]]:
    """Return outputs (n, c) with NaN for values beyond any force on the table, in any unit, and notes on those.

    The largest force is gravity and that of the fastest turn at an arm of ``_LONGEST_ARM_M``; a few times that are
    allowed. Where most of the values of an accelerometer are beyond, its unit is wrong, and they stay.
    """
    fastest_rps = float(np.abs(table.rate_rps).sum(axis=1).max(initial=0.0))
    most_mps2 = _ALLOWED * (GRAVITY_MPS2 + _LONGEST_ARM_M * fastest_rps**2)
    with np.errstate(invalid="ignore"):
        beyond = np.abs(outputs) > most_mps2
    beyond[:, beyond.mean(axis=0) > 0.5] = False
    notes = [
        sentence("estimation.accelerometer_impossible", name=name, count=int(flags.sum()), most=most_mps2)
        for name, flags in zip(names, beyond.T, strict=True)
        if flags.any()
    ]
    return np.where(beyond, np.nan, outputs), notes


def _compared(
    samples: ForceSamples, table: TableReadings
) -> tuple[list[Excluded], dict[str, np.ndarray], dict[str, str]]:
    """Return which accelerometers to exclude, bad samples of the others, and which of them stuck for a time.

    Excluded are outputs that are constant, missing, or not of the stated axis and unit, compared with the force by the
    table. Bad samples are flags (n,) by name, at a limit or stuck; sentences by name are on those that stuck. An
    accelerometer that stuck may be excluded, too. All are empty if no sample is within the readings.
    """
    rates = BodyRates.of(table, None)
    t_ns, outputs = samples.t_ns, samples.output_mps2
    inside = (t_ns >= rates.starts_ns) & (t_ns <= rates.final_until_ns)
    if not inside.any():
        return [], {}, {}
    force = np.full((len(t_ns), 3), np.nan)
    force[inside] = force_at_place(rates, table.gimbals, t_ns[inside], np.zeros(3), GRAVITY_MPS2)
    excluded: list[Excluded] = []
    limited: dict[str, np.ndarray] = {}
    stuck: dict[str, str] = {}
    for number, name in enumerate(samples.array.names):
        output = outputs[:, number]
        known = np.flatnonzero(inside & np.isfinite(output))
        finite = known[:: max(len(known) // _MOST_ROWS, 1)]
        if not len(finite):
            excluded.append(Excluded(name, "none of its samples beside readings of the table is a number"))
            continue
        if np.ptp(output[finite]) == 0:
            excluded.append(Excluded(name, "its output is constant: disconnected or stuck"))
            continue
        expected = force @ samples.array.p[number]
        held = _held(t_ns, output, expected)
        if held.any():
            first_s = float(t_ns[np.argmax(held)] - t_ns[0]) * 1e-9
            stuck[name] = sentence("estimation.accelerometer_stuck", name=name, since_s=first_s, share=held.mean())
            limited[name] = held
            finite = finite[~held[finite]]
            output = np.where(held, np.nan, output)
        # Where the table does not tilt, nothing speaks against the stated axis.
        columns = np.column_stack([np.ones(len(finite)), force[finite]])
        beyond = output[finite] - force[finite] @ samples.array.p[number]
        gain = samples.array.p[number] + np.linalg.lstsq(columns, beyond, rcond=1e-2)[0][1:]
        reason = _unlike(gain, samples.array, number)
        if reason:
            excluded.append(Excluded(name, reason))
            continue
        scatter = SD_OF_MEDIAN * float(np.median(np.abs(output[finite] - expected[finite])))
        flags = at_limits(t_ns, output, float(np.nanmin(output)), float(np.nanmax(output)))
        for limit in limits_of(output[finite], expected[finite], max(scatter, 1e-6)):
            flags |= widened(limit.reached(output, expected), t_ns)
        if flags.any():
            limited[name] = flags | held
    return excluded, limited, stuck


def _held(t_ns: Stamps, output: Floats, expected: Floats) -> Flags:
    """Return as flags (n,) the samples of long runs of one value within which the output ought to have changed.

    It ought to change if the force does, or if noise lets it change in most of the run while the force stays. Runs of
    the least and the largest value do not count: they are at a limit. ``expected`` (n,) is the output by the table, NaN
    where unknown; a run in which all of it is unknown does not count either.
    """
    ends = np.nanmin(output), np.nanmax(output)
    held = np.zeros(len(output), dtype=np.bool_)
    equal = np.diff(output) == 0
    longest = _longest_equal(t_ns, equal, expected)
    for start, stop in runs_of(equal):
        own = expected[start : stop + 1]
        own = own[np.isfinite(own)]
        if t_ns[stop] - t_ns[start] <= _HELD_S * 1e9 or output[start] in ends or not len(own):
            continue
        if np.ptp(own) > _CHANGED_MPS2 or stop - start > longest:
            held[start : stop + 1] = True
    return held


def _longest_equal(t_ns: Stamps, equal: Flags, expected: Floats) -> float:
    """Return how many neighbours in a row are never equal by chance; infinite if the force never stays, or the output
    does not change while it does.

    ``equal`` (n - 1,) flags samples that equal the one before. Their share where the force stays is that of most parts
    of ``_HELD_S``, so that what is stuck for a time does not pass for quiet. Outputs that repeat each value a few times
    have a larger share.
    """
    part = (t_ns[1:] - t_ns[0]) // round(_HELD_S * 1e9)
    starts = np.flatnonzero(np.diff(part, prepend=-1))
    highest, lowest = (f.reduceat(expected[1:], starts) for f in (np.maximum, np.minimum))
    still = highest - lowest < _STILL_MPS2  # not where the force is unknown
    if not still.any():
        return np.inf
    shares = np.add.reduceat(equal.astype(np.float64), starts) / np.diff([*starts, len(equal)])
    return longest_by_chance(float(np.quantile(shares[still], _MOST_PARTS)))


def _unlike(gain: Floats, array: SensorArray, number: int) -> str:
    """Return why the sensitivity (3,) of an accelerometer is not that of one along its stated axis; "" if it may be.

    It may be dead, reversed, along another axis, in g or mg, or of a scale that is far off.
    """
    size = float(np.linalg.norm(gain))
    if size < _DEAD / GRAVITY_MPS2:
        return "its output does not follow gravity while the table tilts: dead or disconnected"
    direction = gain / size
    along = float(direction @ array.p[number])
    if along < -_ALONG:
        return sentence("estimation.accelerometer_reversed")
    if along < _ALONG:
        axis = int(np.argmax(np.abs(direction)))
        name = f"{'-' if direction[axis] < 0 else ''}{AXES[axis]}"
        return sentence("estimation.accelerometer_along", axis=name, share=float(np.abs(direction[axis])))
    for factor, unit in ((1 / GRAVITY_MPS2, "g"), (1e3 / GRAVITY_MPS2, "mg")):
        if abs(size / factor - 1) < _UNIT:
            return sentence("estimation.accelerometer_unit", unit=unit)
    if abs(size - 1) > _FAR_OFF:
        return sentence("estimation.accelerometer_scale", factor=size)
    return ""
