"""Accelerometers on a table: their states and places as the twin has them, and what is no scale factor error."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.calibration_file import read_calibration, write_calibration
from estimator.errors import RecordingError
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.estimation.calibrate import calibrate
from estimator.geometry.kinematics import GRAVITY_MPS2, normal_gravity_mps2
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.writing import write_recording
from sims.physics.accelerometer import AccelerometerTruth
from station.bench.bench import Bench, load_bench, read_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of
from station.scripts.script import load_script
from station.scripts.steps.pose import Pose

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
SURE = 4.5  # sigmas, for some twenty values
DEVICE = "mti"


def slower(text: str) -> Bench:
    """Return the bench with a device that sends 50 samples a second, for the sake of time."""
    return read_bench(text.replace('rate = "100 Hz"', 'rate = "50 Hz"'), "bench")


@cache
def run(seed: int = 1) -> tuple[Recording, AccelerometerTruth]:
    """Return a run of the shipped script for a whole IMU, and the truth of its accelerometers."""
    bench = slower(BENCH.read_text(encoding="utf-8"))
    (imu,) = bench.imus
    felt = force_truth_of(bench.twin.truths.again(), imu, bench.site)
    assert felt is not None
    return simulate_bench(bench, load_script(Path("full-imu")), seed), felt[0]


@cache
def calibrated() -> ForceCalibration:
    (found,), notes = calibrate_forces(run()[0])
    assert not notes
    return found


def with_outputs(outputs: np.ndarray) -> Recording:
    """Return the run with other outputs of its accelerometers."""
    recording = run()[0]
    return replace(recording, sources={DEVICE: replace(recording.sources[DEVICE], accel_mps2=outputs)})


def outputs() -> np.ndarray:
    felt = run()[0].sources[DEVICE].accel_mps2
    assert felt is not None
    return felt


def test_states_and_places_are_found_within_their_sigmas() -> None:
    found, truth = calibrated(), run()[1]
    true = np.column_stack([truth.k, truth.b_mps2, truth.sigma_j_rad, truth.sigma_k_rad])
    for one, states, place in zip(found.accelerometers, true, truth.places_m, strict=True):
        assert np.all(np.abs(one.states - states) < SURE * one.sd), one.name
        assert np.all(np.abs(one.place_m - place) < SURE * one.place_sd_m), one.name
        assert np.all(one.place_sd_m < 5e-4)
        assert one.sd[1] < 5e-5 * GRAVITY_MPS2
        assert one.noise_mps2 == pytest.approx(60e-6 * GRAVITY_MPS2 * np.sqrt(50), rel=0.05)
        assert np.all(one.sd[2:] < 5e-5)
    assert np.all(np.abs(found.arm_m - truth.places_m.mean(axis=0)) < SURE * found.arm_sd_m)


def test_the_delay_of_the_accelerometers_is_their_own() -> None:
    offset = calibrated().offset
    assert offset is not None
    assert offset.offset_s == pytest.approx(run()[1].delay_s, abs=SURE * offset.sd_s)
    assert offset.sd_s < 1e-4


def test_unmeasured_gravity_is_a_line_of_the_budget() -> None:
    lines = {line.name: line.u for line in calibrated().accelerometers[0].budget}
    assert lines["gravity"][0] == pytest.approx(5e-5, rel=0.01)
    recording = run()[0]
    assert recording.site is not None
    measured = replace(recording, site=replace(recording.site, gravity_mps2=9.8062))
    (found,), _ = calibrate_forces(measured)
    assert "gravity" not in {line.name for line in found.accelerometers[0].budget}
    assert found.accelerometers[0].sd[0] < 2e-5


def test_rounded_angles_at_rest_do_not_hide_what_turns_show() -> None:
    """A count is 767 urad here, a standing axis off by 221 urad: the turns show misalignments to far less than that."""
    recording, truth = run()
    table = recording.table
    assert table is not None
    count_rad = 2 * np.pi / 8192
    rounded = replace(table, angle_rad=np.round(table.angle_rad / count_rad) * count_rad)
    (found,), _ = calibrate_forces(replace(recording, reference=rounded))
    true = np.column_stack([truth.k, truth.b_mps2, truth.sigma_j_rad, truth.sigma_k_rad])
    for one, states in zip(found.accelerometers, true, strict=True):
        assert np.all(np.abs(one.states - states) < SURE * one.sd), one.name
        assert np.all(one.sd[2:] < 5e-5), one.name
        assert "resolution" in {line.name for line in one.budget}


def test_an_axis_stands_off_its_reading_while_others_turn() -> None:
    """All poses are 0.4 counts of coarse encoders off, the last of them while the other axes turn."""
    count_rad = 2 * np.pi / 8192

    def off(pose: Pose) -> Pose:
        return replace(pose, aims=tuple(replace(aim, angle_rad=aim.angle_rad + 0.4 * count_rad) for aim in pose.aims))

    script = load_script(Path("full-imu"))
    moved = replace(script, steps=tuple(off(step) if isinstance(step, Pose) else step for step in script.steps))
    recording = simulate_bench(slower(BENCH.read_text(encoding="utf-8")), moved, 1)
    table, truth = recording.table, run()[1]
    assert table is not None
    rounded = replace(table, angle_rad=np.round(table.angle_rad / count_rad) * count_rad)
    (found,), _ = calibrate_forces(replace(recording, reference=rounded))
    true = np.column_stack([truth.k, truth.b_mps2, truth.sigma_j_rad, truth.sigma_k_rad])
    for one, states in zip(found.accelerometers, true, strict=True):
        assert np.all(np.abs(one.states - states) < SURE * one.sd), one.name


def test_gravity_is_that_of_latitude_and_height() -> None:
    """WGS 84: 9.7803253359 m/s2 at the equator, 9.8321849379 at the pole; 3.086 um/s2 less for each metre."""
    assert normal_gravity_mps2(0.0) == pytest.approx(9.7803253359, abs=1e-9)
    assert normal_gravity_mps2(np.pi / 2) == pytest.approx(9.8321849379, abs=1e-8)
    assert normal_gravity_mps2(0.8, 100.0) == pytest.approx(normal_gravity_mps2(0.8) - 3.086e-4, abs=1e-9)


def test_intrinsic_parameters_do_not_depend_on_the_mounting() -> None:
    """Those of a device that is turned on the plate are the same, though its misalignments are not."""
    recording = run()[0]
    data = recording.sources[DEVICE]
    turn = np.radians(0.5)
    about_z = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    assert data.accel_axes is not None
    askew = replace(recording, sources={DEVICE: replace(data, accel_axes=data.accel_axes @ about_z)})
    (turned,), _ = calibrate_forces(askew)
    straight = calibrated()
    assert abs(turned.accelerometers[0].states[2:] - straight.accelerometers[0].states[2:]).max() > 5e-3
    for key in ("sensitivity", "offset_mps2", "angle_rad"):
        ours, theirs = getattr(straight.intrinsic, key), getattr(turned.intrinsic, key)
        np.testing.assert_allclose(theirs, ours, atol=2e-6)


def gross(case: str) -> np.ndarray:
    felt = outputs().copy()
    match case:
        case "in g":
            return felt / GRAVITY_MPS2
        case "swapped":
            return felt[:, [1, 0, 2]]
        case "reversed":
            felt[:, 1] *= -1
        case "z reads 14.6":
            felt[:, 2] *= 14.6 / 9.806
        case "dead":
            felt[:, 0] = 0.02
        case "noise alone":
            felt[:, 0] = 0.01 * np.random.default_rng(1).standard_normal(len(felt))
    return felt


@pytest.mark.parametrize(
    ("case", "who", "reason"),
    [
        ("in g", {"accel x", "accel y", "accel z"}, "g in place of m/s2"),
        ("swapped", {"accel x", "accel y"}, "senses along"),
        ("reversed", {"accel y"}, "opposite of its stated axis"),
        ("z reads 14.6", {"accel z"}, "1.49 times gravity"),
        ("dead", {"accel x"}, "constant"),
        ("noise alone", {"accel x"}, "does not follow gravity"),
    ],
)
def test_a_gross_error_is_named_and_never_fitted_away(case: str, who: set[str], reason: str) -> None:
    (found,), _ = calibrate_forces(with_outputs(gross(case)))
    assert {one.name for one in found.excluded} == who
    assert all(reason in one.reason for one in found.excluded)
    assert {one.name for one in found.accelerometers} == {"accel x", "accel y", "accel z"} - who
    assert all(name in " ".join(found.doubts) for name in who)


@pytest.mark.parametrize("limit_mps2", [8.0, 9.0, 9.5])
def test_samples_at_a_limit_are_left_out(limit_mps2: float) -> None:
    """What is left differs from the whole by no more than the noise of what was left out."""
    (found,), notes = calibrate_forces(with_outputs(np.clip(outputs(), -limit_mps2, limit_mps2)))
    assert sum("limit of its range" in note for note in notes) == 3
    for one, whole in zip(found.accelerometers, calibrated().accelerometers, strict=True):
        assert np.all(np.abs(one.states - whole.states) < SURE * one.sd)


def test_steps_that_noise_does_not_average_are_told() -> None:
    rounded = outputs().copy()
    rounded[:, 0] = np.round(rounded[:, 0] / 0.004) * 0.004  # a step is one standard deviation of the noise
    rounded[:, 1] = np.round(rounded[:, 1] / 0.02) * 0.02
    (found,), _ = calibrate_forces(with_outputs(rounded))
    (doubt,) = found.doubts
    assert doubt.startswith("accel y changes in steps of 0.02 m/s2")


def test_a_table_that_does_not_tilt_shows_little_and_says_so() -> None:
    recording = run()[0]
    table = recording.table
    assert table is not None
    end_ns = int(20e9)  # the rest at the beginning
    data = recording.sources[DEVICE]
    rows = int(np.searchsorted(data.t_ns, end_ns))
    reads = int(np.searchsorted(table.t_ns, end_ns))
    short = replace(
        recording,
        sources={DEVICE: _first(data, rows)},
        reference=replace(
            table, t_ns=table.t_ns[:reads], angle_rad=table.angle_rad[:reads], rate_rps=table.rate_rps[:reads]
        ),
    )
    (found,), _ = calibrate_forces(short)
    assert not found.excluded
    assert any("accel x: k, b" in doubt and "not determined by this run" in doubt for doubt in found.doubts)


def _first(data: ImuData, rows: int) -> ImuData:
    assert data.accel_mps2 is not None
    assert data.temperature_c is not None
    return replace(
        data,
        t_ns=data.t_ns[:rows],
        rate_rps=data.rate_rps[:rows],
        accel_mps2=data.accel_mps2[:rows],
        temperature_c=data.temperature_c[:rows],
    )


def test_gravity_of_an_unknown_place_is_not_known_to_50_ppm() -> None:
    """At the equator standard gravity is wrong by 2700 ppm."""
    recording = run()[0]
    (found,), _ = calibrate_forces(replace(with_outputs(outputs() * 9.7803 / 9.8062), site=None))
    assert "no site" in found.gravity_from
    for one, k in zip(found.accelerometers, run()[1].k, strict=True):
        assert abs(one.states[0] - k) < 2 * one.sd[0]
    assert recording.site is not None


def test_a_few_impossible_samples_are_left_out_and_change_nothing() -> None:
    felt = outputs().copy()
    felt[[100, 101, 102, 9000, 9001, 9002, 9003], 0] = [3e4] * 3 + [-3e4] * 4
    (found,), notes = calibrate_forces(with_outputs(felt))
    assert any("accel x" in note and "more than any force" in note for note in notes)
    for one, whole in zip(found.accelerometers, calibrated().accelerometers, strict=True):
        assert np.all(np.abs(one.states - whole.states) < 0.5 * one.sd)


def test_an_accelerometer_that_sticks_for_a_time_is_told_and_not_believed_there() -> None:
    felt = outputs().copy()
    since = 2 * len(felt) // 3
    felt[since:, 1] = felt[since, 1]
    (found,), _ = calibrate_forces(with_outputs(felt))
    assert any("accel y repeats one value" in doubt for doubt in found.doubts)
    for one, whole in zip(found.accelerometers, calibrated().accelerometers, strict=True):
        assert np.all(np.abs(one.states - whole.states) < SURE * one.sd)


def test_an_accelerometer_that_sticks_while_nothing_moves_is_told_too() -> None:
    felt = outputs().copy()
    felt[250:900, 1] = 0.0  # of the rest at the beginning, in which it lies level
    (found,), _ = calibrate_forces(with_outputs(felt))
    assert any("accel y repeats one value from 5 s on" in doubt for doubt in found.doubts)
    for one, whole in zip(found.accelerometers, calibrated().accelerometers, strict=True):
        assert np.all(np.abs(one.states - whole.states) < one.sd)


@pytest.mark.parametrize("late", [False, True])
def test_accelerometers_slower_than_the_gyros_are_calibrated_whichever_rows_hold_numbers(late: bool) -> None:
    recording = run()[0]
    data = recording.sources[DEVICE]
    twice = np.arange(2 * len(data.t_ns)) // 2
    held = np.arange(len(twice)) % 2 == (1 if late else 0)
    assert data.temperature_c is not None
    more = replace(
        data,
        t_ns=data.t_ns[twice] + np.where(held, 0, -10_000_000 if late else 10_000_000),
        rate_rps=data.rate_rps[twice],
        temperature_c=data.temperature_c[twice],
        accel_mps2=np.where(held[:, None], outputs()[twice], np.nan),
    )
    (found,), _ = calibrate_forces(replace(recording, sources={DEVICE: more}))
    assert not found.excluded
    for one, whole in zip(found.accelerometers, calibrated().accelerometers, strict=True):
        assert np.all(np.abs(one.states - whole.states) < 0.5 * one.sd)


def test_accelerometers_that_should_be_calibrated_and_cannot_be_are_excluded_with_the_reason() -> None:
    felt = outputs().copy()
    felt[50:] = np.nan
    (found,), _ = calibrate_forces(with_outputs(felt))
    assert [one.name for one in found.excluded] == ["accel x", "accel y", "accel z"]
    assert "too little data" in found.excluded[0].reason


def test_a_device_that_sends_no_forces_though_its_data_sheet_is_stated_is_excluded(tmp_path: Path) -> None:
    recording = run()[0]
    data = replace(recording.sources[DEVICE], accel_mps2=None, accel_axes=None)
    write_recording(tmp_path / "silent.h5", replace(recording, sources={DEVICE: data}))
    (found,), _ = calibrate_forces(read_recording(tmp_path / "silent.h5"))
    (silent,) = found.excluded
    assert silent.name == "mti accelerometers"
    assert "no specific force" in silent.reason


def test_a_channel_that_loses_data_of_all_is_told() -> None:
    felt = outputs().copy()
    felt[len(felt) // 2 :, 0] = np.nan
    _, notes = calibrate_forces(with_outputs(felt))
    assert any("accel x has no usable value in 50%" in note for note in notes)


@pytest.mark.parametrize(
    ("key", "values"),
    [("accel_prior", [0.01, 0.2, 0.02]), ("accel_prior", [0.01, 0.2, 0.02, 0.1, 0.0]), ("accel_noise", [1e-3])],
)
def test_a_data_sheet_that_makes_no_sense_is_refused_in_words(tmp_path: Path, key: str, values: list[float]) -> None:
    path = tmp_path / "imu.h5"
    write_recording(path, run()[0])
    with h5py.File(path, "r+") as file:
        file[f"imu/{DEVICE}"].attrs[key] = values
    with pytest.raises(RecordingError, match=f"/imu/{DEVICE}: {key}"):
        read_recording(path)


def test_a_recording_keeps_data_sheet_and_calibration(tmp_path: Path) -> None:
    path = tmp_path / "imu.h5"
    write_recording(path, run()[0])
    recording = read_recording(path)
    assert recording.sources[DEVICE].accel_sheet == load_bench(BENCH).imus[0].force_sheet
    found = calibrate(recording, excluded=frozenset(), innovations=False)
    write_calibration(path, found)
    (kept,), (own,) = read_calibration(path).forces, found.forces
    np.testing.assert_array_equal(kept.covariance, own.covariance)
    np.testing.assert_array_equal(kept.accelerometers[2].states, own.accelerometers[2].states)
    assert kept.offset == own.offset
    assert kept.accelerometers[1].noise == own.accelerometers[1].noise


def test_a_device_without_a_data_sheet_for_them_is_calibrated_as_before() -> None:
    recording = run()[0]
    bare = replace(recording, sources={DEVICE: replace(recording.sources[DEVICE], accel_sheet=None)})
    with_them = calibrate(recording, excluded=frozenset(), innovations=False)
    without = calibrate(bare, excluded=frozenset(), innovations=False)
    assert without.forces == ()
    for one, other in zip(with_them.gyros, without.gyros, strict=True):
        np.testing.assert_array_equal(one.states, other.states)
        np.testing.assert_array_equal(one.covariance, other.covariance)
