"""From recordings of one device in several mountings to one calibration of its gyros and accelerometers."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration
from estimator.calibration.budget import Contribution
from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.errors import RecordingError
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces, undetermined
from estimator.estimation.calibrate import calibrate
from estimator.estimation.mountings.places import Places, gravity_notes, places_of
from estimator.estimation.mountings.problem import DeviceSensor, JoinedStates, RunStates, join, run_states
from estimator.geometry.array import TOLERANCE
from estimator.geometry.kinematics import Site, gravity_at
from estimator.geometry.model import StatePrior, decoding
from estimator.observations.health import Excluded
from estimator.observations.timing import TimeOffset
from estimator.packaged import sentence
from estimator.recordings.recording import Recording
from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.sensors.gyros import GYRO
from estimator.sensors.kind import SensorKind
from estimator.types import Floats

_UNSEEN = 0.5  # share of the prior's sigma above which runs did not show a state
_CHANCE = 4.0  # standard deviations of a sum of squares
_ONE_SENSOR = " is not calibrated: "
_CHANGED = 0.01  # share of what the data sheet expects of a bias, above which its change from run to run is told


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class MountingFound:
    """The mounting error (3,) of the device in a recording, about its own axes, from the frame of its gyros."""

    recording: str
    error_rad: Floats
    sd_rad: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class JoinedCalibration:
    """One calibration of a device from several recordings, in the device's axes, and the errors of its mountings."""

    calibration: Calibration
    mountings: tuple[MountingFound, ...]


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Run:
    """A recording, its estimate of the gyros, and that of the accelerometers under a gravity that counts as known."""

    recording: Recording
    calibration: Calibration
    forces: tuple[ForceCalibration, ...]
    force_notes: tuple[str, ...]


def join_mountings(
    recordings: Sequence[Recording],
    *,
    excluded: Sequence[frozenset[str] | None],
    innovations: bool = True,
) -> JoinedCalibration:
    """Return the one calibration of a device that was mounted otherwise in each of several recordings on a table.

    Misalignments are those in the frame of the gyros. ``excluded`` are for each recording the effects that are ruled
    out, as for ``calibrate``; with ``innovations`` the mean NIS is computed, over all runs. The result also has the
    error of each mounting. What single runs have (parity, time offsets of gyros, effects, constancy) is left out.

    RecordingError for fewer than two recordings, recordings that are not of one device or not on a table, a device that
    has other axes in one of them, or one without a sensor that can be estimated.
    """
    _check(recordings)
    runs = [_run(one, own, innovations) for one, own in zip(recordings, excluded, strict=True)]
    sensors = _sensors(runs)
    if not sensors:
        raise RecordingError("none of the recordings has a gyro or an accelerometer that can be estimated")
    places = places_of([one.site for one in recordings])
    shown = [_shown(run, sensors, place) for run, place in zip(runs, places.of_run, strict=True)]
    joined = join(sensors, shown, [gravity.sd for gravity in places.gravity])
    gyros = _gyros(runs, sensors, joined)
    forces = _forces(runs, sensors, joined, places)
    doubts = _doubts(runs, joined)
    own_notes = [*gravity_notes(recordings), *_notes(runs, sensors, joined)]
    notes = [note for note in own_notes if note not in doubts]
    arrays = {name: data.own_array for run in reversed(runs) for name, data in run.recording.sources.items()}
    counted = [run.calibration.nis_mean * run.calibration.samples for run in runs]
    samples = sum(run.calibration.samples for run in runs)
    calibration = Calibration(
        gyros=gyros,
        nis_mean=sum(counted) / samples if samples else float("nan"),
        samples=samples,
        lost=sum(run.calibration.lost for run in runs),
        notes=(*notes, *doubts),
        excluded=tuple(one for run in runs for one in run.calibration.excluded),
        doubts=tuple(doubts),
        spoilt=tuple(f"{run.recording.name}: {one}" for run in runs for one in run.calibration.spoilt),
        arrays=arrays,
        forces=forces,
    )
    mountings = tuple(
        MountingFound(recording=run.recording.name, error_rad=error, sd_rad=sd)
        for run, error, sd in zip(runs, joined.mounting_rad, joined.mounting_sd_rad, strict=True)
    )
    return JoinedCalibration(calibration=calibration, mountings=mountings)


