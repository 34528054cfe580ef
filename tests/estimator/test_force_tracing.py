"""Effects of accelerometers: what a twin hides is named, and nothing where it hides nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import ForceFinding, trace_forces
from station.bench.bench import read_bench
from station.opening.simulate import simulate_bench
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
DEVICE = "mti"
HIDDEN = {
    "asymmetry": ('asymmetry = ["1000 ppm", "-1200 ppm", "900 ppm"]', [1e-3, -1.2e-3, 9e-4]),
    "second_order": ('second_order = ["200 ppm/g", "-150 ppm/g", "180 ppm/g"]', [2e-4, -1.5e-4, 1.8e-4]),
    "third_order": ('third_order = ["300 ppm/g2", "-250 ppm/g2", "350 ppm/g2"]', [3e-4, -2.5e-4, 3.5e-4]),
    "cross_j": ('cross = ["200 ppm/g", "-150 ppm/g", "180 ppm/g"]', [2e-4, -1.5e-4, 1.8e-4]),
    "scale_over_temperature": (
        'k_slope = ["150 ppm/degC", "-120 ppm/degC", "140 ppm/degC"]',
        [1.5e-4, -1.2e-4, 1.4e-4],
    ),
}
VIBRATION = 'vibration = ["150 ug/(rad/s)2", "-120 ug/(rad/s)2", "140 ug/(rad/s)2"]'


@cache
def run(hidden: str, seed: int) -> Recording:
    text = BENCH.read_text(encoding="utf-8").replace('rate = "100 Hz"', 'rate = "50 Hz"')
    return simulate_bench(read_bench(f"{text}{hidden}\n", "bench"), load_script(Path("full-imu")), seed)


def traced(hidden: str) -> ForceFinding:
    (found,) = trace_forces([run(hidden, 1)], [run(hidden, 2)])
    return found


def test_nothing_is_added_where_nothing_is_hidden() -> None:
    found = traced("")
    assert found.effects == ()
    assert not found.suspects
    np.testing.assert_array_equal(found.before_mps2, found.after_mps2)


def test_rectified_vibration_is_named_beside_a_lever_arm_and_lowers_the_error_of_another_run() -> None:
    """Both grow with the square of the rate; only that of the arm has a direction, and a part on ramps."""
    found = traced(VIBRATION)
    assert [effect.effect.name for effect in found.effects] == ["vibration_rectification"]
    (effect,) = found.effects
    true = np.array([150.0, -120.0, 140.0]) * 9.80665e-6
    assert np.all(np.abs(effect.values[:, 0] - true) < 4.5 * effect.sd[:, 0])
    assert found.verified
    assert np.all(found.after_mps2 < 0.95 * found.before_mps2)


@pytest.mark.full
@pytest.mark.parametrize("name", HIDDEN)
def test_a_hidden_effect_is_named_with_its_size(name: str) -> None:
    line, true = HIDDEN[name]
    found = traced(line)
    assert [effect.effect.name for effect in found.effects] == [name]
    (effect,) = found.effects
    assert np.all(np.abs(effect.values[:, 0] - true) < 4.5 * effect.sd[:, 0])


@pytest.mark.full
def test_an_effect_that_nobody_has_named_gets_no_name() -> None:
    """A dead band of 0.1 m/s2 about a force of 0.5 g is none of the effects that there are names for."""
    recordings = []
    for seed in (1, 2):
        plain = run("", seed)
        data = plain.sources[DEVICE]
        assert data.accel_mps2 is not None
        bent = data.accel_mps2 + 0.05 * np.tanh((data.accel_mps2 - 5.0) / 0.5)
        recordings.append(replace(plain, sources={DEVICE: replace(data, accel_mps2=bent)}))
    (found,) = trace_forces(recordings[:1], recordings[1:])
    assert found.suspects
    assert "function_of_force" in found.suspects


@pytest.mark.full
def test_runs_are_compared_by_the_accelerometers_that_all_have() -> None:
    """In the second run the first accelerometer is stuck: the others are judged each by its own."""
    first, second = run(VIBRATION, 1), run(VIBRATION, 2)
    data = second.sources[DEVICE]
    assert data.accel_mps2 is not None
    stuck = data.accel_mps2.copy()
    stuck[:, 0] = 0.3
    second = replace(second, sources={DEVICE: replace(data, accel_mps2=stuck)})
    for fitted, judging in (([first], [second]), ([second], [first]), ([first, second], [])):
        (found,) = trace_forces(fitted, judging)
        assert found.names == ("accel y", "accel z")
        assert np.all(found.after_mps2 < found.before_mps2)


def test_a_recording_without_accelerometers_has_no_finding() -> None:
    plain = run("", 1)
    bare = replace(plain, sources={DEVICE: replace(plain.sources[DEVICE], accel_sheet=None)})
    assert trace_forces([bare]) == []


def test_a_recording_that_is_too_short_is_left_out_with_the_reason() -> None:
    whole = run("", 1)
    data = whole.sources[DEVICE]
    assert data.accel_mps2 is not None
    few = int(np.searchsorted(data.t_ns, data.t_ns[0] + 5_000_000_000))
    begun = replace(data, t_ns=data.t_ns[:few], rate_rps=data.rate_rps[:few], accel_mps2=data.accel_mps2[:few])
    short = replace(whole, path=Path("short.h5"), sources={DEVICE: replace(begun, temperature_c=None, counter=None)})
    (found,) = trace_forces([short])
    assert found.names == ()
    assert "short.h5" in found.left_out["short.h5"]
    (found,) = trace_forces([whole, short], [run("", 2), short])
    assert found.names == ("accel x", "accel y", "accel z")
    assert list(found.left_out) == ["short.h5"]


@pytest.mark.full
@pytest.mark.timeout(600)
def test_several_fitted_runs_predict_together() -> None:
    """The error of a prediction by two runs is no larger than by the worse of them."""
    judging = [run(VIBRATION, 5)]
    alone = [trace_forces([run(VIBRATION, seed)], judging)[0].after_mps2 for seed in (1, 2)]
    (together,) = trace_forces([run(VIBRATION, seed) for seed in (1, 2)], judging)
    assert np.all(together.after_mps2 <= np.max(alone, axis=0))
