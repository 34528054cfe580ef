"""From a recording to the calibration of its gyros."""

from collections.abc import Sequence

import numpy as np

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.budget import Contribution, rest_angle_covariances, table_budget
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration, GyroParity, unseen_notes
from estimator.errors import RecordingError
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.estimation.joint import check_model, effect_notes, estimate_device
from estimator.estimation.live.source import filter_nis
from estimator.estimation.noise_evidence import TooShort
from estimator.estimation.parity import parity
from estimator.estimation.source_estimate import DeviceEstimate, SourceEstimate, Sources, estimate_laid, estimate_white
from estimator.estimation.undeclared import undeclared_notes
from estimator.geometry.model import decode
from estimator.observations.allan.sensor import SensorNoise
from estimator.observations.conditions_seen import holds_for
from estimator.observations.coverage import coverage, coverage_notes
from estimator.observations.defects.examined import examined
from estimator.observations.defects.reading_doubts import reading_doubts
from estimator.observations.defects.stuck import stuck_doubts
from estimator.observations.external import external_motion_notes, factor_notes, sparse_doubts
from estimator.observations.health import Excluded
from estimator.observations.rests import motion_notes, rest_noise
from estimator.packaged import sentence
from estimator.recordings.memory import check_estimating
from estimator.recordings.recording import Recording
from estimator.types import least_steps

_CHANCE = 4.0  # standard deviations of the scatter of block means
_CLEARLY_MORE = 1.0  # of the standard deviation of a misalignment
_NEAR = 0.05  # accuracy of the estimated noise, in addition


def calibrate(
    recording: Recording,
    *,
    innovations: bool = True,
    model: ErrorModel | None = None,
    excluded: frozenset[str] | None = None,
) -> Calibration:
    """Return the batch estimate of the states of every gyro under its data sheet's prior, with noise taken from the
    data.

    The noise may be coloured (``estimator.estimation.noise_evidence``). Each source's time offset is estimated too,
    except at rest, for turns or poses, and with a model that holds a delay. ``innovations`` also gives the mean NIS,
    else NaN. A ``model``'s effects are estimated with the states; an empty one counts as none. Without effects of
    gyros, ``excluded`` names the catalogue's effects that device and table do not have: the sigmas hold what the others
    could do unseen. None: the sigmas allow for no such effects. Gyros come in the order of the recording; defective
    ones are left out and listed in the result. Accelerometers are calibrated too.

    Raises RecordingError if a source has no samples the reference covers, no gyro can be estimated, or memory is too
    small; ModelError for a model beside poses, and if the recording lacks what the model needs.
    """
    given = model if model is not None and not model.is_empty else None
    if given is not None:
        check_model(given, recording)
    of_forces = given.forces if given is not None else ()
    model = given if given is not None and given.effects else None
    recording, sources, notes, defective = _usable(recording)
    devices = _devices(recording, sources, model, excluded, defective)
    estimates = [one for device in devices for one in device.sources]
    gyros, checks, gyro_notes = _gyros_of(recording, devices)
    forces, force_notes = calibrate_forces(recording, of_forces)
    nis = _mean_nis(recording, given, estimates) if innovations else float("nan")
    spoilt, doubts = _doubts(recording, devices, forces)
    effects = tuple(one for device in devices for one in device.undeclared)
    constancy = coverage(recording, [data for _, data in sources])
    notes += [*gyro_notes, *force_notes, *_rest_angle_notes(recording, gyros, forces)]
    notes += [*undeclared_notes(effects, gyros), *coverage_notes(constancy), *_parity_notes(checks)]
    notes += [*effect_notes(gyros), *doubts]
    order = [name for data in recording.sources.values() for name in data.array.names]
    return Calibration(
        gyros=tuple(sorted(gyros, key=lambda gyro: order.index(gyro.name))),
        nis_mean=nis,
        samples=sum(one.samples for one in estimates),
        lost=sum(data.lost * len(data.array) for data in recording.sources.values()),
        notes=tuple(notes),
        excluded=defective,
        parity=tuple(checks),
        model=given.text() if given is not None else "",
        doubts=tuple(doubts),
        holds_for=holds_for(recording),
        offsets={one.source: one.offset for one in estimates if one.offset is not None},
        spoilt=tuple(spoilt),
        arrays={name: data.array for name, data in recording.sources.items()},
        constancy=constancy,
        forces=forces,
        undeclared=effects,
    )


