"""What is known of every effect, in all its places, stays what it was: against numbers pinned in a file.

``python tests/estimator/test_effect_pins.py`` writes the file anew, for a change that is meant.
"""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motions import simulate

from estimator.calibration.compensation import Compensation
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.effects.catalogue import catalogue
from estimator.effects.conditions import Conditions
from estimator.estimation.runs.build import run_of, runs_of
from estimator.estimation.runs.run import Run
from estimator.estimation.undeclared import undeclared as undeclared_of
from estimator.geometry.array import tetrahedron, triad
from estimator.geometry.kinematics import Site
from estimator.recordings.recording import Recording
from estimator.recordings.reference import RateReadings
from estimator.tracing.candidates import candidates_of
from estimator.tracing.residuals.dependence import Regressors
from sims.physics.hidden import Hidden
from station.cli import main
from station.opening import DeviceTruth
from station.report.chapters.correction import Correction, snippet
from station.scripts.script import Rest, Rotate, Script

PINNED = Path(__file__).parents[1] / "data" / "effects" / "pinned.json"
GIMBALS = ("z", "y", "x")
SETTINGS: dict[str, dict[str, float | int | str]] = {
    "warm_up": {"time_constant_s": 40.0},
    "tone": {"frequency_hz": 7.3},
    "dead_band": {"width_rps": 1e-3},
    "table_harmonic": {"order": 2, "axis": "x"},
    "constructed": {"law": "lag(T, 58)*gx"},
}
NOT_KEPT = {"bias_step", "bias_walk", "saturation", "stuck"}
UNDONE = ["thermal_bias", "thermal_bias_quadratic", "thermal_scale", "thermal_gradient", "g_sensitivity", "warm_up"]
UNDONE += ["scale_asymmetry", "scale_quadratic", "scale_cubic", "acceleration_sensitivity", "bandwidth"]


def listed() -> list[dict[str, Any]]:
    """What ``station effects --json`` prints."""
    said = io.StringIO()
    with redirect_stdout(said):
        assert main(["effects", "--json"]) == 0
    found: list[dict[str, Any]] = json.loads(said.getvalue())
    return found


def regressors() -> dict[str, Any]:
    """Columns of every effect of the catalogue for one gyro, of three axes that swing, by its parameters."""
    t_s = np.arange(0.5, 21.0, 2.5)
    size, speed = np.array([0.9, 0.7, 1.1]), np.array([0.5, 0.8, 0.3])
    phase = speed * t_s[:, None] + np.array([0.1, 0.9, 2.0])
    motion = size * np.sin(phase), size * speed * np.cos(phase), -size * speed**2 * np.sin(phase)
    seen = Conditions.on_table(t_s, *motion, GIMBALS, temperature_c=25 + 3 * np.sin(0.1 * t_s), site=Site(0.8, 0.5))
    return {
        when: {
            e.name: [[p.name, p.unit, p.largest, *e.columns(one, tetrahedron(), 1)[:, n].tolist()]
                     for n, p in enumerate(e.parameters)]
            for e in catalogue(GIMBALS, 20.0)
        }
        for when, one in (("afterwards", seen), ("as it goes", replace(seen, causal=True)))
    }  # fmt: skip


@cache
def recording() -> Recording:
    """A short run of a tetrahedron."""
    turns = [Rotate(axis, sign * 0.4, 6.0, 0.5, f"{axis} {sign}") for axis in GIMBALS for sign in (1, -1)]
    script = Script("short", tuple(step for turn in turns for step in (turn, Rest(4.0, "rest"))))
    noise = {"arw_rps_rthz": 1e-4, "bias_instability_rps": 1e-6}
    device = DeviceTruth(tetrahedron(), np.zeros((4, 4)), **noise, kind="tetrahedron")
    hidden = Hidden.of({"temperature": {"rise": "8 degC", "time_constant": "20 s"}})
    return simulate(script, {"array": device}, 5, site=Site(0.8, 0.5), hidden=hidden)


def runs(kind: str) -> list[Run]:
    """Runs of the recording, as it is, and against another instrument that knows no table."""
    whole = recording()
    if kind == "foreign":
        data = whole.sources["array"]
        w = data.rate_rps @ np.linalg.pinv(data.array.p).T
        whole = replace(whole, reference=RateReadings(data.t_ns, w), site=None)
    found = runs_of(whole)[0]
    return [replace(run, held=2) for run in found] if kind == "held" else found


def searched(kind: str) -> dict[str, Any]:
    """All that is tried on a run, with its odds, and what a residual is compared with."""
    own = runs(kind)
    candidates, left_out = candidates_of(own)
    return {
        "candidates": {
            c.name: [c.called, c.log_prior, c.theta, None if c.start is None else c.start.tolist(), c.range_log, c.unit,
                     c.beside, c.likelier, c.by_size, c.run is not None, len(c.effect.parameters),
                     "" if c.depends_on else [p.name for p in c.effect.parameters]]
            for c in candidates
        },
        "left out": left_out,
        "dependences": {name: len(where) for name, where in Regressors(own).where.items()},
    }  # fmt: skip


