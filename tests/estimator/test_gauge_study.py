"""Gauge repeatability and reproducibility: variance components of parts measured under several conditions."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from estimator.estimation.repeatability import gauge_study

EXAMPLE = """
 0.29 -0.56 1.34 0.47 -0.80  0.02 0.59 -0.31 2.26 -1.36
 0.41 -0.68 1.17 0.50 -0.92 -0.11 0.75 -0.20 1.99 -1.25
 0.64 -0.58 1.27 0.64 -0.84 -0.21 0.66 -0.17 2.01 -1.31
 0.08 -0.47 1.19 0.01 -0.56 -0.20 0.47 -0.63 1.80 -1.68
 0.25 -1.22 0.94 1.03 -1.20  0.22 0.55  0.08 2.12 -1.62
 0.07 -0.68 1.34 0.20 -1.28  0.06 0.83 -0.34 2.19 -1.50
 0.04 -1.38 0.88 0.14 -1.46 -0.29 0.02 -0.46 1.77 -1.49
-0.11 -1.13 1.09 0.20 -1.07 -0.67 0.01 -0.56 1.45 -1.77
-0.15 -0.96 0.67 0.11 -1.45 -0.49 0.21 -0.49 1.87 -2.16
"""
"""The worked example of AIAG, Measurement Systems Analysis, 4th ed., III.B: three appraisers, three trials of each."""


def study(values: Any, parts: Any, conditions: Any, sd: Any = 1.0) -> SimpleNamespace:
    """Return the study of values, (runs,) or (runs, states), that state a sigma."""
    x = values.reshape(len(values), -1)
    return SimpleNamespace(**gauge_study(x, np.broadcast_to(sd, x.shape), parts.astype(str), conditions.astype(str)))


def by_projections(values: Any, parts: Any, conditions: Any) -> Any:
    """Return the variances within, of interaction, conditions, parts: Henderson's method 1 with dense projections.

    E[y'Qy] is the sum over the factors of variance times tr(Z'QZ), Q the difference of two models' projections.
    """
    cells = parts * (conditions.max() + 1) + conditions
    each = (np.zeros_like(parts), parts, conditions, cells)
    z_1, z_p, z_c, z_cell = (np.equal.outer(labels, np.unique(labels)).astype(float) for labels in each)
    p_1, p_p, p_c, p_cell = (model @ np.linalg.pinv(model) for model in (z_1, z_p, z_c, z_cell))
    forms = np.eye(len(values)) - p_cell, p_cell - p_p - p_c + p_1, p_c - p_1, p_p - p_1
    factors = np.eye(len(values)), z_cell, z_c, z_p
    expected = [[np.trace(z.T @ q @ z) for z in factors] for q in forms]
    return np.linalg.solve(expected, [values @ q @ values for q in forms])


def test_figures_are_those_of_the_published_example() -> None:
    values = np.array(EXAMPLE.split(), float)
    labels = np.array(list(product(range(3), range(3), range(10))))
    found = study(values, labels[:, 2], labels[:, 0], sd=0.2)
    assert found.repeatability == pytest.approx(0.199933, abs=1e-6)
    assert found.reproducibility == pytest.approx(0.226838, abs=1e-6)
    assert found.parts == pytest.approx(1.042327, abs=1e-6)
    assert found.grr == pytest.approx(0.302373 / 1.085300, abs=1e-5)
    assert found.dof == 78
    # Tables of chi-square: 55.466 and 104.316 at 78 degrees of freedom.
    assert found.ratio == pytest.approx(0.99967, abs=1e-5)
    assert found.ratio_low == pytest.approx(0.99967 * np.sqrt(78 / 104.316), abs=1e-5)
    assert found.ratio_high == pytest.approx(0.99967 * np.sqrt(78 / 55.466), abs=1e-5)


def test_a_balanced_study_is_as_by_hand() -> None:
    """Mean squares of a two-way table with interaction: four parts, three conditions, two runs."""
    chance = np.random.default_rng(1)
    p, c, r = 4, 3, 2
    table = 5 + 2 * chance.normal(size=(p, 1, 1)) + chance.normal(size=(1, c, 1)) + chance.normal(size=(p, c, 1))
    table = table + 0.3 * chance.normal(size=(p, c, r))
    cell, part, condition, mean = table.mean(2), table.mean((1, 2)), table.mean((0, 2)), table.mean()
    within = ((table - cell[:, :, None]) ** 2).sum() / (p * c * (r - 1))
    mixed = r * ((cell - part[:, None] - condition + mean) ** 2).sum() / ((p - 1) * (c - 1))
    of_conditions = p * r * ((condition - mean) ** 2).sum() / (c - 1)
    of_parts = c * r * ((part - mean) ** 2).sum() / (p - 1)
    labels = np.array(list(product(range(p), range(c), range(r))))
    found = study(table.ravel(), labels[:, 0], labels[:, 1])
    between = (of_conditions - mixed) / (p * r) + (mixed - within) / r
    assert found.repeatability**2 == pytest.approx(within)
    assert found.reproducibility**2 == pytest.approx(between)
    assert found.parts**2 == pytest.approx((of_parts - mixed) / (c * r))
    assert found.grr**2 == pytest.approx((within + between) / (within + between + (of_parts - mixed) / (c * r)))


@pytest.mark.parametrize("seed", [0, 2])
def test_unequal_counts_and_empty_cells_are_as_by_projections(seed: int) -> None:
    chance = np.random.default_rng(seed)
    parts, conditions = chance.integers(6, size=45), chance.integers(4, size=45)
    keep = (parts != 2) | (conditions < 2)
    parts, conditions = parts[keep], conditions[keep]
    effects = chance.normal(size=(6, 1)) * 3 + chance.normal(size=4) * 2 + chance.normal(size=(6, 4))
    values = effects[parts, conditions] + 0.2 * chance.normal(size=len(parts))
    within, mixed, between, of_parts = by_projections(values, parts, conditions)
    found = study(values, parts, conditions)
    assert min(mixed, between, of_parts) > 0
    assert found.repeatability**2 == pytest.approx(within)
    assert found.reproducibility**2 == pytest.approx(mixed + between)
    assert found.parts**2 == pytest.approx(of_parts)


@pytest.mark.parametrize("conditions", [[0] * 6, [0, 0, 0, 1, 1, 1]], ids=["one bench", "each part on its own bench"])
def test_what_the_runs_do_not_tell_apart_is_no_figure(conditions: list[int]) -> None:
    values = np.array([1.0, 1.1, 1.2, 3.0, 3.1, 3.2])
    found = study(values, np.repeat([0, 1], 3), np.array(conditions))
    assert np.isnan(found.reproducibility)
    assert found.repeatability == pytest.approx(0.1)
    assert found.parts**2 == pytest.approx(4 / 2 - 0.1**2 / 3)


def test_the_interval_of_the_ratio_holds_as_often_as_it_says() -> None:
    """Four hundred studies of twelve gyros, of which some have three times the sigma of others."""
    chance = np.random.default_rng(0)
    parts, conditions = np.repeat(np.arange(12), 4), np.tile([0, 0, 1, 1], 12)
    sd = np.repeat(np.resize([0.6, 0.7, 1.2, 1.9], 12), 4)[:, None]
    effects = 20 * chance.normal(size=(12, 1, 400)) + chance.normal(size=(2, 400))
    effects = effects + 9 * chance.normal(size=(12, 2, 400))
    found = study(effects[parts, conditions] + sd * chance.normal(size=(48, 400)), parts, conditions, sd)
    assert 0.92 < np.mean((found.ratio_low < 1) & (found.ratio_high > 1)) < 0.98


def test_parts_and_conditions_that_met_only_each_other_are_not_told_apart() -> None:
    values = np.array([1.0, 1.1, 1.2, 1.3, 3.0, 3.1, 3.2, 3.3])
    found = study(values, np.repeat([0, 1], 4), np.repeat([0, 1, 2, 3], 2))
    assert np.isnan([found.parts, found.reproducibility, found.grr]).all()
    assert found.repeatability == pytest.approx(np.sqrt(0.005))
