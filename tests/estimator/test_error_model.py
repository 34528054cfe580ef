"""The model of a type of gyro: what one device shows makes the next device's estimate better, and its sigmas honest."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from known_effects import fit_known
from motions import simulate
from support import SITE, TABLE_1

from estimator.calibration.calibration_file import read_calibration, write_calibration
from estimator.calibration.error_model import ErrorModel, KnownEffect, ModelError, Size
from estimator.effects.constructed import constructed
from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.estimation.repeatability import repeatability
from estimator.estimation.runs.build import runs_of
from estimator.geometry.array import tetrahedron, triad
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, Turns
from estimator.recordings.writing import write_recording
from estimator.tracing.candidates import Candidate, candidates_of
from estimator.tracing.investigation import Investigation
from estimator.tracing.type_model import error_model_of
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth
from station.scripts.loop_scripts import exploration_script
from station.scripts.script import Script, paper_script

DEG = np.pi / 180
FIRST = [2000e-6, -2000e-6, 1500e-6, 2000e-6]
SECOND = [1200e-6, -2500e-6, -1800e-6, 800e-6]


def simulated(script: Script, seed: int, sizes: list[float] | None, **more: Any) -> Recording:
    """Return a recording of a tetrahedron whose scale factors differ by direction."""
    noise = {"arw_rps_rthz": 0.005 * DEG, "bias_instability_rps": 2 * DEG / 3600}
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), **noise, kind="tetrahedron")
    tables = dict(more)
    if sizes:
        tables["scale_asymmetry"] = {"size": [f"{1e6 * size:g} ppm" for size in sizes]}
    return simulate(script, {"array": device}, seed, site=SITE, hidden=Hidden.of(tables) if tables else None)


@pytest.fixture
def model(asymmetry: tuple[Investigation, ErrorModel]) -> ErrorModel:
    """What an investigation of the first device says of its type."""
    found, model = asymmetry
    assert [added.effect for added in found.added] == ["scale_asymmetry"]
    return model


def test_the_typical_size_is_that_of_the_gyros_that_were_looked_at(model: ErrorModel) -> None:
    (known,) = model.effects
    assert known.mean == 0
    assert known.sd[0] == pytest.approx(1.5 * np.sqrt(np.mean(np.square(FIRST))), rel=0.05)
    for (pair,), true in zip(known.found.values(), FIRST, strict=True):
        assert abs(pair[0] - true) < 5 * pair[1]


def test_the_next_device_gets_its_own_sizes_and_states_that_are_right(model: ErrorModel) -> None:
    errors, sizes = [], []
    for seed in (11, 12, 13):
        calibration = calibrate(simulated(exploration_script(), seed, SECOND), model=model)
        assert calibration.nis_mean == pytest.approx(1, abs=0.1)
        errors += [(gyro.states - TABLE_1) / gyro.sd for gyro in calibration.gyros]
        sizes += [
            (gyro.effects[0].value - true) / gyro.effects[0].sd
            for gyro, true in zip(calibration.gyros, SECOND, strict=True)
        ]
        assert max(gyro.effects[0].sd for gyro in calibration.gyros) < 1e-4
        assert not any("does not show these effects" in note for note in calibration.notes)
    assert np.abs(errors).max() < 4
    assert np.sqrt(np.mean(np.square(errors))) < 1.4
    assert np.abs(sizes).max() < 4


def test_what_the_script_cannot_see_of_an_effect_is_in_the_sigmas_of_the_states(model: ErrorModel) -> None:
    recording = simulated(paper_script(), 21, SECOND)
    bare, better = calibrate(recording), calibrate(recording, model=model)
    wrong = [abs(gyro.states[0] - TABLE_1[0]) / gyro.sd[0] for gyro in bare.gyros]
    assert min(wrong) > 5  # turns in one direction only: k is wrong without a sign of it
    for gyro in better.gyros:
        assert (np.abs(gyro.states - TABLE_1) < 4 * gyro.sd).all()
        assert gyro.sd[0] > 1e-3
        assert [line.name for line in gyro.budget] == ["noise", "effects"]
        assert np.sum([line.u**2 for line in gyro.budget], axis=0) == pytest.approx(gyro.sd**2)
    assert any("does not show these effects" in note and "scale asymmetry" in note for note in better.notes)


def test_runs_that_see_an_effect_and_runs_that_do_not_are_not_said_to_differ(model: ErrorModel) -> None:
    scripts = (paper_script(), exploration_script())
    runs = [simulated(script, 25 + n, SECOND) for n, script in enumerate(scripts)]
    bare = repeatability([calibrate(run).gyros for run in runs])
    better = repeatability([calibrate(run, model=model).gyros for run in runs])
    assert all(gyro.differs[0] for gyro in bare)
    assert not any(gyro.differs.any() for gyro in better)


def test_a_clean_device_is_estimated_as_well_with_the_model_as_without(model: ErrorModel) -> None:
    recording = simulated(exploration_script(), 31, None)
    bare, better = calibrate(recording), calibrate(recording, model=model)
    for one, other in zip(bare.gyros, better.gyros, strict=True):
        assert np.abs((one.states - other.states) / one.sd).max() < 1.5
        assert (other.sd[[0, 2, 3]] < 1.3 * one.sd[[0, 2, 3]]).all()


def test_shared_effects_keep_their_value_and_settings_survive_the_file(tmp_path: Path) -> None:
    hidden = {
        "latency": {"delay": "4 ms"},
        "warm_up": {"size": "0.03 deg/s", "time_constant": "60 s"},
        "table_harmonic": {"axis": "y", "order": 2, "cosine": "0.02 deg/s", "sine": "0 deg/s"},
    }
    recording = simulated(exploration_script(), 41, None, **hidden)
    model = error_model_of(fit_known([recording], ["latency", "table_harmonic", "warm_up"]))
    known = {effect.name: effect for effect in model.effects}
    assert known["latency"].mean[0] == pytest.approx(4e-3, rel=0.05)
    assert 0 < known["latency"].sd[0] < 1e-3
    assert known["warm_up"].settings["time_constant_s"] == pytest.approx(60, rel=0.3)
    assert known["table_harmonic"].settings == {"axis": "y", "order": 2}
    path = tmp_path / "model.json"
    path.write_text(model.text(), encoding="utf-8")
    assert ErrorModel.read(path) == model
    calibration = calibrate(recording, model=model)
    for gyro in calibration.gyros:
        assert (np.abs(gyro.states - TABLE_1) < 4 * gyro.sd).all()
        values = {value.effect: value for value in gyro.effects}
        assert abs(values["latency"].value - 4e-3) < 4 * values["latency"].sd
        assert values["latency"].shared


def test_every_effect_that_tracing_may_add_can_be_kept_or_is_left_out_with_a_reason() -> None:
    runs = runs_of(simulated(exploration_script(), 51, None))[0]
    named = {c.called for c in candidates_of(runs)[0] if not c.depends_on} | {"tone", "sample_hold"}
    for name in named - {"bias_step"}:
        entry: dict[str, Any] = {"effect": name, "shared": False, "parameters": []}
        entry |= {"time_constant_s": 60, "width_rps": 0.01, "frequency_hz": 7.3, "axis": "x", "order": 2}
        text = json.dumps({"format": "turntable-error-model", "format_version": 1, "effects": [entry]})
        with pytest.raises(ModelError) as refused:
            ErrorModel.parse(text, "model")
        assert "does not know" not in str(refused.value), name


def test_a_model_without_effects_changes_nothing() -> None:
    recording = simulated(exploration_script(), 61, None)
    plain, empty = calibrate(recording), calibrate(recording, model=ErrorModel(()))
    assert np.array_equal([g.states for g in plain.gyros], [g.states for g in empty.gyros])
    assert np.array_equal([g.covariance for g in plain.gyros], [g.covariance for g in empty.gyros])


def test_the_recording_holds_effects_and_the_model_they_were_found_with(model: ErrorModel, tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    recording = simulated(exploration_script(), 71, SECOND)
    write_recording(path, recording)
    calibration = calibrate(recording, model=model)
    write_calibration(path, calibration)
    with h5py.File(path) as file:
        group = file["calibration"]
        assert group["effects"].shape == group["effects_sd"].shape == (4, 1)
        assert group["effects"][1, 0] == calibration.gyros[1].effects[0].value
        assert list(group.attrs["effect_names"]) == ["scale_asymmetry: each direction"]
        assert ErrorModel.parse(group.attrs["model"], "") == model


def law(text: str, sd: float = 1e-3) -> KnownEffect:
    """A constructed effect of one term."""
    return KnownEffect("constructed", False, (Size(f"of {text}", "rad/s per unit", 0.0, sd),), {"law": text})


def test_a_damaged_name_of_a_parameter_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.h5"
    recording = simulated(exploration_script(), 71, SECOND)
    write_recording(path, recording)
    write_calibration(path, calibrate(recording, model=ErrorModel((law("abs(u)"),))))
    with h5py.File(path, "r+") as file:
        file["calibration"].attrs["effect_names"] = ["constructed abs(u): nonsense"]
    with pytest.raises(RecordingError, match="damaged calibration .*nonsense"):
        read_calibration(path)


def test_laws_that_were_constructed_are_kept_and_estimated_with_the_next_device(tmp_path: Path) -> None:
    recording = simulated(exploration_script(), 45, FIRST, g_sensitivity={"x": "0.05 deg/s/g"})
    model = ErrorModel((law("abs(u)", 3e-3), law("gx", 2e-3)))
    path = tmp_path / "model.json"
    path.write_text(model.text(), encoding="utf-8")
    assert ErrorModel.read(path) == model
    calibration = calibrate(recording, model=model)
    for gyro, size in zip(calibration.gyros, FIRST, strict=True):
        assert (np.abs(gyro.states - TABLE_1) < 4 * gyro.sd).all()
        of_speed, of_force = gyro.effects
        assert (of_speed.effect, of_speed.parameter) == ("constructed abs(u)", "of abs(u)")
        assert abs(of_speed.value - size) < 4 * of_speed.sd < 1e-3
        assert abs(of_force.value - 0.05 * DEG) < 4 * of_force.sd < 1e-3
    write_recording(path.with_suffix(".h5"), recording)
    write_calibration(path.with_suffix(".h5"), calibration)
    assert read_calibration(path.with_suffix(".h5")).gyros[2].effects == calibration.gyros[2].effects


def test_a_law_with_a_constant_that_tracing_fitted_goes_into_the_model() -> None:
    runs = [simulated(exploration_script(), 46, FIRST)]
    candidate = Candidate("law: lag(abs(u), {c})", constructed("lag(abs(u), 4.2)", (1e-3,)), 0.0, theta=4.2)
    found = fit_known(runs, ["scale_asymmetry"])
    (part,) = found.parts
    (known,) = error_model_of(replace(found, parts=(replace(part, candidate=candidate),))).effects
    assert (known.name, known.law, known.sizes[0].name) == ("constructed", "lag(abs(u), 4.2)", "of lag(abs(u), 4.2)")
    assert known.found.keys() == set(found.names)


@pytest.mark.parametrize(
    "text",
    ["u*", "__import__('os')", "u if u else t", "lag(u, 0)", "lag(3, 5)", "u # */ int x;", "last(u, -1)", "phlogiston"],
)
def test_a_text_that_is_no_law_is_refused(text: str) -> None:
    whole = json.loads(ErrorModel((law("u**2"),)).text())
    whole["effects"][0]["law"] = text
    with pytest.raises(ModelError, match="damaged"):
        ErrorModel.parse(json.dumps(whole), "model.json")


def test_a_law_of_an_axis_that_the_table_does_not_have_is_refused() -> None:
    recording = simulated(exploration_script(), 47, None)
    with pytest.raises(ModelError, match="no axis x"):
        ErrorModel((law("cos(angle_x)"),)).made(("z",), frozenset({"gimbals"}))
    cold = {name: replace(data, temperature_c=None) for name, data in recording.sources.items()}
    with pytest.raises(ModelError, match="temperature.*leave out --model"):
        calibrate(replace(recording, sources=cold), model=ErrorModel((law("lag(T, 30)"),)))


def thermal() -> ErrorModel:
    """A model that needs a temperature."""
    return ErrorModel((KnownEffect("thermal_bias", False, (Size("linear", "rad/s/K", 0.0, 1e-3),)),))


def test_at_rest_the_bias_is_told_apart_from_what_the_temperature_does() -> None:
    random = np.random.default_rng(1)
    t_s = np.arange(0, 600, 0.02)
    temperature = 25 + 5 * np.sin(t_s / 100)
    rate = 2e-3 + 4e-4 * (temperature - 25)[:, None] + 6e-4 * random.standard_normal((len(t_s), 3))
    stamps = np.round(t_s * 1e9).astype(np.int64)
    still = RateReadings(stamps[[0, -1]], np.zeros((2, 3)))
    recording = Recording({"imu": ImuData(triad(), stamps, rate, temperature_c=temperature)}, still)
    calibration = calibrate(recording, model=thermal())
    for gyro in calibration.gyros:
        assert abs(gyro.states[1] + 2e-3) < 4 * gyro.sd[1] < 1e-4
        assert abs(gyro.effects[0].value - 4e-4) < 4 * gyro.effects[0].sd < 1e-4


def test_a_recording_that_lacks_what_the_model_needs_is_refused_with_what_to_do(model: ErrorModel) -> None:
    recording = simulated(exploration_script(), 81, None)
    cold = {name: replace(data, temperature_c=None) for name, data in recording.sources.items()}
    with pytest.raises(ModelError, match="thermal_bias.*temperature.*leave out --model"):
        calibrate(replace(recording, sources=cold), model=thermal())
    ends = np.array([0, 10**9], dtype=np.int64)
    turned = replace(recording, reference=Turns(ends[:1], ends[1:], np.ones((1, 3)), np.ones(1)))
    with pytest.raises(ModelError, match="turns"):
        calibrate(turned, model=model)
    harmonic = tuple(Size(part, "rad/s", 0.0, 1e-4) for part in ("cosine", "sine"))
    other = ErrorModel((KnownEffect("table_harmonic", False, harmonic, {"axis": "w", "order": 1}),))
    with pytest.raises(ModelError, match="no axis w"):
        calibrate(recording, model=other)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("turntable-error-model", "a poem"), "not an error model"),
        (('"format_version": 1', '"format_version": 2'), "version 2"),
        (("thermal_bias", "phlogiston"), "phlogiston.*catalogue"),
        (('"sd": 0.001', '"sd": -1'), "damaged"),
        (('"sd": 0.001', '"sd": "wide"'), "damaged"),
        (("rad/s/K", "rad"), "damaged"),
        (('"effects": [', '"effects": ['[:-1] + "3, "), "not an error model"),
    ],
)
def test_a_file_that_is_no_model_is_refused_by_name(tmp_path: Path, change: tuple[str, str], said: str) -> None:
    path = tmp_path / "model.json"
    text = thermal().text()
    assert change[0] in text
    path.write_text(text.replace(*change), encoding="utf-8")
    with pytest.raises(ModelError, match=f"model.json.*{said}"):
        ErrorModel.read(path)
