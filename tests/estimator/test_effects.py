"""Regressors of the effects, against what they are derived from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.effects.catalogue import catalogue
from estimator.effects.conditions import Conditions
from estimator.effects.dynamics import ACCELERATION_SENSITIVITY, BANDWIDTH, LATENCY
from estimator.effects.effect import Effect
from estimator.effects.site import EARTH_RATE, G_SENSITIVITY
from estimator.effects.table import TABLE_AXES, TABLE_RATE
from estimator.effects.thermal import THERMAL_BIAS, THERMAL_GRADIENT
from estimator.geometry.array import SensorArray, tetrahedron
from estimator.geometry.kinematics import AXES, Site, body_rate

SITE = Site(0.8, 0.5)
GIMBALS = ("z", "y", "x")
ARRAY = tetrahedron()


def motion(t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angles, rates, accelerations (N, 3) of three axes that swing at once, exactly."""
    size, speed = np.array([0.9, 0.7, 1.1]), np.array([0.5, 0.8, 0.3])
    phase = speed * t_s[:, None] + np.array([0.1, 0.9, 2.0])
    return size * np.sin(phase), size * speed * np.cos(phase), -size * speed**2 * np.sin(phase)


def swinging(t_s: np.ndarray, site: Site | None = SITE) -> Conditions:
    return Conditions.on_table(t_s, *motion(t_s), GIMBALS, temperature_c=25 + 3 * np.sin(0.05 * t_s), site=site)


def columns(effect: Effect, conditions: Conditions, array: SensorArray = ARRAY) -> np.ndarray:
    """Return the columns of all gyros (n, N, parameters)."""
    return np.stack([effect.columns(conditions, array, i) for i in range(len(array))])


T_S = np.arange(0.0, 20.0, 0.05)


def test_acceleration_of_the_body_is_the_derivative_of_its_rate() -> None:
    h = 1e-4
    before, after = swinging(T_S - h), swinging(T_S + h)
    numeric = (after.w_rps - before.w_rps) / (2 * h)
    assert np.abs(swinging(T_S).wdot_rps2 - numeric).max() < 1e-8


def test_latency_is_what_a_delay_adds() -> None:
    delay = 1e-4
    numeric = (swinging(T_S - delay).w_rps - swinging(T_S + delay).w_rps) @ ARRAY.p.T / (2 * delay)
    assert np.abs(columns(LATENCY.effect(), swinging(T_S))[:, :, 0].T - numeric).max() < 1e-8


def test_bandwidth_is_what_a_first_order_lag_takes_away() -> None:
    tau, fine = 0.02, np.arange(0.0, 20.0, 0.001)
    u = swinging(fine).w_rps @ ARRAY.p.T
    keep = np.exp(-0.001 / tau)
    lagged = u.copy()
    for n in range(1, len(fine)):  # exact for a straight line between samples
        slope = (u[n] - u[n - 1]) / 0.001
        lagged[n] = keep * (lagged[n - 1] - u[n - 1] + tau * slope) + u[n] - tau * slope
    expected = columns(BANDWIDTH.effect(tau_s=tau), swinging(fine))[:, :, 0].T * tau
    settled = slice(500, -1)
    scale = np.abs(expected[settled]).max()
    assert (
        np.abs((lagged - u)[settled] - expected[settled]).max() < 0.01 * scale
    )  # the next term of the lag is left out


def test_acceleration_across_the_sense_axis_is_no_latency() -> None:
    along_x = replace(swinging(T_S), wdot_rps2=np.outer(np.sin(T_S), [1.0, 0.0, 0.0]))
    across = columns(ACCELERATION_SENSITIVITY.effect(), along_x, ARRAY)
    along = columns(LATENCY.effect(), along_x, ARRAY)[:, :, 0]
    # p, j, k are at right angles, so the squares of the three add up to those of the acceleration.
    assert np.allclose(along**2 + np.sum(across**2, axis=2), np.sin(T_S) ** 2, atol=1e-9)


def test_earth_rate_is_what_the_model_has_with_a_site_and_lacks_without() -> None:
    difference = (swinging(T_S).w_rps - swinging(T_S, site=None).w_rps) @ ARRAY.p.T
    assert np.allclose(columns(EARTH_RATE.effect(), swinging(T_S)) @ SITE.earth_rate_rps(), difference.T, atol=1e-18)


