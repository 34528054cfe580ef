"""A whole IMU on a table of one axis: three mountings joined to one calibration of 24 states."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from three_mountings import DEVICE, MOUNTING_DEG, ThreeRuns, three_runs

from estimator.errors import RecordingError
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.estimation.calibrate import calibrate
from estimator.estimation.mountings.join import JoinedCalibration, join_mountings
from estimator.geometry.kinematics import gravity_at
from estimator.recordings.recording import Recording

SURE = 4.0  # sigmas, for 24 values


@cache
def lying() -> ThreeRuns:
    return three_runs(1, switched_off=True)


def joined(runs: ThreeRuns, recordings: list[Recording] | None = None) -> JoinedCalibration:
    """Return the calibration of some of the recordings of three runs, of all by default."""
    used = runs.recordings if recordings is None else recordings
    return join_mountings(used, excluded=[runs.benches[0].excluded] * len(used), innovations=False)


@cache
def of_three() -> JoinedCalibration:
    return joined(lying())


def in_sigmas(found: JoinedCalibration, truth: ThreeRuns) -> np.ndarray:
    """Return the errors (24,) of all states over their stated standard deviations."""
    (forces,) = found.calibration.forces
    pairs = [*zip(found.calibration.gyros, truth.gyros, strict=True)]
    return np.concatenate(
        [(g.states - true) / g.sd for g, true in pairs]
        + [(a.states - true) / a.sd for a, true in zip(forces.accelerometers, truth.accelerometers, strict=True)]
    )


def test_three_mountings_show_all_states_within_their_sigmas() -> None:
    errors = in_sigmas(of_three(), lying())
    assert errors.shape == (24,)
    assert np.abs(errors).max() < SURE
    gyro_sd = np.array([gyro.sd for gyro in of_three().calibration.gyros])
    force_sd = np.array([one.sd for one in of_three().calibration.forces[0].accelerometers])
    assert np.all(gyro_sd[:, 0] < 20e-6)
    assert np.all(force_sd[:, 0] < 60e-6)
    assert np.all(gyro_sd[:, 2:] < 30e-6)  # the mountings are good to 3500 urad
    assert np.all(force_sd[:, 2:] < 30e-6)
    assert not of_three().calibration.doubts


@pytest.mark.full
@pytest.mark.parametrize("seed", [2, 3, 4])
def test_devices_differ_and_so_do_their_mountings(seed: int) -> None:
    runs = three_runs(seed)
    assert np.abs(in_sigmas(joined(runs), runs)).max() < SURE


def test_one_mounting_leaves_states_that_it_cannot_show() -> None:
    run = lying().recordings[0]
    prior_rad = run.sources[DEVICE].prior.sigma_rad
    alone = calibrate(run, excluded=lying().benches[0].excluded, innovations=False)
    by_name = {gyro.name: gyro.sd for gyro in alone.gyros}
    assert by_name["x"][0] < 20e-6
    assert by_name["y"][0] > 0.03  # of 5 % on the data sheet: nothing turns about y
    assert np.all(by_name["x"][2:] > 0.9 * prior_rad)
    along = alone.forces[0].accelerometers[0]
    assert along.sd[0] > 0.9e-2  # gravity never points along the axis of the table


def test_a_delay_is_found_where_gravity_does_not_turn() -> None:
    """About a standing axis only the centripetal force on ramps shows it: hardly, and no more is claimed."""
    (found,), _ = calibrate_forces(three_runs(1, "z").recordings[0])
    assert found.offset is not None
    assert found.offset.sd_s > 1e-3
    assert abs(found.offset.offset_s - 1.5e-3) < SURE * found.offset.sd_s


def test_biases_that_change_when_the_device_is_remounted_are_in_their_sigmas() -> None:
    (forces,) = of_three().calibration.forces
    for one in forces.accelerometers:
        assert one.sd[1] > 0.1e-3 * 9.80665


@pytest.mark.full
def test_biases_that_stay_are_known_better() -> None:
    (forces,) = joined(three_runs(1)).calibration.forces
    for one in forces.accelerometers:
        assert one.sd[1] < 0.05e-3 * 9.80665


def test_gravity_is_one_error_of_all_runs() -> None:
    """Three runs do not know gravity better than one: it stays 50 ppm."""
    for one in of_three().calibration.forces[0].accelerometers:
        lines = {line.name: line.u for line in one.budget}
        assert lines["gravity"][0] == pytest.approx(50e-6, rel=0.05)
        assert one.sd[0] > 49e-6


def test_runs_at_places_with_another_gravity_are_each_used_with_its_own() -> None:
    """On top of a mountain, 0.1 % less gravity leaves all states where they are, and its error is another one."""
    first, second, third = lying().recordings
    assert third.site is not None
    here = gravity_at(third.site).value_mps2
    mountain = replace(third.site, height_m=third.site.height_m + 3200)
    data = third.sources[DEVICE]
    assert data.accel_mps2 is not None
    felt = replace(data, accel_mps2=data.accel_mps2 * gravity_at(mountain).value_mps2 / here)
    found = joined(lying(), [first, second, replace(third, site=mountain, sources={DEVICE: felt})])
    assert np.abs(in_sigmas(found, lying())).max() < SURE
    assert not found.calibration.doubts
    (note,) = [note for note in found.calibration.notes if "gravity is not the same" in note]
    assert "9.80620 m/s2" in note
    assert "9.79632 m/s2" in note
    for one in found.calibration.forces[0].accelerometers:
        u = next(line.u for line in one.budget if line.name == "gravity")
        assert 30e-6 < u[0] < 50e-6  # two places know gravity better than one


def test_a_reason_that_all_accelerometers_have_is_said_once() -> None:
    """One mounting, joined with itself, shows nothing about two axes of the gyros; then no accelerometer works."""
    first, *_ = lying().recordings
    notes = joined(lying(), [first, first]).calibration.notes
    assert [note for note in notes if "not determined" in note and note.startswith("y, z, accel x: k, ")]
    dead = [
        replace(run, path=Path(f"{axis}.h5"), sources={DEVICE: replace(data, accel_mps2=0 * data.accel_mps2)})
        for axis, run in zip("xyz", lying().recordings, strict=True)
        for data in run.sources.values()
        if data.accel_mps2 is not None
    ]
    found = joined(lying(), dead).calibration
    (reason,) = [note for note in found.notes if "disconnected or stuck" in note]
    assert reason.startswith("x.h5, y.h5, z.h5: accel x, accel y, accel z are not calibrated: ")
    assert reason in found.doubts
    assert [one.name for one in found.forces[0].excluded] == ["accel x", "accel y", "accel z"]
    assert len({one.reason for one in found.forces[0].excluded}) == 1


def test_the_mounting_errors_are_found_as_they_were() -> None:
    """All but the turn about the table's own axis, where the zero of the table is not known."""
    for number, (found, bench) in enumerate(zip(of_three().mountings, lying().benches, strict=True)):
        across = np.arange(3) != number
        assert np.all(found.sd_rad[across] < 30e-6)
        assert np.all(np.abs(found.error_rad) < 4 * np.radians(MOUNTING_DEG))
        assert bench.imus[0].mounting.sd_rad == pytest.approx(np.radians(MOUNTING_DEG))


