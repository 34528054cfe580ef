"""Runs of one device: noise alone repeats as it should, a bias that differs from run to run is found."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support import TABLE_1, direct_recording, station

from estimator.calibration.gyro import GyroCalibration
from estimator.estimation.calibrate import calibrate
from estimator.estimation.repeatability import between_runs, repeatability, same_device
from estimator.geometry.array import triad
from estimator.recordings.writing import write_recording

DPH = np.pi / 180 / 3600


def run(seed: int, bias_shift_rps: float = 0.0) -> tuple[GyroCalibration, ...]:
    states = np.tile(TABLE_1, (4, 1))
    states[2, 1] += bias_shift_rps
    return calibrate(direct_recording(seed, states=states)).gyros


def test_noise_alone_scatters_as_the_sigmas_say() -> None:
    repeats = repeatability([run(seed) for seed in range(6)])
    ratio = np.array([gyro.scatter / gyro.expected for gyro in repeats])
    assert not any(gyro.differs.any() for gyro in repeats)
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.3


def test_a_bias_that_differs_from_switch_on_to_switch_on_is_found() -> None:
    shifts = 60 * DPH * np.array([-1.2, 0.4, 1.1, -0.3])
    repeats = repeatability([run(seed, shift) for seed, shift in enumerate(shifts)])
    assert [gyro.differs.tolist() for gyro in repeats] == [
        [False, gyro.name == "gyro3", False, False] for gyro in repeats
    ]
    assert repeats[2].between[1] == pytest.approx(np.std(shifts, ddof=1), rel=0.15)


def test_what_differs_between_runs_of_all_gyros_is_one_component_of_variance() -> None:
    random = np.random.default_rng(2)
    sd = np.tile([20e-6, 1.0 * DPH, 1e-5, 1e-5], (3, 4, 1))
    states = TABLE_1 + sd * random.standard_normal(sd.shape)
    assert not between_runs(states, sd).any()
    shifted = states + np.array([0.0, 12.0 * DPH, 0.0, 0.0]) * random.standard_normal((3, 4, 1))
    between = between_runs(shifted, sd)
    assert between[1] == pytest.approx(12 * DPH, rel=0.5)
    assert not between[[0, 2, 3]].any()


@pytest.mark.full
def test_the_command_compares_runs_of_one_array_and_says_so_of_another(tmp_path: Path) -> None:
    for seed in range(2):
        write_recording(tmp_path / f"run{seed}.h5", direct_recording(seed))
    other = direct_recording(0, kind="triad", array=triad(), states=np.tile(TABLE_1, (3, 1)))
    write_recording(tmp_path / "run2.h5", other)
    shown = station("calibrate", tmp_path)
    assert "Repeatability of array over 2 runs" in shown.stdout
    assert "2 different devices or arrays (gyro1, gyro2, gyro3, gyro4; x, y, z)" in shown.stdout
    lines = [json.loads(line) for line in station("calibrate", "--json", tmp_path).stdout.splitlines()]
    assert [("repeatability" in line) for line in lines] == [False, True, False]
    assert not same_device(run(0), calibrate(other).gyros)