def _check(recordings: Sequence[Recording]) -> None:
    """Raise RecordingError unless there are two recordings or more, on a table, of one device with the same gyros.

    The same are names of sources and axes in the device, to within ``TOLERANCE``; names of gyros are not compared.
    """
    if len(recordings) < 2:
        raise RecordingError(sentence("estimation.joined_alone"))
    for one in recordings:
        if one.table is None:
            raise RecordingError(sentence("estimation.joined_without_table", recording=one.name))
    first = recordings[0]
    devices = {data.device for data in first.sources.values()}
    if len(devices) > 1:
        names = ", ".join(sorted(devices))
        raise RecordingError(sentence("estimation.joined_devices", recording=first.name, devices=names))
    for one in recordings[1:]:
        if {data.device for data in one.sources.values()} != devices or set(one.sources) != set(first.sources):
            raise RecordingError(sentence("estimation.joined_other", first=first.name, second=one.name))
        for source, data in one.sources.items():
            ours, theirs = first.sources[source].own_array, data.own_array
            axes = [np.concatenate([array.p, array.j, array.k]) for array in (ours, theirs)]
            if axes[0].shape != axes[1].shape or np.abs(axes[0] - axes[1]).max() > TOLERANCE:
                raise RecordingError(
                    sentence("estimation.joined_axes", source=source, first=first.name, second=one.name)
                )


def _run(recording: Recording, excluded: frozenset[str] | None, innovations: bool) -> _Run:
    """Return the estimates of one recording.

    All runs have one gravity, whose error must not count as another one in each: it counts as known here.
    """
    gyros_alone = {name: replace(data, accel_sheet=None) for name, data in recording.sources.items()}
    calibration = calibrate(replace(recording, sources=gyros_alone), excluded=excluded, innovations=innovations)
    site = recording.site if recording.site is not None else Site(latitude_rad=0.0, heading_rad=0.0)
    stated = replace(site, gravity_mps2=gravity_at(recording.site).value_mps2)
    forces, notes = calibrate_forces(replace(recording, site=stated))
    return _Run(recording=recording, calibration=calibration, forces=forces, force_notes=tuple(notes))


def _sensors(runs: Sequence[_Run]) -> list[DeviceSensor]:
    """Return all sensors that some run has estimated, gyros first, with their axes in the device.

    Axes and data sheet are those of the first such run.
    """
    found: dict[tuple[SensorKind, str, str], DeviceSensor] = {}
    for run in runs:
        for gyro in run.calibration.gyros:
            data = run.recording.sources[gyro.source]
            array = data.own_array
            place = array.names.index(gyro.name)
            axes = array.p[place], array.j[place], array.k[place]
            _add(found, GYRO, gyro.source, gyro.name, axes, data.prior)
    for run in runs:
        for forces in run.forces:
            data = run.recording.sources[forces.source]
            assert data.accel_sheet is not None
            for one in forces.accelerometers:
                turned = data.mounting.axes @ np.column_stack([one.p, one.j, one.k_axis])
                axes = turned[:, 0], turned[:, 1], turned[:, 2]
                _add(found, ACCELEROMETER, forces.source, one.name, axes, data.accel_sheet.prior)
    return list(found.values())


def _add(
    sensors: dict[tuple[SensorKind, str, str], DeviceSensor],
    kind: SensorKind,
    source: str,
    name: str,
    axes: tuple[Floats, Floats, Floats],
    prior: StatePrior,
) -> None:
    """Add a sensor with its axes p, j and k in the device, unless it is there."""
    p, j, k = axes
    prior_sd = np.sqrt(prior.variances())
    sensor = DeviceSensor(kind=kind, source=source, name=name, p=p, j=j, k=k, prior_sd=prior_sd)
    sensors.setdefault((kind, source, name), sensor)


def _shown(run: _Run, sensors: Sequence[DeviceSensor], place: int) -> RunStates:
    """Return what a run at a place shows of the sensors that it has estimated, with their encoded states (``decode``
    undoes it).

    ``sensors`` are those of the device. A mounting without a stated uncertainty has that of misalignments.
    """
    numbers = {(one.kind, one.source, one.name): number for number, one in enumerate(sensors)}
    used: list[int] = []
    states: list[Floats] = []
    blocks: list[Floats] = []
    for gyro in run.calibration.gyros:
        used.append(numbers[GYRO, gyro.source, gyro.name])
        states.append(gyro.states)
        blocks.append(gyro.covariance)
    for forces in run.forces:
        used += [numbers[ACCELEROMETER, forces.source, one.name] for one in forces.accelerometers]
        states += [one.states for one in forces.accelerometers]
        blocks.append(forces.covariance)
    from scipy.linalg import block_diag

    x = np.concatenate([_encoded(own) for own in states])
    to_x = block_diag(*[np.asarray(np.linalg.inv(decoding(own)), dtype=np.float64) for own in x.reshape(-1, 4)])
    data = next(iter(run.recording.sources.values()))
    mounting_sd_rad = data.mounting.sd_rad
    if not np.isfinite(mounting_sd_rad):
        mounting_sd_rad = data.prior.sigma_rad
    return run_states(
        used,
        x,
        to_x @ block_diag(*blocks) @ to_x.T,
        np.concatenate([sensors[number].prior_sd for number in used]),
        mounting_sd_rad,
        place=place,
    )


