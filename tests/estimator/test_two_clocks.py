"""Files whose clocks run apart (real recordings, cut in two, one clock stretched), and references read too seldom."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import sensor_array
from estimator.importing.importing import Imported, import_recording
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings

DATA = Path(__file__).parents[1] / "data"
HEAD = '[device]\nname = "unit"\n[file]\nformat = "csv"\n[time]\ncolumn = "t"\nunit = "s"\n'
MPU = HEAD + (
    '[gyro]\ncolumns = ["x", "y", "z"]\nunit = "deg/s"\n[reference]\nkind = "angle"\ncolumn = "angle"\nunit = "deg"\n'
    'axis = "-z"\nfile = "reference.csv"\n'
)
BROAD = HEAD + (
    '[gyro]\ncolumns = ["x", "y", "z"]\nunit = "rad/s"\n[reference]\nkind = "attitude"\norder = "wxyz"\n'
    'columns = ["q0", "q1", "q2", "q3"]\nfile = "reference.csv"\n'
)
TOLD = re.compile(r"the clock of reference.csv is ([\d.]+) \+- ([\d.]+) ppm (slow|fast)")


def written(path: Path, heading: str, *columns: np.ndarray) -> None:
    np.savetxt(path, np.column_stack(columns), fmt="%.9g", delimiter=",", header=heading, comments="")


def mpu(folder: Path, ppm: float, late_s: float) -> None:
    """An MPU-6050 on a stepper's shaft; the encoder was logged by a computer of its own."""
    data = loadmat(DATA / "mpu6050" / "yaw_medium_110s.mat")
    t = data["all_time"].ravel()
    t = t - t[0]
    gyro = [data[f"all_gyro_2_{axis}"].ravel() for axis in "xyz"]
    written(folder / "log.csv", "t,x,y,z", t, *gyro)
    written(folder / "reference.csv", "t,angle", t * (1 + ppm * 1e-6) + late_s, data["all_encoder"].ravel())
    (folder / "mapping.toml").write_text(MPU)


def broad(folder: Path, ppm: float, late_s: float) -> None:
    """A triad turned by hand; the cameras were logged by a computer of their own, every other frame."""
    data = loadmat(DATA / "broad" / "01_undisturbed_slow_rotation_A_60s.mat")
    t = np.arange(len(data["imu_gyr"])) / float(data["sampling_rate"].ravel()[0])
    written(folder / "log.csv", "t,x,y,z", t, data["imu_gyr"])
    q = data["opt_quat"][::2]
    written(folder / "reference.csv", "t,q0,q1,q2,q3", t[::2] * (1 + ppm * 1e-6) + late_s, q)
    (folder / "mapping.toml").write_text(BROAD)


def imported(folder: Path, *changes: tuple[str, str]) -> Imported:
    text = (folder / "mapping.toml").read_text()
    for old, new in changes:
        text = text.replace(old, new)
    (folder / "mapping.toml").write_text(text)
    return import_recording(read_mapping(folder / "mapping.toml"), [folder / "log.csv"])


def drift_ppm(run: Imported) -> tuple[float, float]:
    found = TOLD.search("\n".join(run.notes))
    assert found, run.notes
    return float(found[1]) * (1 if found[3] == "fast" else -1), float(found[2])


@pytest.mark.parametrize("made", [mpu, broad])
def test_clocks_that_run_alike_are_not_told(tmp_path: Path, made: object) -> None:
    made(tmp_path, 0, 0.0)  # type: ignore[operator]
    assert not any("clock" in note for note in imported(tmp_path).notes)


@pytest.mark.parametrize(
    ("made", "ppm", "late_s", "least_ppm"),
    [(mpu, 200, 0.05, 15), (mpu, -120, -0.3, 15), (broad, 200, 0.1, 30), (broad, -150, 0.0, 30)],
)
def test_clocks_that_run_apart_are_told(
    tmp_path: Path, made: object, ppm: float, late_s: float, least_ppm: float
) -> None:
    made(tmp_path, ppm, late_s)  # type: ignore[operator]
    found, sd = drift_ppm(imported(tmp_path))
    assert abs(found - ppm) < max(3 * sd, 1)
    assert sd < least_ppm