def _gyros_of(
    recording: Recording, devices: Sequence[DeviceEstimate]
) -> tuple[list[GyroCalibration], list[GyroParity], list[str]]:
    """Return the calibrations of the gyros of all devices, their parity checks, and notes, device by device: those of
    the estimate, then on its gyros, but none on parity.
    """
    gyros: list[GyroCalibration] = []
    checks: list[GyroParity] = []
    notes: list[str] = []
    for device in devices:
        own = [(one, gyro) for one in device.sources for gyro in _gyros(recording, one)]
        gyros += [gyro for _, gyro in own]
        checks += _parity(device.sources, [gyro for _, gyro in own])
        notes += [*device.notes, *_gyro_notes(recording, own)]
    return gyros, checks, notes


def _doubts(
    recording: Recording, devices: Sequence[DeviceEstimate], forces: Sequence[ForceCalibration]
) -> tuple[list[str], list[str]]:
    """Return sentences on what no sigma can cover, and all notes that question the sigmas, which include the former.

    The former are doubts about the table and changes in mid-run. A table comes first in both: it is doubted where its
    readings contradict each other, or where samples repeat while it turns. The latter also are on readings that are too
    sparse, on what estimates, scatter and accelerometers leave in doubt.
    """
    of_table: list[str] = []
    if recording.table is not None:
        of_table = [*reading_doubts(recording.table), *stuck_doubts(recording)]
    spoilt = [one for device in devices for one in device.spoilt]
    doubts = sparse_doubts(recording)
    for device in devices:
        doubts += [*device.doubts, *device.spoilt]
    doubts += _scatter_doubts([one for device in devices for one in device.sources])
    doubts += [doubt for one in forces for doubt in one.doubts]
    return [*of_table, *spoilt], [*of_table, *doubts]


def _gyro_notes(recording: Recording, gyros: Sequence[tuple[SourceEstimate, GyroCalibration]]) -> list[str]:
    """Return sentences on states that a recording did not show, and on a k that is rather a wrong sign or unit.

    A body at rest gets none, as it has its own note.
    """
    notes: list[str] = []
    for one, gyro in gyros if not recording.reference.at_rest else ():
        notes += unseen_notes(gyro.name, gyro.type_a, one.data.prior)
        notes += factor_notes(gyro.name, float(gyro.states[0]), float(gyro.sd[0]))
    return notes


def _usable(recording: Recording) -> tuple[Recording, Sources, list[str], tuple[Excluded, ...]]:
    """Return (recording, sources, notes, excluded gyros) after the examination of the data.

    The recording comes without the readings that its reference has wrong. The sources are pairs of name and usable
    data: a source may give several parts. The notes cover what was left out, the motion, and the motion that another
    instrument reports. Raises RecordingError with the reasons if no gyro is left, and if memory does not suffice.
    """
    check_estimating(recording)
    seen = examined(recording)
    sources = [(source, part) for source, its in seen.sources.items() for part in its.usable.parts]
    defective = tuple(e for its in seen.sources.values() for e in its.usable.excluded)
    if not sources:
        reasons = "; ".join(f"{e.name}: {e.reason}" for e in defective)
        raise RecordingError(f"{recording.name}: no gyro can be estimated: {reasons}")
    notes = [*seen.notes, *(note for its in seen.sources.values() for note in its.usable.notes)]
    notes += [f"{e.name} is not estimated: {e.reason}. The others are" for e in defective]
    notes += [*motion_notes(recording), *external_motion_notes(recording)]
    return seen.recording, sources, notes, defective


