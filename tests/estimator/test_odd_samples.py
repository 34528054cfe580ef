"""Samples that are none: spikes, values that come twice, rows that are lost. Told, left out; no motion is bitten."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import MAPPING, imported, written

from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import sensor_array
from estimator.importing.importing import SOURCE, Imported
from estimator.observations.health import usable
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings

DATA = Path(__file__).parents[1] / "data"
HZ, N = 100, 12000
K, BIAS_DPS = 0.01, 0.5
T = np.arange(N) / HZ


def motion(t: np.ndarray) -> np.ndarray:
    """Return rates (rows, 3) in deg/s: two minutes of turns by hand, a rest in their middle."""
    rate = np.column_stack([90 * np.sin(t), 60 * np.cos(1.3 * t), 75 * np.sin(0.7 * t)])
    return np.asarray(np.where(np.abs(t - 60)[:, None] < 8, 0.0, rate))


def log(seed: int = 3) -> np.ndarray:
    """Return rows of stamps, gyros and a reference with noise of its own."""
    rng = np.random.default_rng(seed)
    gyro = (1 - K) * motion(T) - BIAS_DPS + rng.normal(scale=0.05, size=(N, 3))
    return np.column_stack([T, gyro, motion(T) + rng.normal(scale=0.02, size=(N, 3))])


def run_of(tmp_path: Path, rows: np.ndarray, mapping: str = MAPPING) -> Imported:
    text = StringIO()
    np.savetxt(text, rows, fmt="%.5f", delimiter=",", header="t,gx,gy,gz,rx,ry,rz", comments="")
    return imported(*written(tmp_path, mapping, text.getvalue()))


def spiked(rows: np.ndarray, columns: slice, count: int, seed: int) -> np.ndarray:
    """Return the rows with single values replaced by any, as by a line without check sums."""
    rng = np.random.default_rng(seed)
    out = rows.copy()
    at = rng.choice(np.arange(50, N - 50, 8), count, replace=False)
    out[at, rng.integers(columns.start, columns.stop, count)] = rng.uniform(-3e4, 3e4, count)
    return out


def assert_same(run: Imported, clean: Imported, within: float = 1.0, widest: float = 1.15) -> None:
    """The states are those of the clean file, and so are the sigmas."""
    for gyro, other in zip(calibrate(run.recording).gyros, calibrate(clean.recording).gyros, strict=True):
        assert (np.abs(gyro.states - other.states) < within * other.sd).all()
        assert (gyro.sd < widest * other.sd).all()
        assert abs(gyro.states[0] - K) < 5 * gyro.sd[0]


# --- spikes


def test_spikes_of_gyros_and_reference_are_told_and_left_out(tmp_path: Path) -> None:
    run = run_of(tmp_path, spiked(spiked(log(), slice(1, 4), 12, 1), slice(4, 7), 9, 2))
    notes = "\n".join(run.notes)
    assert re.search(r"gyro.*: 12 of 12000 samples \(0\.1 %\) are spikes.*the first at .* s", notes)
    assert re.search(r"reference: 9 of 12000 .* are spikes", notes)
    assert_same(run, run_of(tmp_path, log()))


def test_two_spikes_side_by_side_are_two(tmp_path: Path) -> None:
    rows = log()
    rows[3000:3002, 2] = [900, -700]
    run = run_of(tmp_path, rows)
    assert any("2 of 12000 samples" in note and "spikes" in note for note in run.notes)


def test_an_angle_that_goes_round_has_spikes_too(tmp_path: Path) -> None:
    rows = log()
    rate = 90 * np.sin(T)
    angle = np.cumsum(rate) / HZ * 8 % 360
    rows[:, 1] = 8 * rate + np.random.default_rng(5).normal(scale=0.1, size=N)
    rows[:, 4] = np.round(angle / 0.1) * 0.1
    rows[[1000, 5000, 9000], 4] = [-400, 77.7, 1e6]
    mapping = MAPPING.split("[gyro]")[0] + (
        '[gyro]\ncolumns = ["gx"]\nunit = "deg/s"\naxes = ["x"]\n'
        '[reference]\nkind = "angle"\ncolumn = "rx"\nunit = "deg"\naxis = "x"\n'
    )
    run = run_of(tmp_path, rows, mapping)
    assert any(note.startswith("reference: 3 of 12000") for note in run.notes)
    found = calibrate(run.recording).gyros[0]
    assert abs(found.states[0]) < 5 * found.sd[0] < 1e-3


def recording_of(rate_rps: np.ndarray) -> Recording:
    t_ns = np.asarray(T * 1e9, dtype=np.int64)
    data = ImuData(sensor_array(np.eye(3), names=("x", "y", "z")), t_ns, rate_rps)
    return Recording({"imu": data}, RateReadings(t_ns, np.radians(motion(T))), None)


def test_a_recording_that_has_spikes_is_calibrated_without_them() -> None:
    clean = np.radians(log()[:, 1:4])
    dirty = np.radians(spiked(log(), slice(1, 4), 12, 4)[:, 1:4])
    found, expected = calibrate(recording_of(dirty)), calibrate(recording_of(clean))
    assert any("12 of 12000 samples (0.1 %) are spikes" in note for note in found.notes)
    for gyro, other in zip(found.gyros, expected.gyros, strict=True):
        assert (np.abs(gyro.states - other.states) < other.sd).all()
        assert (gyro.sd < 1.15 * other.sd).all()


# --- what is no spike


def white(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(scale=0.05, size=N)


def laplace(rng: np.random.Generator) -> np.ndarray:
    return rng.laplace(scale=0.05, size=N)


def heavy_tails(rng: np.random.Generator) -> np.ndarray:
    return 0.05 * rng.standard_t(3, size=N)


def steps_of_rate(rng: np.random.Generator) -> np.ndarray:
    return np.where(T // 3 % 2 > 0, 200.0, -100.0) + white(rng)


def steep_ramps(rng: np.random.Generator) -> np.ndarray:
    return np.clip(150 * np.sin(2 * np.pi * T / 4) * 8, -150, 150) + white(rng)


def bursts_of_vibration(rng: np.random.Generator) -> np.ndarray:
    return 80 * np.sin(2 * np.pi * 31 * T) * (np.sin(2 * np.pi * T / 7) > 0.3) + white(rng)


def vibration_at_half_the_rate(rng: np.random.Generator) -> np.ndarray:
    return 50 * np.cos(np.pi * np.arange(N)) * np.sin(2 * np.pi * T / 9) ** 8 + white(rng)


def coarse(rng: np.random.Generator) -> np.ndarray:
    return np.round((30 * np.sin(T) + white(rng)) / 0.57) * 0.57


def coarse_at_rest(rng: np.random.Generator) -> np.ndarray:
    return np.round((0.15 + white(rng)) / 0.57) * 0.57


def knocks(rng: np.random.Generator) -> np.ndarray:
    ring = np.convolve(np.where(np.arange(N) % 1500 == 700, 1.0, 0.0), np.exp(-np.arange(40) / 5), "full")[:N]
    return 60 * ring * np.cos(2 * np.pi * 17 * T) + white(rng)


def hand_tremor(rng: np.random.Generator) -> np.ndarray:
    return 90 * np.sin(T) + np.convolve(rng.normal(scale=20, size=N), np.ones(4) / 4, "same")


def walk(rng: np.random.Generator) -> np.ndarray:
    return np.cumsum(rng.normal(scale=0.05, size=N))


@pytest.mark.parametrize(
    "made",
    [
        white,
        laplace,
        heavy_tails,
        steps_of_rate,
        steep_ramps,
        bursts_of_vibration,
        vibration_at_half_the_rate,
        coarse,
        coarse_at_rest,
        knocks,
        hand_tremor,
        walk,
    ],
)
def test_motion_and_noise_are_no_spikes(made: Callable[[np.random.Generator], np.ndarray]) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed)
        whole = recording_of(np.radians(np.column_stack([made(rng) for _ in range(3)]))).sources["imu"]
        found = usable(whole, fine=False)
        assert [note for note in found.notes if "spike" in note or "twice" in note] == []
        assert len(found.parts[0].t_ns) == N


@pytest.mark.parametrize(
    ("mapping", "files"),
    [
        ("mpu6050/yaw.toml", "mpu6050/yaw_medium_110s.mat"),
        ("broad/mapping.toml", "broad/*.mat"),
        ("ferraris/mapping.toml", "ferraris/session.csv"),
        ("phones/mapping_iphone.toml", "phones/Iphone14pro_?G*.csv"),
        ("phones/mapping_samsung.toml", "phones/Samsung*.csv"),
    ],
)
def test_measured_recordings_have_no_spikes(mapping: str, files: str) -> None:
    for path in sorted(DATA.glob(files)):
        run = imported(DATA / mapping, path)
        assert [note for note in run.notes if "spike" in note] == []


# --- values that come twice, rows that are lost


def test_samples_that_come_twice_are_told_and_left_out(tmp_path: Path) -> None:
    rows = log()
    again = np.random.default_rng(6).choice(np.arange(50, N - 50, 5), 60, replace=False)
    rows[again, 1:4] = rows[again - 1, 1:4]
    run = run_of(tmp_path, rows)
    assert any("60 of 12000 samples (0.5 %) are those before them again" in note for note in run.notes)
    assert_same(run, run_of(tmp_path, log()))


def test_coarse_values_that_are_equal_by_chance_do_not_come_twice(tmp_path: Path) -> None:
    rows = log()
    rows[:, 1:4] = np.round(rows[:, 1:4] / 2) * 2
    assert not any("again" in note for note in run_of(tmp_path, rows).notes)


def test_rows_that_are_lost_are_told(tmp_path: Path) -> None:
    lost = np.concatenate([np.arange(2000, 2030), [4000, 4500, 7000]])
    run = run_of(tmp_path, np.delete(log(), lost, axis=0))
    assert any("33 samples (0.3 %) are missing in 4 gaps, the longest 0.31 s at 20 s" in note for note in run.notes)
    assert len(run.recording.sources[SOURCE].t_ns) == N - 33
    assert_same(run, run_of(tmp_path, log()))


def test_parts_of_a_source_keep_the_other_columns_of_their_rows() -> None:
    rate = np.radians(spiked(log(), slice(1, 4), 12, 4)[:, 1:4])
    data = recording_of(rate).sources["imu"]
    part = usable(replace(data, temperature_c=20 + T / 60), fine=True).parts[0]
    assert part.temperature_c is not None
    np.testing.assert_allclose(part.temperature_c, 20 + part.t_ns * 1e-9 / 60, atol=1e-9)