@pytest.mark.parametrize("made", [mpu, broad])
def test_clocks_that_run_apart_are_put_right(tmp_path: Path, made: object) -> None:
    made(tmp_path, 0, 0.0)  # type: ignore[operator]
    plain = calibrate(imported(tmp_path).recording)
    made(tmp_path, 200, 0.1)  # type: ignore[operator]
    run = calibrate(imported(tmp_path).recording)
    for gyro, other in zip(run.gyros, plain.gyros, strict=True):
        # On a minute of motion by hand the sigma itself is known to a factor of two: twelve clusters tell it.
        assert (np.abs(gyro.states - other.states) < 2 * other.sd).all()
        # That of b least of all, as a minute does not tell a bias instability.
        assert (gyro.sd[[0, 2, 3]] < 2.2 * other.sd[[0, 2, 3]]).all()


def test_the_part_of_a_delay_that_is_the_clocks_is_told(tmp_path: Path) -> None:
    mpu(tmp_path, 200, 0.25)
    notes = "\n".join(imported(tmp_path).notes)
    # The gyro itself is 12 ms late: the stamps of the reference are to be moved back by 250 less 12 ms.
    offset = re.search(r"and is (-?[\d.]+) \+- [\d.]+ ms (ahead|behind) at the beginning", notes)
    assert offset
    assert float(offset[1]) == pytest.approx(238, abs=3)
    assert offset[2] == "ahead"


@pytest.mark.parametrize(("made", "late_s"), [(mpu, 1234.5), (broad, -77.7)])
def test_clocks_that_have_nothing_to_do_with_each_other_are_joined_by_the_motion(
    tmp_path: Path, made: object, late_s: float
) -> None:
    made(tmp_path, 80, late_s)  # type: ignore[operator]
    text = (tmp_path / "mapping.toml").read_text()
    (tmp_path / "mapping.toml").write_text(text + '[reference.time]\noffset_s = "from data"\n')
    run = imported(tmp_path)
    assert any("reference.csv begins" in note for note in run.notes)
    found, sd = drift_ppm(run)
    assert abs(found - 80) < max(3 * sd, 1)
    assert not any("hardly follows" in note or "times the reference" in note for note in run.notes)


# --- a reference that is read too seldom


def read_every(step_s: float) -> Recording:
    """A gyro at 100 Hz against the rate of another instrument, which is read so seldom."""
    t, read = np.arange(12000) / 100, np.arange(0, 120, step_s)

    def rate(at: np.ndarray) -> np.ndarray:
        return np.asarray(np.radians(np.column_stack([0 * at, 0 * at, 60 * np.sin(1.1 * at) + 30 * np.sin(0.37 * at)])))

    output = 0.99 * rate(t)[:, 2:] + np.random.default_rng(7).normal(scale=1e-3, size=(len(t), 1))
    data = ImuData(sensor_array([[0, 0, 1]], names=("z",), part_of_array=True), ns(t), output)
    return Recording({"imu": data}, RateReadings(ns(read), rate(read)), None)


def ns(t_s: np.ndarray) -> np.ndarray:
    return np.asarray(np.round(t_s * 1e9), dtype=np.int64)


@pytest.mark.parametrize("step_s", [0.02, 0.1])
def test_a_reference_that_is_read_often_enough_is_not_told(step_s: float) -> None:
    found = calibrate(read_every(step_s))
    assert not any("too rarely" in note for note in found.notes)
    assert found.gyros[0].states[0] == pytest.approx(0.01, abs=2e-4)


@pytest.mark.parametrize("step_s", [1.0, 2.0])
def test_a_reference_that_is_read_too_seldom_for_its_motion_is_told(step_s: float) -> None:
    doubts = calibrate(read_every(step_s)).doubts
    assert any(f"the reference is read every {step_s:g} s, too rarely for this motion" in doubt for doubt in doubts)
