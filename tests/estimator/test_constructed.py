"""Laws composed of what was measured: the grammar holds what it says, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.effects.conditions import Axes, Conditions
from estimator.effects.constructed import constructed
from estimator.effects.law import LawError, in_words, lagged, last_sign, played

AXES = Axes(np.array([0.6, 0.0, 0.8]), np.array([0.0, 1.0, 0.0]), np.array([-0.8, 0.0, 0.6]))


def conditions(n: int = 400) -> Conditions:
    random = np.random.default_rng(2)
    t_s = np.arange(n) * 0.05
    w, wdot, force = (random.standard_normal((n, 3)) for _ in range(3))
    angle, rate = random.standard_normal((n, 3)), random.standard_normal((n, 3))
    warm = 25 + 5 * np.sin(0.1 * t_s)
    return Conditions(
        t_s=t_s,
        w_rps=w,
        wdot_rps2=wdot,
        angle_rad=angle,
        rate_rps=rate,
        acceleration_rps2=0 * rate,
        gimbals=("z", "y", "x"),
        specific_force_mps2=9.80665 * force,
        temperature_c=warm,
    )


def test_a_law_is_worked_out_as_it_is_written() -> None:
    c = conditions()
    u, g = c.w_rps @ AXES.p, c.specific_force_mps2 / 9.80665
    warm = c.temperature_c - 25
    for law, expected in {
        "u**2": u**2,
        "gx*gs": g[:, 0] * (g @ AXES.p),
        "sign(u)*log1p(abs(u)/0.5)": np.sign(u) * np.log1p(np.abs(u) / 0.5),
        "abs(rate_y)*cos(3*angle_y)": np.abs(c.rate_rps[:, 1]) * np.cos(3 * c.angle_rad[:, 1]),
        "T*t": warm * c.t_s,
    }.items():
        np.testing.assert_allclose(constructed(law).at(c, AXES)[:, 0], expected, atol=1e-12)
    two = constructed("cos(angle_z); sin(angle_z)")
    assert [p.name for p in two.parameters] == ["of cos(angle_z)", "of sin(angle_z)"]
    assert two.needs == {"gimbals"}


def test_gyros_that_share_what_remembers_have_columns_of_their_own() -> None:
    other = Axes(AXES.k, AXES.j, AXES.p)
    law = constructed("lag(u, 3)*lag(T, 3); play(lag(T, 3), 0.5); lag(abs(u), 3)*last(gx, 0.1)")
    alone = [law.at(conditions(), axes) for axes in (AXES, other)]
    shared = conditions()
    with shared.sharing_memories():
        together = [law.at(shared, axes) for axes in (AXES, other)]
    np.testing.assert_array_equal(together, alone)
    assert not np.allclose(alone[0], alone[1])


def test_what_remembers_obeys_its_equation() -> None:
    t_s = np.arange(2000) * 0.01
    x = np.sin(0.7 * t_s)
    slow = lagged(x, t_s, 3.0)
    np.testing.assert_allclose(slow[1:] + 3.0 * np.diff(slow) / 0.01, x[1:], atol=5e-3)
    uneven = np.sort(np.random.default_rng(1).uniform(0, 20, 4000))
    np.testing.assert_allclose(
        np.interp(t_s[200:], uneven, lagged(np.sin(0.7 * uneven), uneven, 3.0)), slow[200:], atol=0.02
    )
    loop = played(x, 0.5)
    assert np.all(np.abs(loop - x) <= 0.25 + 1e-12)
    moved = np.diff(loop) != 0
    np.testing.assert_allclose(np.abs(loop - x)[1:][moved], 0.25, atol=1e-12)
    np.testing.assert_array_equal(last_sign(np.array([0.0, 1.0, 0.01, -2.0, 0.0])), [0, 1, 1, -1, -1])


def test_what_remembers_passes_over_what_is_not_known() -> None:
    random = np.random.default_rng(3)
    t_s = np.cumsum(random.uniform(0.5, 1.5, 3000)) * 0.01
    x = np.cumsum(random.standard_normal(3000))
    lost = random.random(3000) < 0.1
    lost[0] = True
    x[lost] = np.nan
    kept = np.exp(-np.diff(t_s, prepend=t_s[0]) / 3.0)
    lag, play = np.nan, np.nan
    expected = []
    for value, share in zip(x.tolist(), kept.tolist(), strict=True):
        if np.isfinite(value):
            lag = value if np.isnan(lag) else value + share * (lag - value)
            play = value if np.isnan(play) else float(np.clip(play, value - 0.9, value + 0.9))
        expected.append((lag, play) if np.isfinite(value) else (np.nan, np.nan))
    found = np.column_stack([lagged(x, t_s, 3.0), played(x, 1.8)])
    np.testing.assert_allclose(found, expected, rtol=1e-10)
    assert np.array_equal(np.isnan(found).all(axis=1), lost)


@pytest.mark.parametrize(
    "text",
    ["", "u.__class__", "__import__('os')", "lambda: u", "u if u else 1", "open(u)", "q", "lag(u, u)", "u" * 300],
)
def test_what_is_no_law_is_refused(text: str) -> None:
    with pytest.raises(LawError):
        constructed(text)


def test_a_law_says_in_words_what_it_is() -> None:
    assert in_words("lag(T, 58)") == "bias proportional to temperature above 25 degC lagged by 58 s"