def test_gyros_alone_know_their_misalignments_as_well_as_the_mountings() -> None:
    """Without accelerometers nothing tells how the axis of the table lies in the device."""
    alone = []
    for run in lying().recordings:
        data = replace(run.sources[DEVICE], accel_mps2=None, accel_sheet=None)
        alone.append(replace(run, sources={DEVICE: data}))
    found = joined(lying(), alone).calibration
    assert not found.forces
    for gyro, true in zip(found.gyros, lying().gyros, strict=True):
        assert np.all(np.abs(gyro.states - true) < SURE * gyro.sd)
        assert np.all(gyro.sd[2:] > 0.3 * np.radians(MOUNTING_DEG))
        assert np.all(gyro.sd[2:] < 2 * np.radians(MOUNTING_DEG))


def test_a_run_of_another_device_is_doubted() -> None:
    """Its accelerometers have scale factors that are 500 ppm larger."""
    first, second, third = lying().recordings
    data = third.sources[DEVICE]
    assert data.accel_mps2 is not None
    other = replace(data, accel_mps2=data.accel_mps2 * (1 + 500e-6))
    (doubt,) = joined(lying(), [first, second, replace(third, sources={DEVICE: other})]).calibration.doubts
    assert "contradict each other" in doubt


def test_a_mounting_that_was_not_as_stated_is_told_by_gravity() -> None:
    """The y and z axes of the device are stated the other way round in one run."""
    first, second, third = lying().recordings
    data = second.sources[DEVICE]
    turn = np.diag([1.0, -1.0, -1.0]) @ data.mounting.axes
    assert data.accel_axes is not None
    wrong = replace(
        data,
        array=data.array.turned(data.mounting.axes.T @ turn),
        mounting=replace(data.mounting, axes=turn),
        accel_axes=data.accel_axes @ data.mounting.axes.T @ turn,
    )
    found = joined(lying(), [first, replace(second, sources={DEVICE: wrong}), third])
    told = {one.name: one.reason for one in found.calibration.forces[0].excluded}
    assert "opposite of its stated axis" in told["accel z"]  # y lies along the axis of the table
    assert any("contradict each other" in doubt for doubt in found.calibration.doubts)


def test_recordings_that_cannot_be_joined_are_refused() -> None:
    first, second, _ = lying().recordings
    with pytest.raises(RecordingError, match="nothing to be joined"):
        joined(lying(), [first])
    data = second.sources[DEVICE]
    other = replace(second, sources={DEVICE: replace(data, device="another")})
    with pytest.raises(RecordingError, match="not of the same device"):
        joined(lying(), [first, other])
    cone = replace(second, sources={DEVICE: replace(data, array=first.sources[DEVICE].array)})
    with pytest.raises(RecordingError, match="other axes"):
        joined(lying(), [first, cone])