def _devices(
    recording: Recording,
    sources: Sources,
    model: ErrorModel | None,
    excluded: frozenset[str] | None,
    defective: Sequence[Excluded],
) -> list[DeviceEstimate]:
    """Return the estimates of all devices, in the order of their sources; ``excluded`` is as for ``calibrate``.

    Raises RecordingError where a device cannot be estimated; except for TooShort the message then also names the
    ``defective`` gyros that were left out, because they may be the reason.
    """
    found = []
    for device in dict.fromkeys(data.device for _, data in sources):
        own = [pair for pair in sources if pair[1].device == device]
        try:
            found.append(_device(recording, own, model, excluded))
        except RecordingError as error:
            if isinstance(error, TooShort) or not defective:
                raise
            reasons = "; ".join(f"{gyro.name} is excluded: {gyro.reason}" for gyro in defective)
            raise RecordingError(f"{error}; {reasons}") from None
    return found


def _device(
    recording: Recording, sources: Sources, model: ErrorModel | None, excluded: frozenset[str] | None
) -> DeviceEstimate:
    """Return the estimate of the sources of one device, by the method that the reference allows.

    Poses are estimated from gravity, turns without a model under white noise, all others under coloured noise. Where
    there is too little data for coloured noise, white noise is used instead; with a model TooShort is raised.
    ``excluded`` counts only under coloured noise.
    """
    poses = recording.reference.poses
    if poses is not None:
        return estimate_laid(poses, sources)
    if recording.turns is None or model is not None:
        try:
            return estimate_device(recording, sources, model, excluded)
        except TooShort:
            if model is not None:
                raise
    return DeviceEstimate([estimate_white(recording, *pair) for pair in sources])


def _gyros(recording: Recording, estimate: SourceEstimate) -> list[GyroCalibration]:
    """Return the calibration of each gyro of a source: its covariance with that of the table, and its noise at rest.

    The uncertainty of the table is added only for table readings. A line that the estimate holds already (the time
    offset) replaces the line of that name which the table states. Noise at rest is sought with a table, or for a body
    at rest; ``rest`` is None otherwise, and where rests give none.
    """
    data, m = estimate.data, len(estimate.data.array)
    table: list[tuple[Contribution, ...]] = [()] * m
    rests: list[SensorNoise | None] = [None] * m
    if recording.table is not None:
        arw = np.array([one.mean.arw if one else 0.0 for one in estimate.noise])
        table = table_budget(recording.table, recording.site, data.array, data.prior, arw)
    if recording.table is not None or recording.reference.at_rest:
        rests = [*rest_noise(data, recording.reference)] or rests
    gyros = []
    for i, name in enumerate(data.array.names):
        own = estimate.lines[i]  # the time offset, if it was estimated, replaces the table's stated timing
        kinds = (*own, *(line for line in table[i] if line.name not in {one.name for one in own}))
        states, covariance = decode(estimate.x[i], np.sum([c.covariance for c in kinds], axis=0))
        gyros.append(
            GyroCalibration(
                name=name,
                source=estimate.source,
                states=states,
                covariance=covariance,
                noise_rps=float(estimate.noise_rps[i]),
                p=data.array.p[i],
                device=data.device,
                budget=tuple(Contribution(c.name, decode(estimate.x[i], c.covariance)[1]) for c in kinds),
                noise=estimate.noise[i],
                rest=rests[i],
                effects=estimate.effects[i],
            )
        )
    return gyros


