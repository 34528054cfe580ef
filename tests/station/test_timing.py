"""Ramps off any grid, links that are late: the offset is found, the sigmas are true, or timing is named."""

from __future__ import annotations

import numpy as np
import pytest
from reversals import Case as Reversal, Motion, ended as reversed_run
from timing import CASES, ended

from drivers.types import AxisState
from estimator.recordings.motion.body_rates import BodyRates
from sims.physics.motion import AxisMotion
from station.run.live import LiveEstimate
from station.run.table_watch import Aligner

# A Galil tells the mean rate of the last quarter of a second, half of a ramp of 40 deg/s2.
CASES_LONG = [("clean-40", ""), ("table+10ms", ""), ("clean-40", "galil_xsens")]
LONG = [pytest.param(*case, marks=pytest.mark.full) for case in CASES_LONG]


@pytest.mark.parametrize(
    ("name", "bench"), [("gyros+30ms", ""), pytest.param("1 in 20 by 150 ms", "", marks=pytest.mark.full), *LONG]
)
def test_a_run_off_the_grid_is_true_whatever_is_late(name: str, bench: str) -> None:
    found = ended(name, CASES[name], seed=1, bench_name=bench, turn_s=4.0)
    assert found.outcome == "PASS", found.reason
    assert 0.85 < found.nis < 1.15  # of some 150 blocks of 16 degrees of freedom
    assert np.abs(found.errors).max() < 4
    assert abs(found.offset_ms) < 3 * found.offset_sd_ms


@pytest.mark.parametrize("ramp_dps2", [20.0, 40.0, 160.0])
def test_rates_are_known_through_ramps_of_a_controller_that_tells_mean_rates(ramp_dps2: float) -> None:
    motion, count, window_s = AxisMotion(0.0, 1.0, 3.0), 2 * np.pi / 65536, 0.25
    motion.move(4.0123, 2.0, np.radians(20), np.radians(ramp_dps2))
    aligner, live = Aligner(("z",)), LiveEstimate(("z",), None)
    live.keep_blocks()
    for t in np.arange(0.0, 14.0, 0.0253).tolist():
        told = t + 0.008  # the rate is asked for after the angle
        mean_rps = (motion.at(told)[0] - motion.at(told - window_s)[0]) / window_s
        angle_rad, times = round(motion.at(t)[0] / count) * count, (round(t * 1e9), round((told - window_s / 2) * 1e9))
        state = AxisState(
            angle_t_ns=times[0],
            angle_rad=angle_rad,
            rate_t_ns=times[1],
            rate_rps=round(mean_rps / count) * count,
            half_width_ns=0,
            rate_window_ns=round(window_s * 1e9),
        )
        for row in aligner.add({"z": state}):
            if live.add_row(row):
                live.advance()
    live.finish()
    t_s = np.arange(3.0, 12.0, 0.001)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    wrong_rps = live.rates.at(t_ns)[:, 2] - motion.rates(t_s)
    assert np.abs(wrong_rps).max() < 5e-4 * np.radians(ramp_dps2)  # 0.5 ms; NaN where it is not known
    np.testing.assert_allclose(BodyRates.of(live.readings(None), None).at(t_ns), live.rates.at(t_ns), atol=1e-12)


@pytest.mark.parametrize(
    ("table", "motion"),
    [
        # At 10 deg/s2 this Galil, whose accelerations go in steps, ramps for so long that its rate is never steady.
        ("galil", Motion(50.0, 10.0, turns=2)),
        (
            "galil",
            Motion(23.0, 45.0, turn_s=5.7, turns=4),
        ),  # a rate that is a mean holds both ramps and the rest between
        ("acutrol", Motion(50.0, 50.0, turns=2)),
    ],
)
def test_an_axis_that_is_sent_back_without_a_rest_is_measured_true(table: str, motion: Motion) -> None:
    run = reversed_run(Reversal(table, motion), axes="y" if table == "galil" else "z")
    assert run.outcome != "FAULT", run.reason
    assert 0.9 <= run.nis <= 1.1
    assert max(map(abs, run.errors)) < 5
