"""Effects that an investigation found of accelerometers, as a model with which the next device is calibrated."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.error_model import ErrorModel, KnownForceEffect, ModelError, Size
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.estimation.calibrate import calibrate
from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import trace_forces
from estimator.tracing.type_model import force_effects_of
from station.bench.bench import read_bench
from station.opening.simulate import simulate_bench
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
TRUE_B_MG = [5.0, -8.0, 3.0]
FIRST = 'asymmetry = ["1000 ppm", "-1200 ppm", "900 ppm"]'
NEXT = 'asymmetry = ["-800 ppm", "1100 ppm", "1300 ppm"]'
NEXT_SIZES = [-8e-4, 1.1e-3, 1.3e-3]


@cache
def run(hidden: str, seed: int) -> Recording:
    text = BENCH.read_text(encoding="utf-8").replace('rate = "100 Hz"', 'rate = "50 Hz"')
    return simulate_bench(read_bench(f"{text}{hidden}\n", "bench"), load_script(Path("full-imu")), seed)


@cache
def model_found() -> ErrorModel:
    """Return the model that the first device of a type gave, as a file holds it."""
    (found,) = trace_forces([run(FIRST, 1)], [run(FIRST, 2)])
    return ErrorModel.parse(ErrorModel((), forces=force_effects_of([found])).text(), "model")


def errors_of_b(found: ForceCalibration) -> np.ndarray:
    """Return the errors of the biases in standard deviations."""
    true = np.array(TRUE_B_MG) * 9.80665e-3
    return np.array([(a.states[1] - b) / a.sd[1] for a, b in zip(found.accelerometers, true, strict=True)])


def test_the_next_device_is_calibrated_with_the_effect_that_the_first_one_showed() -> None:
    recording = run(NEXT, 3)
    (without,) = calibrate(recording, innovations=False).forces
    (found,) = calibrate(recording, innovations=False, model=model_found()).forces
    assert np.abs(errors_of_b(without)).max() > 4
    assert np.abs(errors_of_b(found)).max() < 4
    (effect,) = found.effects
    assert effect.name == "asymmetry"
    assert np.all(np.abs(effect.values[:, 0] - NEXT_SIZES) < 4 * effect.sd[:, 0])
    assert np.all(effect.sd[:, 0] < 1e-4)


def test_a_model_of_accelerometers_leaves_gyros_as_they_are() -> None:
    recording = run(NEXT, 3)
    plain = calibrate(recording, innovations=False, excluded=frozenset())
    found = calibrate(recording, innovations=False, excluded=frozenset(), model=model_found())
    for own, other in zip(found.gyros, plain.gyros, strict=True):
        np.testing.assert_array_equal(own.states, other.states)
        np.testing.assert_array_equal(own.covariance, other.covariance)


def test_an_effect_that_this_station_does_not_know_is_refused() -> None:
    top = json.loads(model_found().text())
    top["accelerometers"][0]["effect"] = "asymetry"
    with pytest.raises(ModelError, match="asymetry of accelerometers, which this station does not know"):
        calibrate(run(NEXT, 3), innovations=False, model=ErrorModel.parse(json.dumps(top), "model"))


@pytest.mark.parametrize("changed", [{"unit": "ppm"}, {"name": "slope"}, {"mean": 5e-3}])
def test_a_parameter_that_is_not_the_catalogues_is_refused(changed: dict[str, object]) -> None:
    top = json.loads(model_found().text())
    top["accelerometers"][0]["parameters"][0].update(changed)
    with pytest.raises(ModelError, match="asymmetry of accelerometers must have 'coefficient' in '1', with mean 0"):
        calibrate(run(NEXT, 3), innovations=False, model=ErrorModel.parse(json.dumps(top), "model"))


def test_a_recording_without_accelerometers_is_calibrated_with_a_note_that_their_effects_are_not_used() -> None:
    whole = run(NEXT, 3)
    data = replace(whole.sources["mti"], accel_sheet=None)
    found = calibrate(replace(whole, sources={"mti": data}), innovations=False, model=model_found())
    assert not found.forces
    assert any("effects of accelerometers (asymmetry) are not used" in note for note in found.notes)


def of_temperature() -> ErrorModel:
    """Return a model in which scale factors go with the temperature."""
    size = Size("coefficient", "1/K", 0.0, 1e-4)
    return ErrorModel((), forces=(KnownForceEffect(name="scale_over_temperature", sizes=(size,)),))


def test_states_are_those_at_the_mean_temperature_of_the_run_however_far_that_is_from_25_degrees() -> None:
    recording = run(NEXT, 3)
    data = recording.sources["mti"]
    warm = replace(data, temperature_c=np.linspace(44.0, 46.0, len(data.t_ns)))
    warm_recording = replace(recording, sources={"mti": warm})
    (without,), _ = calibrate_forces(warm_recording)
    (found,), _ = calibrate_forces(warm_recording, of_temperature().forces)
    assert found.effects[0].about == "T0 = 45.00 degC"
    for one, other in zip(found.accelerometers, without.accelerometers, strict=True):
        assert abs(one.states[0] - other.states[0]) < other.sd[0]
        assert one.sd[0] < 2 * other.sd[0]


def test_an_effect_of_the_temperature_needs_a_temperature() -> None:
    model = of_temperature()
    recording = run(NEXT, 3)
    data = replace(recording.sources["mti"], temperature_c=None)
    with pytest.raises(ModelError, match="must hold the temperature"):
        calibrate(replace(recording, sources={"mti": data}), innovations=False, model=model)