def undeclared() -> dict[str, Any]:
    """Laws that stand beside the states for what nobody has spoken of, their sizes and squares of their columns."""
    made = run_of(recording(), "array", recording().sources["array"])
    assert made is not None
    found = undeclared_of([made], frozenset({"table_harmonic"}))
    laws = [*found.laws, *found.assumed]
    squares = [np.sum(found.runs[0].columns(law.effect, 2) ** 2, axis=0).tolist() for law in laws]
    return {"laws": [[law.called, law.sd.tolist(), one] for law, one in zip(laws, squares, strict=True)]}


def model_of(names: list[str]) -> ErrorModel:
    """A model that holds effects as the catalogue lists them, the sizes by number."""
    entries = {entry["effect"].removesuffix("_1"): entry for entry in listed()}
    entries["constructed"] = {"shared": False, "parameters": [{"name": "of it", "unit": "rad/s per unit"}]}
    parts: list[dict[str, Any]] = []
    for name in names:
        own = entries[name]["parameters"][: 2 if name == "table_harmonic" else None]
        sizes = [{"name": p["name"], "unit": p["unit"], "mean": 0.0, "sd": 1e-3 * (n + 1)} for n, p in enumerate(own)]
        part = {"effect": name, **SETTINGS.get(name, {}), "shared": entries[name]["shared"], "parameters": sizes}
        parts.append({**part, "found": {}})
    whole = {"format": "turntable-error-model", "format_version": 1, "effects": parts, "left_out": {}}
    return ErrorModel.parse(json.dumps(whole), "made by hand")


def kept() -> list[str]:
    """Effects that a model of a type of gyro holds."""
    names = [entry["effect"].removesuffix("_1") for entry in listed()]
    return [n for n in names if n not in NOT_KEPT and n not in ("table_harmonic_2", "table_harmonic_4")] + [
        "constructed"
    ]


def compensation(names: list[str]) -> Compensation:
    """The compensation of a triad with these effects."""
    model, array = model_of(names), triad()
    gyros = []
    for i, gyro in enumerate(array.names):
        values = [
            EffectValue(
                effect=e.called,
                parameter=s.name,
                value=s.sd * (i + 1) / 3,
                sd=0.0,
                unit=s.unit,
                expected_sd=s.sd,
                shared=e.shared,
            )
            for e in model.effects
            for s in e.sizes
        ]
        states = np.array([1e-3, 2e-3, -1e-3, 5e-4]) * (i + 1)
        gyros.append(
            GyroCalibration(
                name=gyro,
                source="imu",
                states=states,
                covariance=np.eye(4),
                noise_rps=1e-4,
                p=array.p[i],
                device="imu",
                effects=tuple(values),
            )
        )
    return Compensation.of(gyros, {"imu": array}, model.text())


def models() -> dict[str, Any]:
    """How effects are kept and undone: the file of a model, and what becomes of each."""
    whole = compensation(kept())
    simple, dropped = compensation(UNDONE).simplified(("thermal_bias",), 31.0)
    return {
        "file": json.loads(model_of(kept()).text()),
        "called": [known.called for known in model_of(kept()).effects],
        "undone": {effect.known.called: str(effect.acts) for effect in whole.effects},
        "left out": dict(whole.left_out),
        "delay": whole.delay_s,
        "simplified": [simple.states.tolist(), dropped],
    }


def corrected() -> dict[str, Any]:
    """What the code of a report makes of samples, by effect: body rates, first and last row."""
    random = np.random.default_rng(3)
    t_s, rate = np.arange(60) * 0.05, random.normal(0, 0.4, (60, 3))
    given = {"temperature_c": 27 + 4 * np.sin(t_s), "accel_mps2": random.normal(0, 5, (60, 3)), "t_s": t_s}
    found = {}
    for name in UNDONE:
        defined: dict[str, Any] = {}
        exec(snippet(Correction("array", compensation([name]), False, {}), "made by hand"), defined)
        arguments = {key: value for key, value in given.items() if key in defined["body_rate"].__code__.co_varnames}
        found[name] = defined["body_rate"](rate, **arguments)[[1, -1]].tolist()
    return found


PLACES = {
    "listed": listed,
    "regressors": regressors,
    "searched": lambda: searched("plain"),
    "searched against another instrument": lambda: searched("foreign"),
    "searched in held samples": lambda: searched("held"),
    "undeclared": undeclared,
    "models": models,
    "corrected": corrected,
}


def near(found: Any, pinned: Any) -> bool:
    """Whether two objects are the same, numbers to rounding."""
    if isinstance(pinned, dict):
        return found.keys() == pinned.keys() and all(near(found[key], pinned[key]) for key in pinned)
    if isinstance(pinned, list):
        return len(found) == len(pinned) and all(map(near, found, pinned))
    if isinstance(pinned, float):
        return bool(found == pytest.approx(pinned, rel=1e-9, abs=1e-12))
    return bool(found == pinned)


@pytest.mark.parametrize("place", PLACES)
def test_what_is_known_of_effects_stays(place: str) -> None:
    pinned = json.loads(PINNED.read_text(encoding="utf-8"))[place]
    found = json.loads(json.dumps(PLACES[place]()))
    assert found.keys() == pinned.keys() if isinstance(found, dict) else len(found) == len(pinned)
    for key in pinned if isinstance(pinned, dict) else range(len(pinned)):
        assert near(found[key], pinned[key]), key


if __name__ == "__main__":
    PINNED.write_text(json.dumps({place: make() for place, make in PLACES.items()}) + "\n", encoding="utf-8")