def _rest_angle_notes(
    recording: Recording, gyros: Sequence[GyroCalibration], forces: Sequence[ForceCalibration]
) -> list[str]:
    """Return a sentence if the axes stand so far off their counts that misalignments of gyros are less sure than said.

    Accelerometers show how far off they stand; where they are silent nothing is known, and nothing is said. The
    sentence has the largest of these additional sigmas.
    """
    share = max((one.rest_angle_share for one in forces), default=0.0)
    if recording.table is None or not share:
        return []
    counts_rad = least_steps(np.abs(np.diff(recording.table.angle_rad, axis=0)))
    largest_rad = 0.0
    for source, data in recording.sources.items():
        own = [gyro for gyro in gyros if gyro.source == source and gyro.noise is not None]
        if not own:
            continue
        array = data.array.select([data.array.names.index(gyro.name) for gyro in own])
        arw = np.array([gyro.noise.mean.arw for gyro in own if gyro.noise is not None])
        sd_rad = share * counts_rad / np.sqrt(12)
        found = rest_angle_covariances(recording.table, recording.site, array, data.prior, arw, sd_rad)
        for gyro, covariance in zip(own, found, strict=True):
            u = np.sqrt(np.diag(covariance))[2:]
            largest_rad = max(largest_rad, float(np.max(u * (u > _CLEARLY_MORE * gyro.sd[2:]))))
    return [sentence("estimation.rest_angles", size_urad=1e6 * largest_rad)] if largest_rad else []


def _parity(estimates: Sequence[SourceEstimate], gyros: Sequence[GyroCalibration]) -> list[GyroParity]:
    """Return the parity check of the gyros of a device.

    An empty list if a source has no block means, for fewer than four gyros, or without blocks common to all sources.
    """
    blocks = [one.blocks for one in estimates if one.blocks is not None]
    if len(blocks) < len(estimates):
        return []
    noise = [gyro.noise.mean for gyro in gyros if gyro.noise is not None]
    states, growth_s = np.array([gyro.states for gyro in gyros]), max(one.growth_s for one in estimates)
    sources = [gyro.source for gyro in gyros]
    return parity([one.data.array for one in estimates], blocks, states, noise, growth_s, sources)


def _mean_nis(recording: Recording, model: ErrorModel | None, estimates: Sequence[SourceEstimate]) -> float:
    """Return the mean NIS of the live filter (``filter_nis``), or that of the block means where no filter can be run.

    The latter is the mean square of the block means about the estimate, over the scatter of single samples as their
    sigma. NaN where there are no blocks either.
    """
    nis = filter_nis(recording, model)
    if nis is not None:
        return nis
    squares, dof = _block_squares(estimates)
    return squares / dof if dof else float("nan")


def _block_squares(estimates: Sequence[SourceEstimate]) -> tuple[float, int]:
    """Return the squares of block means about the estimate, over those of white noise, and their number."""
    return sum(one.squares for one in estimates), sum(one.dof for one in estimates)


def _scatter_doubts(estimates: Sequence[SourceEstimate]) -> list[str]:
    """Return a sentence if the block means scatter otherwise than the estimated noise predicts, else an empty list.

    The difference, to either side, must exceed chance and 5 %. Without blocks, or if they hold what is not finite, the
    list is empty.
    """
    squares, dof = _block_squares(estimates)
    if not dof or not np.isfinite(squares):
        return []
    scatter = squares / dof
    mean = sum(one.dof * one.expected_nis[0] for one in estimates) / dof
    sd = np.hypot(
        np.sqrt(sum((one.dof * one.expected_nis[1]) ** 2 for one in estimates)) / dof, np.sqrt(2 / dof) * mean
    )
    if abs(scatter - mean) <= _CHANCE * sd + _NEAR * mean:
        return []
    return [sentence("estimation.scatter_unlike", scatter=scatter, expected=mean, sd=sd)]


def _parity_notes(checks: list[GyroParity]) -> list[str]:
    """Return one sentence on gyros that disagree, an empty list if none is suspect.

    It names the worst gyro if the check can tell it apart from the others, else all suspects.
    """
    suspects = [check for check in checks if check.suspect]
    if not suspects:
        return []
    worst = max(suspects, key=lambda check: check.worst_sigma)
    where = f"{worst.worst_sigma:.0f} sigma at {worst.worst_t_s:.0f} s"
    if worst.told_apart:
        return [f"{worst.name} disagrees with the other gyros of its device (parity {where}). Check it"]
    return [f"the gyros {', '.join(c.name for c in suspects)} disagree (parity {where}). One of them is wrong"]
