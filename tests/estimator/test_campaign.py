"""Sigmas that are true: many seeds straight from the physics of the twins, white noise."""

from __future__ import annotations

import pytest
from campaign import campaign


def check(figures: dict[str, float], coverage: tuple[float, float], rms: float) -> None:
    assert coverage[0] <= figures["coverage95_percent"] <= coverage[1]
    assert figures["nis_lowest"] >= 0.95
    assert figures["nis_highest"] <= 1.05
    assert figures["rms_over_bound_all"] <= rms


def test_a_dozen_seeds_cover_the_truth_as_often_as_they_say() -> None:
    # 192 intervals: three sigmas of the binomial to each side of 95 %, and of the chi-square for the rms.
    check(campaign(12), (90.2, 99.8), 1.16)


@pytest.mark.full
@pytest.mark.timeout(900)
def test_two_hundred_seeds_reach_the_bound() -> None:
    check(campaign(200), (92.0, 97.5), 1.05)
