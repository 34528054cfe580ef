"""What accelerometers show on ramps of a table, whose motion is known between its readings only as far as it is."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rounded_ramps import lag, rounded, s_curve

from estimator.calibration.accelerometer import ForceCalibration
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.recordings.motion.body_rates import BodyRates
from sims.physics.accelerometer import AccelerometerTruth
from station.bench.bench import Bench, load_bench, read_bench
from station.opening.simulate import simulate_bench
from station.opening.twins import force_truth_of
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
DELAYS_S = {
    "straight": np.zeros(1),
    "S-curve of 20 ms": s_curve(0.02),
    "S-curve of 100 ms": s_curve(0.1),
    "lag of 50 ms": lag(0.05),
}


def bench() -> Bench:
    return load_bench(BENCH)


def truth() -> AccelerometerTruth:
    one = bench()
    felt = force_truth_of(one.twin.truths.again(), one.imus[0], one.site)
    assert felt is not None
    return felt[0]


@cache
def calibrated(ramps: str, seed: int = 1) -> ForceCalibration:
    recording = rounded(bench(), load_script(Path("full-imu")), seed, DELAYS_S[ramps])
    (found,), _ = calibrate_forces(recording)
    return found


@pytest.mark.parametrize("ramps", list(DELAYS_S))
def test_places_are_within_their_sigmas_whatever_the_ramps_are_like(ramps: str) -> None:
    """An arm of 40 mm that is a percent too short is off by several sigmas."""
    found, places_m = calibrated(ramps), truth().places_m
    arm = (found.arm_m - places_m.mean(axis=0)) / found.arm_sd_m
    assert np.all(np.abs(arm) < 3.5), arm
    for one, place_m in zip(found.accelerometers, places_m, strict=True):
        off = (one.place_m - place_m) / one.place_sd_m
        assert np.all(np.abs(off) < 3.5), off


def test_a_long_lever_arm_is_not_found_too_short() -> None:
    """Means across corners of ramps would move a part of its force out of the ramps, more than its sigmas hold."""
    places_mm = (300.0, -250.0, 200.0)
    text = BENCH.read_text(encoding="utf-8").replace(
        '["40 mm", "-25 mm", "15 mm"]', str([f"{p} mm" for p in places_mm])
    )
    one = read_bench(text, "a long arm")
    felt = force_truth_of(one.twin.truths.again(), one.imus[0], one.site)
    assert felt is not None
    arm_m = felt[0].places_m.mean(axis=0)
    assert arm_m == pytest.approx(1e-3 * np.array(places_mm), abs=2e-3)
    (found,), _ = calibrate_forces(simulate_bench(one, load_script(Path("full-imu")), 1))
    assert np.all(np.abs(found.arm_m - arm_m) < 3.5 * found.arm_sd_m), (found.arm_m - arm_m) / found.arm_sd_m
    assert np.all(found.arm_sd_m < 8e-5)


@pytest.mark.parametrize("ramps", list(DELAYS_S)[1:])
def test_rounded_ramps_show_the_lever_arm_nearly_as_well_as_straight_ones(ramps: str) -> None:
    assert np.all(calibrated(ramps).arm_sd_m < 1.15 * calibrated("straight").arm_sd_m)


def test_every_ramp_of_the_shipped_script_counts_but_for_its_corners() -> None:
    """Ramps of 20 deg/s are seen by eight readings, whose counts do not scatter as they turn by nearly whole ones."""
    recording = rounded(bench(), load_script(Path("full-imu")), 1, DELAYS_S["straight"])
    table = recording.table
    assert table is not None
    rates = BodyRates.of(table, None)
    t_ns = np.arange(rates.starts_ns, rates.final_until_ns, 1_000_000)
    acceleration = np.abs(rates.felt_at(t_ns)[2]).max(axis=1)
    known = rates.felt_known(t_ns)
    assert np.mean(known[acceleration > 0.1]) > 0.97
    assert np.mean(known[acceleration < 0.1]) > 0.97
    corner_ns = 20_000_000_000 + np.array([-5_000_000, 5_000_000])  # the first turn begins after 20 s
    assert not rates.felt_known(corner_ns).any()
    assert rates.felt_known(corner_ns + np.array([-10_000_000, 10_000_000])).all()