def test_g_sensitivity_knows_which_way_is_up() -> None:
    still = np.zeros((3, 3))
    tilted = np.array([[0, 0, 0], [0, np.pi / 2, 0], [0, 0, np.pi / 2]])  # home, y by 90 deg, x by 90 deg
    conditions = Conditions.on_table(np.arange(3.0), tilted, still, still, GIMBALS)
    up = [[0, 0, 1], [-1, 0, 0], [0, 1, 0]]  # a table at rest pushes up: +z at home; -x then points up; +y then
    assert np.allclose(columns(G_SENSITIVITY.effect(), conditions)[0], up, atol=1e-12)


def test_tilted_axes_change_the_rate_as_true_rotations_about_them_do() -> None:
    conditions, size = swinging(T_S), 1e-6
    found = columns(TABLE_AXES.effect(GIMBALS), conditions)
    names = [parameter.name for parameter in TABLE_AXES.effect(GIMBALS).parameters]
    assert names == ["y towards z", "y towards x", "x towards y", "x towards z"]
    for number, name in enumerate(names):
        axis, _, other = name.split()
        rates = [
            rate_about({**{a: unit(a) for a in GIMBALS}, axis: unit(axis) + sign * size * unit(other)}, conditions)
            for sign in (1, -1)
        ]
        numeric = (rates[0] - rates[1]) @ ARRAY.p.T / (2 * size)
        assert np.abs(found[:, :, number].T - numeric).max() < 1e-8, name


def rate_about(axes: dict[str, np.ndarray], conditions: Conditions) -> np.ndarray:
    """Return the body rate (N, 3) of gimbals about any axes, by Rodrigues' formula."""
    out = []
    for angles, rates in zip(conditions.angle_rad, conditions.rate_rps, strict=True):
        w = SITE.earth_rate_rps()
        for gimbal, angle, rate in zip(GIMBALS, angles, rates, strict=True):
            e = axes[gimbal] / np.linalg.norm(axes[gimbal])
            cross = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
            turn = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
            w = turn.T @ w + rate * e
        out.append(w)
    return np.array(out)


def unit(axis: str) -> np.ndarray:
    return np.eye(3)[AXES.index(axis)]


def test_table_rates_add_up_to_the_rate_of_the_body() -> None:
    conditions = swinging(T_S)
    angle, rate, _ = motion(T_S)
    for column in range(3):
        faster = rate.copy()
        faster[:, column] *= 1.001
        numeric = (body_rate(angle, faster, GIMBALS, SITE) - conditions.w_rps) @ ARRAY.p.T / 0.001
        assert np.allclose(columns(TABLE_RATE.effect(GIMBALS), conditions)[:, :, column].T, numeric, atol=1e-9)


def test_thermal_gradient_is_the_slope_of_the_temperature() -> None:
    found = columns(THERMAL_GRADIENT.effect(), swinging(T_S))[0, 1:-1, 0]
    assert np.allclose(found, 0.15 * np.cos(0.05 * T_S[1:-1]), atol=1e-6)


def test_without_a_temperature_thermal_effects_are_nothing() -> None:
    unknown = replace(swinging(T_S), temperature_c=None)
    assert not columns(THERMAL_BIAS.effect(), unknown).any()


@pytest.mark.parametrize("gimbals", [("z", "y", "x"), ("x", "z"), ("y",)])
def test_every_effect_of_the_catalogue_has_a_column_for_each_parameter(gimbals: tuple[str, ...]) -> None:
    angle, rate, acceleration = (part[:, : len(gimbals)] for part in motion(T_S))
    conditions = Conditions.on_table(T_S, angle, rate, acceleration, gimbals, temperature_c=25 + T_S / 10)
    effects = catalogue(gimbals, 20.0)
    assert len({effect.name for effect in effects}) == len(effects)
    for effect in effects:
        found = columns(effect, conditions)
        assert found.shape == (4, len(T_S), len(effect.parameters)), effect.name
        assert np.isfinite(found).all(), effect.name