def _encoded(states: Floats) -> Floats:
    """Return x = [k, b, s_j, s_k] of decoded states (4,)."""
    return np.asarray(states * np.array([1.0, 1.0, 1 - states[0], 1 - states[0]]))


def _gyros(runs: Sequence[_Run], sensors: Sequence[DeviceSensor], joined: JoinedStates) -> tuple[GyroCalibration, ...]:
    """Return the calibrations of the gyros, with the noise of the first run that has estimated each.

    They have no effects; their budget has the lines "runs" and "mounting".
    """
    gyros = []
    for number, sensor in enumerate(sensors):
        if sensor.kind is not GYRO:
            continue
        own = slice(4 * number, 4 * number + 4)
        key = sensor.source, sensor.name
        first = next(g for run in runs for g in run.calibration.gyros if (g.source, g.name) == key)
        lines = ("runs", "mounting")
        gyros.append(
            replace(
                first,
                states=joined.states[number],
                covariance=joined.covariance[own, own],
                p=sensor.p,
                budget=tuple(Contribution(name, joined.lines[name][own, own]) for name in lines),
                effects=(),
            )
        )
    return tuple(gyros)


def _forces(
    runs: Sequence[_Run], sensors: Sequence[DeviceSensor], joined: JoinedStates, places: Places
) -> tuple[ForceCalibration, ...]:
    """Return the calibrations of the accelerometers by source; places differ between mountings and become NaN.

    Time offsets are averaged; doubts stay empty. Gravity is NaN if the runs were made at places of several. Excluded
    are accelerometers that any run could not estimate, even where others could.
    """
    calibrations = []
    for source in dict.fromkeys(forces.source for run in runs for forces in run.forces):
        single = [forces for run in runs for forces in run.forces if forces.source == source]
        # The first with accelerometers, if any, has what is not estimated anew.
        first = max(single, key=lambda forces: bool(forces.accelerometers))
        numbers = [n for n, one in enumerate(sensors) if one.kind is ACCELEROMETER and one.source == source]
        states = [state for number in numbers for state in range(4 * number, 4 * number + 4)]
        stated = all(gravity.sd == 0 for gravity in places.gravity)
        accelerometers = [_accelerometer(single, sensors[n], n, joined, gravity_stated=stated) for n in numbers]
        calibrations.append(
            replace(
                first,
                accelerometers=tuple(accelerometers),
                covariance=joined.covariance[np.ix_(states, states)],
                arm_m=np.full(3, np.nan),
                arm_covariance_m2=np.full((3, 3), np.nan),
                gravity_mps2=first.gravity_mps2 if len(places.gravity) == 1 else np.nan,  # notes name the values
                gravity_from=places.source,
                offset=_mean_offset([forces.offset for forces in single if forces.offset is not None]),
                excluded=_excluded(runs, source),
                doubts=(),
            )
        )
    return tuple(calibrations)


