"""Hidden effects: each against what it comes to by hand, in recordings made from the physics and over a wire."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.geometry.array import tetrahedron
from sims.direct import DirectRun, TimedMove, direct_run
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.hidden import KINDS, Hidden, HiddenError, Temperature
from sims.physics.hidden.fields import quantity
from sims.physics.hidden.outputs import BiasStep, ThermalBias, WalkPath
from sims.physics.hidden.timing import Latency
from sims.physics.motion import AxisMotion
from sims.physics.table import AxisData, TableModel
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.errors import BenchError
from station.opening import DeviceTruth, simulate, simulate_bench
from station.scripts.script import Rest, Rotate, Script

DEG = np.pi / 180
MOUNTING = mounted(MOUNTS_DEG["tetrahedron"])
P_Z = np.array([-1, 1 / 3, 1 / 3, 1 / 3])
ARCSEC = DEG / 3600
DURATION_S = 80.0
T = np.arange(1, 8001) / 100

# z turns 720 deg at 30 deg/s from 10 s on, and back at 20 deg/s from 40 s on; ramps of 10 deg/s2.
MOVES = [TimedMove(10.0, "z", 4 * np.pi, 30 * DEG, 10 * DEG), TimedMove(40.0, "z", 0.0, 20 * DEG, 10 * DEG)]
KNOTS_S = np.array([0, 10, 13, 34, 37, 40, 42, 76, 78, 99])
KNOTS_RPS = np.array([0, 0, 30, 30, 0, 0, -20, -20, 0, 0]) * DEG


def turn_rate(t_s: np.ndarray = T) -> np.ndarray:
    return np.interp(t_s, KNOTS_S, KNOTS_RPS)


def turn_angle() -> np.ndarray:
    rate = np.concatenate([[0.0], turn_rate()])
    return np.cumsum(0.5 * (rate[1:] + rate[:-1])) * 0.01


def turn_acceleration() -> np.ndarray:
    slopes = np.diff(KNOTS_RPS) / np.diff(KNOTS_S)
    return slopes[np.searchsorted(KNOTS_S, T - 1e-6) - 1]


RATE, ANGLE, ACCELERATION = turn_rate(), turn_angle(), turn_acceleration()
U = RATE[:, None] * P_Z
AWAY = np.abs(T[:, None] - KNOTS_S).min(axis=1) > 0.05
"""Instants that are not at a corner of the trapezoids, where differences bridge it."""


def run(
    tables: dict[str, object] | Hidden | None = None,
    *,
    moves: list[TimedMove] = MOVES,
    arw: float = 0.0,
    seed: int = 1,
    started_s: float = 0.0,
    states: np.ndarray | None = None,
    duration_s: float = DURATION_S,
) -> DirectRun:
    truth = GyroTruth(*(np.zeros((4, 4)) if states is None else states).T, arw, 0.0)
    hidden = Hidden.of(tables) if isinstance(tables, dict) else tables
    return direct_run(
        moves, duration_s, MOUNTING, truth, (seed, 0), earth_turns=False, hidden=hidden, started_s=started_s
    )


def added(tables: dict[str, object], **options: object) -> np.ndarray:
    """Return what hidden effects add to the outputs."""
    return run(tables, **options).output_rps - run(None, **options).output_rps


def column(values: np.ndarray) -> np.ndarray:
    return np.tile(np.asarray(values, dtype=np.float64)[:, None], (1, 4))


def lagged(x: np.ndarray, lag_s: float, step_s: float) -> np.ndarray:
    """Return y of y' = (x - y) / lag by Heun's method."""
    y = np.empty_like(x)
    y[0] = x[0]
    for i in range(len(x) - 1):
        slope = (x[i] - y[i]) / lag_s
        y[i + 1] = y[i] + 0.5 * step_s * (slope + (x[i + 1] - y[i] - step_s * slope) / lag_s)
    return y


WARMING = 8 * (1 - np.exp(-T / 30))
EXPONENTIAL = {"rise": "8 degC", "time_constant": "30 s"}
LINEAR = {"start": "20 degC", "rise": "-10 degC", "shape": "linear", "over": "50 s"}
EACH = np.array([1.0, -2.0, 0.0, 3.0])

CASES: dict[str, tuple[dict[str, object], Callable[[], np.ndarray]]] = {
    "thermal bias": (
        {"temperature": EXPONENTIAL, "thermal_bias": {"linear": [f"{v} deg/s/degC" for v in EACH]}},
        lambda: np.outer(WARMING, EACH * DEG),
    ),
    "thermal bias, quadratic, away from the reference": (
        {"temperature": LINEAR, "thermal_bias": {"quadratic": "0.01 deg/s/degC2"}},
        lambda: column(0.01 * DEG * (-5 - 10 * np.minimum(T / 50, 1)) ** 2),
    ),
    "thermal scale": (
        {"temperature": EXPONENTIAL, "thermal_scale": {"linear": "200 ppm/degC"}},
        lambda: 200e-6 * WARMING[:, None] * U,
    ),
    "thermal gradient": (
        {"temperature": LINEAR, "thermal_gradient": {"size": "60 deg/s/(degC/s)"}},
        lambda: column(np.where(T < 50, 60 * DEG * -0.2, 0.0)),
    ),
    "temperature in cycles": (
        {
            "temperature": {"rise": "4 degC", "shape": "cycle", "over": "40 s"},
            "thermal_bias": {"linear": "1 deg/s/degC"},
        },
        lambda: column(4 * DEG * np.sin(np.pi * T / 40) ** 2),
    ),
    "thermal lag": (
        {"temperature": EXPONENTIAL, "thermal_lag": {"linear": "0.01 deg/s/degC", "lag": "40 s"}},
        lambda: column(0.01 * DEG * lagged(8 * (1 - np.exp(-np.arange(8001) / 3000)), 40.0, 0.01)[1:]),
    ),
    "thermal lag of 40 s along a line": (
        {"temperature": LINEAR, "thermal_lag": {"linear": "0.01 deg/s/degC"}},
        lambda: column(0.01 * DEG * (lagged(20 - np.minimum(np.arange(8001) / 500, 10), 40.0, 0.01)[1:] - 25)),
    ),
    "bias drift": ({"bias_drift": {"size": "0.2 deg/s", "over": "2 min"}}, lambda: column(0.2 * DEG * T / 120)),
    "warm-up": (
        {"warm_up": {"size": "0.05 deg/s", "time_constant": "20 s"}},
        lambda: column(0.05 * DEG * (1 - np.exp(-T / 20))),
    ),
    "bias step": ({"bias_step": {"size": "1 deg/h", "at": "30 s"}}, lambda: column(np.where(T >= 30, ARCSEC, 0))),
    "tones": (
        {
            "tone": [
                {"size": "0.1 deg/s", "frequency": "7.3 Hz", "phase": ["0 deg", "90 deg", "180 deg", "270 deg"]},
                {"size": "1 deg/s", "frequency": "0.5 Hz"},
            ]
        },
        lambda: 0.1 * DEG * np.sin(2 * np.pi * (7.3 * T[:, None] + np.arange(4) / 4)) + DEG * column(np.sin(np.pi * T)),
    ),
    "scale asymmetry": ({"scale_asymmetry": {"size": "500 ppm"}}, lambda: 500e-6 * np.abs(U)),
    "scale, quadratic": ({"scale_quadratic": {"size": "10 ppm/(deg/s)"}}, lambda: 10e-6 / DEG * U**2),
    "scale, cubic": ({"scale_cubic": {"size": "0.5 ppm/(deg/s)2"}}, lambda: 0.5e-6 / DEG**2 * U**3),
    "scale step": (
        {"scale_step": {"size": ["500 ppm", "0 ppm", "-1 %", "1 ppm"], "at": "50.003 s"}},
        lambda: np.array([500e-6, 0.0, -0.01, 1e-6]) * U * (T > 50.003)[:, None],
    ),
    "alignment step": (
        {"alignment_step": {"sigma_j": "0.1 deg", "sigma_k": ["0 deg", "1 deg", "0 deg", "0 deg"], "at": "50.003 s"}},
        lambda: (
            ((T > 50.003) * turn_rate())[:, None]
            * DEG
            * (0.1 * MOUNTING.k[:, 2] - np.array([0, 1, 0, 0]) * MOUNTING.j[:, 2])
        ),
    ),
    "acceleration sensitivity": (
        {"acceleration_sensitivity": {"j": "2 ms", "k": "-0.003 deg/s/(deg/s2)"}},
        lambda: ACCELERATION[:, None] * (0.002 * MOUNTING.j[:, 2] - 0.003 * MOUNTING.k[:, 2]),
    ),
    "table harmonic": (
        {"table_harmonic": {"axis": "z", "order": 2, "cosine": "0.01 deg/s", "sine": ["1 deg/s"] * 4}},
        lambda: DEG * column(0.01 * np.cos(2 * ANGLE) + np.sin(2 * ANGLE)),
    ),
    "table harmonic of another axis": (
        {"table_harmonic": {"axis": "x", "cosine": "0.01 deg/s", "sine": "1 deg/s"}},
        lambda: column(np.full(8000, 0.01 * DEG)),
    ),
    "motor current": (
        {"motor_current_gain": {"size": "20 ppm/(deg/s2)", "friction": "3 deg/s2"}},
        lambda: 20e-6 / DEG * np.abs(ACCELERATION + 3 * DEG * np.sign(RATE))[:, None] * U,
    ),
    "latency": ({"latency": {"delay": "12 ms"}}, lambda: np.outer(turn_rate(T - 0.012), P_Z) - U),
    "latency of what goes round": (
        {"latency": {"delay": "20 ms"}, "table_harmonic": {"axis": "z", "sine": "1 deg/s"}},
        lambda: np.outer(turn_rate(T - 0.02), P_Z) - U + DEG * column(np.sin(np.concatenate([[0.0, 0.0], ANGLE[:-2]]))),
    ),
    "rate-dependent delay": (
        {"rate_dependent_delay": {"size": "500 us/(deg/s)"}},
        lambda: P_Z * turn_rate(T[:, None] - 500e-6 / DEG * np.abs(U)) - U,
    ),
    "dead band": ({"dead_band": {"size": "5.05 deg/s"}}, lambda: np.where(np.abs(U) <= 5.05 * DEG, -U, 0)),
    "table rate": ({"table_rate": {"z": "100 ppm", "x": "1 %"}}, lambda: 1e-4 * U),
}


@pytest.mark.parametrize("case", CASES)
def test_an_effect_adds_what_it_comes_to_by_hand(case: str) -> None:
    tables, expected = CASES[case]
    np.testing.assert_allclose(added(tables)[AWAY], expected()[AWAY], atol=2e-9)


def test_every_kind_of_effect_is_tried_here() -> None:
    tried = {name for tables, _ in CASES.values() for name in tables}
    apart = {"bandwidth", "bias_walk", "encoder_eccentricity", "g_sensitivity", "hysteresis", "sample_hold"}
    assert set(KINDS) == (tried - {"temperature"}) | apart | {"saturation", "stuck", "table_axes", "table_reading"}


AT_S = np.arange(1602) / 20
DURING = (AT_S >= 15) & (AT_S < 50)
RATE_READ = turn_rate(AT_S)
ANGLE_READ = np.interp(AT_S, np.append(0.0, T), np.append(0.0, ANGLE))
AT_15, PASSED = ANGLE_READ[300], np.clip(np.arange(1602), 300, 1000)


@pytest.mark.parametrize(
    ("said", "angle_off", "rate_off"),
    [
        ({"angle": "1 %"}, 0.01 * (ANGLE_READ[PASSED] - AT_15), 0.0),
        ({"rate": "-200 %"}, 0.0, -2 * RATE_READ * DURING),
        ({"jump": "3 deg"}, 3 * DEG * DURING, 0.0),
        ({"creep": "0.01 deg/s"}, 0.01 * DEG * (AT_S[PASSED] - 15), 0.0),
        ({"frozen": True}, (AT_15 - ANGLE_READ) * DURING, 0.0),
        ({"stale": True}, 0.0, (30 * DEG - RATE_READ) * DURING),
    ],
)
def test_readings_of_an_axis_are_off_while_its_motion_is_not(
    said: dict[str, object], angle_off: np.ndarray, rate_off: np.ndarray
) -> None:
    found = run({"table_reading": {"axis": "z", "from": "15 s", "until": "50 s"} | said})
    plain = run()
    np.testing.assert_array_equal(found.output_rps, plain.output_rps)
    for ours, its, off in ((found.angle_rad, plain.angle_rad, angle_off), (found.rate_rps, plain.rate_rps, rate_off)):
        np.testing.assert_allclose((ours - its)[:, 0], np.zeros(1602) + off, atol=2e-4)
        np.testing.assert_array_equal(ours[:, 1:], its[:, 1:])


def test_a_servo_that_follows_wrong_readings_turns_the_body_less() -> None:
    reading = {
        "axis": "z",
        "from": "15.003 s",
        "until": "50.003 s",
        "angle": "1 %",
        "creep": "0.01 deg/s",
        "followed": True,
    }
    found, plain = run({"table_reading": reading}), run()
    np.testing.assert_array_equal(found.angle_rad, plain.angle_rad)
    off = -(0.01 * turn_rate() + 0.01 * DEG) * ((T > 15.003) & (T < 50.003))
    np.testing.assert_allclose((found.output_rps - plain.output_rps)[AWAY], np.outer(off, P_Z)[AWAY], atol=2e-4)


@pytest.mark.parametrize("stated", [{"cutoff": "2 Hz"}, {"time_constant": f"{1e3 / (4 * np.pi)} ms"}])
def test_a_low_pass_answers_as_its_differential_equation(stated: dict[str, object]) -> None:
    fine = np.arange(80_001) / 1000
    expected = lagged(turn_rate(fine), 1 / (4 * np.pi), 1e-3)[10::10]
    np.testing.assert_allclose(run({"bandwidth": stated}).output_rps, np.outer(expected, P_Z), atol=2e-6)


def test_gyros_may_have_low_passes_of_their_own() -> None:
    out = run({"bandwidth": {"cutoff": ["1 Hz", "0 Hz", "10 Hz", "0 Hz"]}}).output_rps
    np.testing.assert_allclose(out[AWAY][:, [1, 3]], U[AWAY][:, [1, 3]], atol=1e-9)
    ramp = int(np.searchsorted(T, 12.9))  # on a ramp a lag shows as a delay of its time constant
    behind = (U[ramp] - out[ramp])[[0, 2]] / (P_Z[[0, 2]] * 10 * DEG)
    np.testing.assert_allclose(behind, [1 / (2 * np.pi), 1 / (20 * np.pi)], rtol=1e-6)


@pytest.mark.parametrize(("axis", "up"), [("x", (0, 1, 0)), ("y", (-1, 0, 0)), ("z", (0, 0, 1))])
def test_gravity_is_felt_along_the_axes_of_the_body_as_it_stands(axis: str, up: tuple[int, int, int]) -> None:
    moves = [TimedMove(1.0, axis, np.pi / 2, 1.0, 1.0)]
    sizes = {"x": [f"{v} deg/s/g" for v in (1, 2, 3, 4)], "y": "0.5 deg/s/g", "z": "-0.25 deg/s/g"}
    out = added({"g_sensitivity": sizes}, moves=moves, duration_s=10.0)
    np.testing.assert_allclose(out[0], -0.25 * DEG, atol=1e-12)
    expected = np.array([1, 2, 3, 4]) * up[0] + 0.5 * up[1] - 0.25 * up[2]
    np.testing.assert_allclose(out[-1], expected * DEG, atol=1e-12)


def test_hysteresis_keeps_the_direction_of_the_last_turn() -> None:
    out = added({"hysteresis": {"size": "0.02 deg/s"}})
    at = {second: out[second * 100 - 1] / (0.02 * DEG) for second in (9, 20, 39, 50, 80)}
    np.testing.assert_allclose(at[9], 0.0, atol=1e-9)
    for second in (20, 39):
        np.testing.assert_allclose(at[second], [-1, 1, 1, 1], atol=1e-9)
    for second in (50, 80):
        np.testing.assert_allclose(at[second], [1, -1, -1, -1], atol=1e-9)
    # 1 deg/s about the sense axis is there after 0.1 s for the gyro along the axis, after 0.3 s for the others.
    assert [int(np.argmax(np.abs(column) > 0)) for column in out.T] == [1010, 1030, 1030, 1030]


def test_a_held_output_is_the_whole_output_of_every_fourth_sample() -> None:
    plain = run(None, arw=1e-3).output_rps
    np.testing.assert_array_equal(run({"sample_hold": {"samples": 4}}, arw=1e-3).output_rps, plain[::4].repeat(4, 0))


def test_saturation_cuts_the_whole_output() -> None:
    plain = run(None, arw=1e-3).output_rps
    limits = np.array([15, 5, 100, 100]) * DEG
    out = run({"saturation": {"limit": ["15 deg/s", "5 deg/s", "100 deg/s", "100 deg/s"]}}, arw=1e-3).output_rps
    np.testing.assert_array_equal(out, np.clip(plain, -limits, limits))
    assert (out[:, 0] == -15 * DEG).sum() > 2000


def test_a_stuck_output_stays_what_it_was() -> None:
    plain = run(None, arw=1e-3, started_s=100.0).output_rps
    stuck = {"gyro": 2, "from": "110 s", "until": "112 s"}
    out = run({"stuck": stuck}, arw=1e-3, started_s=100.0).output_rps
    held = (T >= 10) & (T < 12)
    np.testing.assert_array_equal(out[held, 1], plain[998, 1])
    out[held, 1] = plain[held, 1]
    np.testing.assert_array_equal(out, plain)


def rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the matrix that turns vectors (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def test_the_body_turns_about_axes_as_they_are() -> None:
    tilts = {"y_towards_z": "2 mrad", "x_towards_y": "-3 mrad"}
    y, x = np.array([0, 1, 2e-3]), np.array([1, -3e-3, 0])
    moves = [TimedMove(float(i), axis, np.pi / 2, 1.0, 50.0) for i, axis in ((0, "y"), (4, "x"), (8, "z"))]
    out = run({"table_axes": tilts}, moves=moves, duration_s=12.0).output_rps
    about_y, about_x = y / np.linalg.norm(y), x / np.linalg.norm(x)
    to_body = (rotation(y, np.pi / 2) @ rotation(x, np.pi / 2)).T
    for second, rate in ((1, about_y), (5, about_x), (9, to_body @ [0, 0, 1])):
        np.testing.assert_allclose(out[second * 100 - 1], MOUNTING.p @ rate, atol=1e-9)


def test_an_encoder_reads_what_its_eccentricity_makes_of_the_true_angle() -> None:
    tables = {"encoder_eccentricity": {"size": "0.5 deg", "phase": "20 deg"}}
    faults = Hidden.of(tables).table
    said = np.linspace(-20, 20, 1001)
    true = faults.true_angle("z", said)
    read = true + 0.5 * DEG * (np.sin(3 * true + 20 * DEG) - np.sin(20 * DEG))
    np.testing.assert_allclose(read, said, atol=1e-14)
    # The servo follows the encoder: the drives report what they were told, the body ripples.
    plain, off = run(None), run(tables)
    np.testing.assert_array_equal(off.angle_rad, plain.angle_rad)
    np.testing.assert_array_equal(off.rate_rps, plain.rate_rps)
    slope = 1 / (1 + 1.5 * DEG * np.cos(3 * faults.true_angle("z", ANGLE) + 20 * DEG))
    np.testing.assert_allclose(off.output_rps[AWAY], (U * slope[:, None])[AWAY], atol=1e-9)


def test_only_one_axis_may_have_an_eccentric_encoder() -> None:
    faults = Hidden.of({"encoder_eccentricity": {"size": "0.5 deg", "order": 2, "axis": "y"}}).table
    assert faults.true_angle("z", np.array([1.0])) == 1.0
    assert faults.true_angle("y", np.array([1.0])) == pytest.approx(1 - 0.5 * DEG * np.sin(2), abs=2e-4)


def test_a_walk_spreads_with_the_root_of_time() -> None:
    path = WalkPath(1000, (1,))
    late, early = path.at(np.array([400.0, 100.0]))
    assert early.std() == pytest.approx(10.0, rel=0.08)
    assert late.std() == pytest.approx(20.0, rel=0.08)
    assert np.corrcoef(early, late - early)[0, 1] == pytest.approx(0.0, abs=0.1)
    np.testing.assert_array_equal(WalkPath(1000, (1,)).at(np.array([400.0]))[0], late)


def test_a_walk_with_a_seed_goes_on_from_run_to_run_and_one_without_is_each_runs_own() -> None:
    walk = {"size": "600 deg/h/rth"}
    first, second = (
        added({"bias_walk": {**walk, "seed": 5}}, seed=seed, started_s=started, duration_s=20.0)
        for seed, started in ((1, 0.0), (2, 20.0))
    )
    whole = added({"bias_walk": {**walk, "seed": 5}}, seed=3, duration_s=40.0)
    np.testing.assert_allclose(np.vstack([first, second]), whole, atol=1e-12)
    own, other = (added({"bias_walk": walk}, seed=seed, duration_s=20.0) for seed in (1, 2))
    assert np.abs(own - other).max() > 1e-5


@pytest.mark.parametrize("name", ["bias_drift", "warm_up", "bias_step", "tone", "thermal_bias", "thermal_lag"])
def test_what_follows_the_clock_goes_on_from_run_to_run(name: str) -> None:
    tables = {
        "temperature": {"rise": "8 degC", "time_constant": "60 s"},
        "bias_drift": {"size": "0.1 deg/s"},
        "warm_up": {"size": "0.1 deg/s", "time_constant": "50 s"},
        "bias_step": {"size": "0.1 deg/s", "at": "25 s"},
        "tone": {"size": "0.1 deg/s", "frequency": "0.37 Hz"},
        "thermal_bias": {"linear": "0.1 deg/s/degC"},
        "thermal_lag": {"linear": "0.1 deg/s/degC"},
    }
    wanted = {"temperature": tables["temperature"], name: tables[name]}
    runs = [added(wanted, moves=[], started_s=s, duration_s=20.0) for s in (0.0, 20.0)]
    np.testing.assert_allclose(np.vstack(runs), added(wanted, moves=[], duration_s=40.0), atol=1e-12)


# --- nothing hidden, nothing changed


@pytest.mark.parametrize("hidden", [Hidden(), Hidden(temperature=Temperature(rise_c=30.0)), Hidden.of({})])
def test_without_effects_a_run_stays_the_same_bit_for_bit(hidden: Hidden) -> None:
    states = np.random.default_rng(1).uniform(-0.02, 0.02, (4, 4))
    plain, other = (run(h, arw=1e-3, states=states) for h in (None, hidden))
    np.testing.assert_array_equal(other.output_rps, plain.output_rps)
    np.testing.assert_array_equal(other.angle_rad, plain.angle_rad)


def test_effects_leave_errors_and_noise_as_they_are() -> None:
    states = np.random.default_rng(1).uniform(-0.02, 0.02, (4, 4))
    tables: dict[str, object] = {"bias_step": {"size": "1 deg/s", "at": "0 s"}, "bias_walk": {"size": "1 deg/h/rth"}}
    noisy, silent = (added(tables, arw=arw, states=states) for arw in (1e-3, 0.0))
    np.testing.assert_allclose(noisy, silent, atol=1e-12)
    none = added({"scale_cubic": {"size": "0 ppm/(deg/s)2"}}, states=states)
    np.testing.assert_allclose(none, 0.0, atol=1e-12)


# --- the file


@pytest.mark.parametrize(
    ("text", "like", "value"),
    [
        ("0.005 deg/s/degC", "deg/s/degC", 0.005 * DEG),
        ("1 deg/s/(degC/min)", "deg/s/(degC/s)", 60 * DEG),
        ("-3.6 deg/h/g", "deg/s/g", -1e-3 * DEG),
        ("2 ppm/(deg/s)2", "ppm/(deg/s)2", 2e-6 / DEG**2),
        ("50 us/(deg/s)", "us/(deg/s)", 50e-6 / DEG),
        ("3 ms", "deg/s/(deg/s2)", 3e-3),
        ("60 deg/h/rth", "deg/h/rth", DEG / 3600),
        ("1 rad/s/rts", "deg/h/rth", 1.0),
        ("1e3 ppm", "ppm", 1e-3),
        ("2 rpm", "deg/s", 12 * DEG),
    ],
)
def test_units_are_made_of_units(text: str, like: str, value: float) -> None:
    assert quantity(text, like) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        ({"thermal_bais": {}}, "unknown key 'thermal_bais'; did you mean thermal_bias?"),
        ({"latency": {"dealy": "1 ms"}}, "latency: unknown key 'dealy'; did you mean delay?"),
        ({"latency": {}}, "latency: delay is missing"),
        ({"latency": {"delay": 0.01}}, "latency.delay: 0.01 has no unit"),
        ({"latency": {"delay": "1 deg"}}, "latency.delay: '1 deg': unit 'deg' does not measure the same as 's'"),
        ({"latency": {"delay": "1 fortnight"}}, "there is no unit 'fortnight'"),
        ({"latency": {"delay": "-1 ms"}}, "latency.delay: must be 0 or more"),
        ({"latency": "1 ms"}, "latency: must be a table"),
        ({"scale_cubic": {"size": "1 ppm/(deg/s"}}, "there is no unit"),
        ({"bias_step": {"size": "deg/s", "at": "1 s"}}, "is no number with a unit"),
        ({"sample_hold": {"samples": 2.5}}, "sample_hold.samples: 2.5 is not a whole number"),
        ({"table_harmonic": {"axis": "w"}}, "'w' is not one of x, y, z"),
        ({"bandwidth": {}}, "give cutoff or time_constant"),
        ({"bandwidth": {"cutoff": "1 Hz", "time_constant": "1 s"}}, "give cutoff or time_constant"),
        ({"temperature": {"shape": "round"}}, "'round' is not one of exponential, linear, cycle"),
        ({"temperature": {"over": "0 s"}}, "temperature.over: must be 0.001 or more"),
        ({"encoder_eccentricity": {"size": "10 deg"}}, "beyond 0.1 rad"),
        ({"stuck": {"gyro": 1, "from": "2 s", "until": "1 s"}}, "until is before from"),
        ({"devices": "array"}, "devices: must be a list of names"),
    ],
)
def test_a_file_that_cannot_be_right_is_refused_with_the_reason(tables: dict[str, object], complaint: str) -> None:
    with pytest.raises(HiddenError) as caught:
        Hidden.of(tables)
    assert complaint in str(caught.value)


@pytest.mark.parametrize(
    ("tables", "complaint"),
    [
        ({"tone": {"size": ["1 deg/s"] * 3, "frequency": "1 Hz"}}, "tone.size: 3 values for 4 gyros"),
        ({"stuck": {"gyro": 5, "from": "1 s", "until": "2 s"}}, "there are 4 gyros"),
    ],
)
def test_what_does_not_fit_the_device_is_refused(tables: dict[str, object], complaint: str) -> None:
    with pytest.raises(HiddenError, match=complaint):
        run(tables, duration_s=1.0)


def test_effects_of_numbers_are_those_of_texts() -> None:
    texts = Hidden.of({"thermal_bias": {"linear": "0.1 deg/s/degC"}, "latency": {"delay": "5 ms"}})
    numbers = Hidden((ThermalBias(linear=0.1 * DEG), Latency(0.005)))
    np.testing.assert_array_equal(run(texts).output_rps, run(numbers).output_rps)
    with pytest.raises(HiddenError, match="no hidden effect"):
        Hidden((0.1,))
    with pytest.raises(HiddenError, match="bias_step.size: must be a number"):
        Hidden((BiasStep(float("nan"), 1.0),))


# --- simulate and the bench file

SCRIPT = Script("short", (Rest(4.0, "rest"), Rotate("x", 40 * DEG, 11.0, 20 * DEG, "x"), Rest(2.0, "rest")))


def device() -> DeviceTruth:
    return DeviceTruth(tetrahedron(), np.zeros((4, 4)), 1e-4, kind="tetrahedron")


def test_a_simulated_recording_carries_a_temperature_read_once_a_second() -> None:
    hidden = Hidden.of({"temperature": {"rise": "8 degC", "time_constant": "100 s"}})
    recording = simulate(SCRIPT, {"array": device()}, 1, site=None, hidden=hidden, started_s=50.0)
    data = recording.sources["array"]
    assert data.temperature_c is not None
    assert data.temperature_c.shape == data.t_ns.shape
    assert data.t_ns[0] == 10_000_000
    t_s = data.t_ns * 1e-9
    whole = np.floor(t_s + 1e-9)
    np.testing.assert_allclose(data.temperature_c, 25 + 8 * (1 - np.exp(-(whole + 50) / 100)), atol=0.03)
    assert len(np.unique(data.temperature_c)) <= 18
    np.testing.assert_allclose(data.temperature_c * 100, np.round(data.temperature_c * 100), atol=1e-9)


def test_effects_of_gyros_may_be_those_of_some_devices() -> None:
    tables = {
        "devices": ["b"],
        "bias_step": {"size": "1 deg/s", "at": "0 s"},
        "table_rate": {"x": "1000 ppm"},
        "temperature": {"start": "50 degC"},
    }
    plain, off = (
        simulate(SCRIPT, {"a": device(), "b": device()}, 1, site=None, hidden=hidden)
        for hidden in (None, Hidden.of(tables))
    )
    added_a, added_b = (off.sources[name].rate_rps - plain.sources[name].rate_rps for name in "ab")
    np.testing.assert_allclose(added_b[:300], DEG, atol=1e-9)
    np.testing.assert_allclose(added_a[:300], 0.0, atol=1e-9)
    np.testing.assert_allclose(added_a, added_b - DEG, atol=1e-9)
    # The Earth turns here: what is turned by 0.1 % more sees it from another side, 1e-7 rad/s at most.
    np.testing.assert_allclose(added_a[1000], 40e-3 * DEG * MOUNTING.p[:, 0], atol=1e-6)
    temperatures = [off.sources[name].temperature_c for name in "ab"]
    assert [round(float(t[0])) for t in temperatures if t is not None] == [25, 50]


def bench_file(folder: Path, hidden: str, twin: str = "") -> Path:
    (folder / "wrong.toml").write_text(hidden)
    text = default_bench_text().replace("[twin]\n", f'[twin]\nhidden = "wrong.toml"\n{twin}')
    path = folder / "bench.toml"
    path.write_text(text)
    return path


def test_a_bench_names_its_hidden_effects_by_a_file_beside_it(tmp_path: Path) -> None:
    path = bench_file(tmp_path, '[bias_step]\nsize = "1 deg/s"\nat = "605 s"\n', 'started = "10 min"\n')
    bench = load_bench(path)
    assert bench.twin.hidden == tmp_path / "wrong.toml"
    off, plain = (simulate_bench(b, SCRIPT, 1).sources["array"].rate_rps for b in (bench, load_bench(None)))
    np.testing.assert_allclose(off - plain, column(np.where(np.arange(1, 1701) >= 500, DEG, 0.0)), atol=1e-12)


TONE = '[[tone]]\nfrequency = "7 Hz"\nsize = "1 deg/s"\n'


@pytest.mark.parametrize(
    ("hidden", "told"),
    [
        ('[latency]\ndelay = "1 deg"\n', ", line 2: latency.delay: '1 deg': unit 'deg' does not measure"),
        ('[latency]\n\n[bandwidth]\ncutoff = "1 Hz"', ", line 1: latency: delay is missing"),
        ('# nothing\n[latency]\ndealy = "1 ms"\n', ", line 2: latency: unknown key 'dealy'; did you mean delay"),
        (TONE + TONE.replace("1 deg/s", "1 K"), ", line 6: tone.1.size: '1 K': there is no unit 'K'"),
        ("[latency", "not valid TOML"),
        (None, "cannot be read"),
    ],
)
def test_a_wrong_file_is_a_wrong_bench(tmp_path: Path, hidden: str | None, told: str) -> None:
    bench = load_bench(bench_file(tmp_path, hidden or ""))
    if hidden is None:
        (tmp_path / "wrong.toml").unlink()
    with pytest.raises(BenchError) as caught:
        simulate_bench(bench, SCRIPT, 1)
    assert "wrong.toml" in str(caught.value)
    assert told in str(caught.value)


def test_a_fault_that_cannot_be_is_told_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(default_bench_text() + '\n[twin.array.fault]\nstuck = 1\nloss = "120 deg"\n')
    assert main(["run", "--bench", str(path), "-o", str(tmp_path / "r.h5")]) == 2
    line = path.read_text().splitlines().index('loss = "120 deg"') + 1
    assert f"bench.toml, line {line}: twin.array.fault.loss: " in capsys.readouterr().err


def test_lists_that_do_not_fit_a_device_are_told_when_the_bench_is_opened(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bench_file(tmp_path, '[scale_cubic]\nsize = ["1 ppm/(deg/s)2", "2 ppm/(deg/s)2"]\n')
    assert main(["run", "--bench", str(path), "-o", str(tmp_path / "r.h5")]) == 2
    assert "scale_cubic.size: 2 values for 4 gyros" in capsys.readouterr().err
    with pytest.raises(BenchError, match="2 values for 4 gyros"):
        simulate_bench(load_bench(path), SCRIPT, 1)


# --- over the wire


def test_gyros_that_look_ahead_put_out_what_a_whole_run_does_whatever_the_table_is_told() -> None:
    tables = {
        "latency": {"delay": "70 ms"},
        "bandwidth": {"cutoff": "3 Hz"},
        "hysteresis": {"size": "1 deg/s"},
        "scale_quadratic": {"size": "10 ppm/(deg/s)"},
        "motor_current_gain": {"size": "20 ppm/(deg/s2)", "friction": "3 deg/s2"},
        "saturation": {"limit": "25 deg/s"},
        "sample_hold": {"samples": 3},
        "stuck": {"gyro": 2, "from": "3 s", "until": "4 s"},
    }
    motion = AxisMotion(0.0, 10.0, 10.0)
    body = Body(
        gimbals="z",
        angles=lambda _axis, t: motion.angles(t),
        revision=lambda: motion.revision,
        latitude_rad=0.0,
        heading_rad=0.0,
        earth_turns=False,
    )
    truth = GyroTruth(*np.zeros((4, 4)), 0.0, 0.0)
    live = GyroArray(mounting=MOUNTING, truth=truth, body=body, rate_hz=100.0, seed=(1,), hidden=Hidden.of(tables))
    out, told = [], {133: 0.5, 140: -0.2, 391: -0.8, 555: 0.3}
    for i in range(1, 801):
        if i in told:
            motion.jog(i / 100 - 0.004, told[i], 2.0)
        out.append(live.sample(np.array([i / 100]))[0])
    known = AxisMotion(0.0, 10.0, 10.0)
    known.keep_all()
    for i, rate in told.items():
        known.jog(i / 100 - 0.004, rate, 2.0)
    body = Body(
        gimbals="z",
        angles=lambda _axis, t: known.angles(t),
        revision=lambda: 0,
        latitude_rad=0.0,
        heading_rad=0.0,
        earth_turns=False,
    )
    whole = GyroArray(
        mounting=MOUNTING, truth=truth, body=body, rate_hz=100.0, seed=(1,), hidden=Hidden.of(tables)
    ).sample_all(np.arange(1, 801) / 100)
    # Told 4 ms before an instant, an axis has moved in it; what was put out before could not know.
    np.testing.assert_allclose(np.array(out), whole, atol=1e-9)


def test_a_table_reports_what_its_encoders_read() -> None:
    faults = Hidden.of({"table_rate": {"z": "1000 ppm"}, "encoder_eccentricity": {"size": "0.1 deg"}}).table
    now = [0.0]
    table = TableModel({"z": AxisData(10.0, 10.0, 1 << 20)}, lambda: now[0], faults)
    table.move_encoder("z", 0.4, 1.0, 1.0)
    now[0] = 60.0
    assert table.encoder_turns("z") == pytest.approx(0.4, abs=1e-6)
    true = float(table.angles("z", np.array([60.0]))[0])
    assert (true + 0.1 * DEG * np.sin(3 * true / 1.001)) / 1.001 == pytest.approx(0.8 * np.pi, abs=1e-5)


def test_a_run_over_the_wire_shows_them_and_reports_the_same_table(tmp_path: Path) -> None:
    script = tmp_path / "script.toml"
    script.write_text(
        '[[step]]\nkind = "rest"\nduration = "4 s"\n[[step]]\nkind = "rotate"\naxis = "x"\nrate = "40 deg/s"\n'
        'acceleration = "20 deg/s2"\nduration = "11 s"\n[[step]]\nkind = "rest"\nduration = "4 s"\n'
    )
    hidden = (
        '[temperature]\nstart = "40 degC"\nrise = "6 degC"\ntime_constant = "100 s"\n'
        '[thermal_bias]\nlinear = "0.1 deg/s/degC"\n[latency]\ndelay = "50 ms"\n'
        '[encoder_eccentricity]\nsize = "0.3 deg"\naxis = "x"\n[hysteresis]\nsize = "0.5 deg/s"\n'
    )
    found = []
    for name, text in (("plain", ""), ("off", hidden)):
        path = bench_file(tmp_path, text, 'started = "100 s"\n')
        main(["run", "--bench", str(path), "--script", str(script), "-o", str(tmp_path / f"{name}.h5")])
        with h5py.File(tmp_path / f"{name}.h5") as file:
            gyro, table = file["imu/gyro2"], file["table"]
            readings = [table[key][()] for key in ("t_ns", "angle_rad", "rate_rps")]
            found.append((gyro["t_ns"][()] * 1e-9, gyro["rate_rps"][()][:, 0], gyro["temperature_c"][()], readings))
    (t_s, plain, _, told), (_, off, temperature, told_off) = found
    for reading, reading_off in zip(told, told_off, strict=True):
        np.testing.assert_array_equal(reading, reading_off)

    warm = 40 + 6 * (1 - np.exp(-(t_s + 100) / 100))
    known = np.isfinite(temperature)
    assert known.mean() > 0.9
    assert np.abs(temperature - warm)[known].max() < 0.05

    at_s, angle, rate = told[0] * 1e-9, told[1][:, 2], told[2][:, 2]
    late_s = t_s - 0.05
    said = np.interp(late_s, at_s, angle)
    true = np.interp(late_s, at_s, rate) / (1 + 0.9 * DEG * np.cos(3 * (said - 0.3 * DEG * np.sin(3 * said))))
    steady = np.interp(t_s, at_s, rate) > 39.99 * DEG
    sensed = (plain[steady].mean() - plain[:300].mean()) / (40 * DEG)
    rest = off - plain - sensed * (true - np.interp(t_s, at_s, rate)) - 0.1 * DEG * (warm - 25)
    turned = t_s > at_s[np.argmax(rate > 2 * DEG)]
    corner = np.min(np.abs(t_s[:, None] - at_s[1:][np.abs(np.diff(rate, n=2, append=0)) > 0.01 * DEG]), axis=1) < 0.2
    assert corner.mean() < 0.3
    # 0.02 deg/s on ramps of 20 deg/s2: a reading of the table stands for an instant within a millisecond.
    np.testing.assert_allclose(rest[turned & ~corner], 0.5 * DEG, atol=0.035 * DEG)
    assert np.abs(rest[turned & ~corner].mean() - 0.5 * DEG) < 0.01 * DEG
