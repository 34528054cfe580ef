"""Ramps off any grid, links that are late: the offset is found, the sigmas are true, or timing is named."""

from __future__ import annotations

import numpy as np
import pytest
from timing import CASES, ended

from drivers.seams import AxisState
from estimator.reference import BodyRates
from sims.motion import AxisMotion
from station.table_watch import Aligner

# A Galil tells the mean rate of the last quarter of a second, half of a ramp of 40 deg/s2.
CLEAN, LATE, GALIL = ("clean-40", ""), ("table+10ms", ""), ("clean-40", "galil_xsens")
LONG = [pytest.param(*case, marks=pytest.mark.full) for case in (CLEAN, LATE, GALIL)]


@pytest.mark.parametrize(("name", "bench"), [("gyros+30ms", ""), ("1 in 20 by 150 ms", ""), *LONG])
def test_a_run_off_the_grid_is_true_whatever_is_late(name: str, bench: str) -> None:
    found = ended(name, CASES[name], seed=1, bench_name=bench, turn_s=4.0)
    assert found.outcome == "PASS", found.reason
    assert 0.85 < found.nis < 1.15  # of some 150 blocks of 16 degrees of freedom
    assert np.abs(found.errors).max() < 4
    assert abs(found.offset_ms) < 3 * found.offset_sd_ms


def test_rates_are_known_through_ramps_of_a_controller_that_tells_mean_rates() -> None:
    motion, count, window_s = AxisMotion(0.0, 1.0, 1.0), 2 * np.pi / 65536, 0.25
    motion.move(4.0123, 2.0, np.radians(20), np.radians(40))
    aligner, rates = Aligner(("z",)), BodyRates(("z",), None)
    for t in np.arange(0.0, 14.0, 0.0253).tolist():
        mean_rps = (motion.at(t)[0] - motion.at(t - window_s)[0]) / window_s
        angle_rad, times = round(motion.at(t)[0] / count) * count, (round(t * 1e9), round((t - window_s / 2) * 1e9))
        state = AxisState(times[0], angle_rad, times[1], round(mean_rps / count) * count, 0, round(window_s * 1e9))
        for row in aligner.add({"z": state}):
            rates.add(np.array([row.t_ns]), row.angle_rad[None], row.rate_rps[None])
    rates.finish()
    t_s = np.arange(3.0, 12.0, 0.001)
    wrong_rps = rates.at(np.round(t_s * 1e9).astype(np.int64))[:, 2] - motion.rates(t_s)
    assert np.abs(wrong_rps).max() < np.radians(0.02)  # 0.5 ms of such a ramp; NaN where it is not known