def _excluded(runs: Sequence[_Run], source: str) -> tuple[Excluded, ...]:
    """Return the accelerometers of a source that some run could not estimate, once each: "RUNS: REASON" for each
    reason.
    """
    by_name: dict[str, dict[str, list[str]]] = {}
    for run in runs:
        for forces in run.forces:
            for one in forces.excluded if forces.source == source else ():
                by_name.setdefault(one.name, {}).setdefault(one.reason, []).append(run.recording.name)
    return tuple(
        Excluded(name, "; ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items()))
        for name, reasons in by_name.items()
    )


def _mean_offset(offsets: Sequence[TimeOffset]) -> TimeOffset | None:
    """Return the mean delay of several runs, weighted by their variances; None without any, or if one has no sigma."""
    weights = np.array([1 / offset.sd_s**2 for offset in offsets if offset.sd_s > 0])
    if len(weights) < max(len(offsets), 1):
        return None
    mean_s = float(weights @ np.array([offset.offset_s for offset in offsets]) / weights.sum())
    return TimeOffset(mean_s, float(1 / np.sqrt(weights.sum())))


def _accelerometer(
    single: Sequence[ForceCalibration], sensor: DeviceSensor, number: int, joined: JoinedStates, *, gravity_stated: bool
) -> AccelerometerCalibration:
    """Return the calibration of one accelerometer, with the noise of the first run that has estimated it.

    ``number`` is that of the sensor in the joined states. Its place is NaN. Unless ``gravity_stated``, the budget has a
    line "gravity" beside "runs" and "mounting".
    """
    first = next(a for forces in single for a in forces.accelerometers if a.name == sensor.name)
    own = slice(4 * number, 4 * number + 4)
    lines = ("runs", "mounting") if gravity_stated else ("runs", "mounting", "gravity")
    return replace(
        first,
        p=sensor.p,
        j=sensor.j,
        k_axis=sensor.k,
        states=joined.states[number],
        covariance=joined.covariance[own, own],
        place_m=np.full(3, np.nan),
        place_covariance_m2=np.full((3, 3), np.nan),
        budget=tuple(Contribution(name, joined.lines[name][own, own]) for name in lines),
    )


def _notes(runs: Sequence[_Run], sensors: Sequence[DeviceSensor], joined: JoinedStates) -> list[str]:
    """Return sentences on states that no run shows, on accelerometers of single runs (these first), and on biases that
    change.
    """
    notes = _by_text([(run.recording.name, note) for run in runs for note in run.force_notes])
    unseen: dict[str, list[str]] = {}
    for sensor, variance in zip(sensors, np.diag(joined.covariance).reshape(-1, 4), strict=True):
        wide = np.sqrt(variance) > _UNSEEN * sensor.prior_sd
        states = ", ".join(state.symbol for state, own in zip(sensor.kind.states, wide, strict=True) if own)
        if states:
            unseen.setdefault(states, []).append(sensor.name)
    for states, names in unseen.items():
        notes.append(sentence("estimation.joined_unseen", names=", ".join(names), states=states))
    for kind, share in joined.bias_change.items():
        own = [one for one in sensors if one.kind is kind]
        if own and share > _CHANGED:
            notes.append(sentence("estimation.joined_biases", sensors=kind.plural, share=share))
    return notes


def _doubts(runs: Sequence[_Run], joined: JoinedStates) -> list[str]:
    """Return what questions the sigmas: doubts of single runs, and runs that contradict each other.

    Doubts on states that a single run does not show are left out: the others may show them.
    """
    of_runs: list[tuple[str, str]] = []
    for run in runs:
        own = list(run.calibration.doubts)
        for forces in run.forces:
            sheet = run.recording.sources[forces.source].accel_sheet
            unseen = undetermined(forces, sheet.prior) if sheet is not None else []
            own += [doubt for doubt in forces.doubts if doubt not in unseen]
        of_runs += [(run.recording.name, doubt) for doubt in own]
    doubts = _by_text(of_runs)
    beyond = joined.misfit - joined.misfit_count
    if beyond > _CHANCE * np.sqrt(2 * joined.misfit_count):
        doubts.append(sentence("estimation.joined_misfit", misfit=joined.misfit, count=joined.misfit_count))
    return doubts


def _by_text(of_runs: Sequence[tuple[str, str]]) -> list[str]:
    """Return what is said of runs, pairs of run and text, each reason once with all runs and sensors it applies to.

    A sentence begins with the names of its runs. Of sensors that are not calibrated, each text names one.
    """
    runs: dict[str, list[str]] = {}
    for run, text in of_runs:
        runs.setdefault(text, []).append(run)
    names: dict[tuple[str, str], list[str]] = {}
    for text, own in runs.items():
        name, about_sensor, rest = text.partition(_ONE_SENSOR)
        key = ", ".join(dict.fromkeys(own)), rest if about_sensor else text
        names.setdefault(key, []).extend([name] if about_sensor else [])
    texts = []
    for (own_runs, reason), own_names in names.items():
        verb = " are not calibrated: " if len(own_names) > 1 else _ONE_SENSOR
        subject = ", ".join(own_names) + verb if own_names else ""
        texts.append(f"{own_runs}: {subject}{reason}")
    return texts
