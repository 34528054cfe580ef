"""Ramps off any grid, links that are late: the offset is found, the sigmas are true, or timing is named."""

from __future__ import annotations

import numpy as np
import pytest
from timing import CASES, ended

LONG = [pytest.param(name, marks=pytest.mark.full) for name in ("clean-40", "table+10ms")]


@pytest.mark.parametrize("name", ["gyros+30ms", "1 in 20 by 150 ms", *LONG])
def test_a_run_off_the_grid_is_true_whatever_is_late(name: str) -> None:
    found = ended(name, CASES[name], seed=1, turn_s=4.0)
    assert found.outcome == "PASS", found.reason
    assert 0.85 < found.nis < 1.15  # of some 150 blocks of 16 degrees of freedom
    assert np.abs(found.errors).max() < 4
    assert abs(found.offset_ms) < 3 * found.offset_sd_ms
