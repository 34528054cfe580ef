"""The calibration of accelerometers for tables and for JSON: units of the states, objects with named values."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, ForceEffectValues
from estimator.estimation.accelerometers.force_effects import BY_NAME, ForceEffect
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.observations.health import Excluded
from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.types import Floats
from station.views.figures import StateUnit
from station.views.json_values import json_object

_MG = 1e3 / GRAVITY_MPS2
OFFSET = StateUnit("offset", "mg", _MG, 3, 9)
"""How offsets are shown."""
PLACE = StateUnit("place", "mm", 1e3, 1, 7)
"""How components of a lever arm are shown."""
FORCE_FIGURES = (
    StateUnit("k", "ppm", 1e6, 0, 6),
    StateUnit("b", "mg", _MG, 2, 8),
    StateUnit("sigma_j", "urad", 1e6, 0, 6),
    StateUnit("sigma_k", "urad", 1e6, 0, 6),
)
"""How the states of accelerometers are shown, in order."""
LIVE_FORCE_FIGURES = tuple(replace(figure, digits=3) if figure.name == "b" else figure for figure in FORCE_FIGURES)
"""How they are shown while their sigmas narrow."""

LINE_WORDS = {
    "noise": "noise",
    "level": "level of the table",
    "orthogonality": "axes of the table",
    "gravity": "local gravity",
    "resolution": "resolution of the encoders",
    "runs": "what each run leaves open",
    "mounting": "mounting of the device",
}
"""What the lines of the budget are called."""


@dataclass(kw_only=True, frozen=True, slots=True)
class EffectRow:
    """A parameter of an effect: its value and standard deviation for each accelerometer, shown in ``figure``'s unit."""

    name: str
    figure: StateUnit
    values: tuple[float, ...]
    sds: tuple[float, ...]


def fitted_forces(calibration: ForceCalibration) -> tuple[StateUnit, ...]:
    """Return the states with the digits that their standard deviations deserve."""
    sds = zip(*(a.sd.tolist() for a in calibration.accelerometers), strict=True)
    return tuple(figure.fitted(own) for figure, own in zip(FORCE_FIGURES, sds, strict=True))


def place_figure(calibration: ForceCalibration) -> StateUnit:
    """Return the unit of places with the digits that their standard deviations deserve."""
    return PLACE.fitted([sd for a in calibration.accelerometers for sd in a.place_sd_m.tolist()])


def names_by_reason(excluded: Sequence[Excluded]) -> dict[str, list[str]]:
    """Return the names of accelerometers that are not calibrated, by the reason."""
    names: dict[str, list[str]] = {}
    for one in excluded:
        names.setdefault(one.reason, []).append(one.name)
    return names


def excluded_lines(excluded: Sequence[Excluded]) -> list[tuple[str, str]]:
    """Return (which accelerometers are not calibrated, why) as words, a pair for each reason."""
    verbs = {True: "are", False: "is"}
    return [
        (f"{', '.join(names)} {verbs[len(names) > 1]} not calibrated", reason)
        for reason, names in names_by_reason(excluded).items()
    ]


def force_object(calibration: ForceCalibration) -> dict[str, Any]:
    """Return the accelerometers of a source for JSON, in SI.

    The delay is left out if it is not known; lever arm, covariance and intrinsic parameters are if no accelerometer is
    calibrated. The lever arm is null if no places are known.
    """
    found: dict[str, Any] = {
        "source": calibration.source,
        "device": calibration.device,
        "gravity_mps2": calibration.gravity_mps2,
        "gravity_from": calibration.gravity_from,
        "accelerometers": [_accelerometer_object(a) for a in calibration.accelerometers],
        "excluded": {e.name: e.reason for e in calibration.excluded},
        "effects": {effect.name: _effect_object(effect, calibration) for effect in calibration.effects},
    }
    if calibration.offset is not None:
        found["delay"] = {"value_s": calibration.offset.offset_s, "sd_s": calibration.offset.sd_s}
    if calibration.accelerometers:
        intrinsic = calibration.intrinsic
        found["lever_arm"] = (
            {"value_m": calibration.arm_m, "sd_m": calibration.arm_sd_m} if calibration.placed else None
        )
        found["covariance"] = calibration.covariance
        found["intrinsic"] = {
            "sensitivity": intrinsic.sensitivity,
            "sensitivity_sd": intrinsic.sensitivity_sd,
            "offset_mps2": intrinsic.offset_mps2,
            "offset_sd_mps2": intrinsic.offset_sd_mps2,
            "pairs": intrinsic.pairs,
            "angle_rad": intrinsic.angle_rad,
            "angle_sd_rad": intrinsic.angle_sd_rad,
        }
    checked: dict[str, Any] = json_object(found)
    return checked


def _effect_object(effect: ForceEffectValues, calibration: ForceCalibration) -> dict[str, Any]:
    """Return an effect of the model: its unit, what a unit of each parameter adds to the output ("adds"), and "about"
    which temperature or instant it is zero; under the name of each accelerometer its parameters with sigmas, in SI.
    """
    adds = dict(zip(effect.parameters, BY_NAME[effect.name].adds, strict=True))
    found: dict[str, Any] = {"unit": effect.unit, "adds": adds, "about": effect.about}
    for accelerometer, values, sds in zip(calibration.accelerometers, effect.values, effect.sd, strict=True):
        pairs = zip(effect.parameters, values.tolist(), sds.tolist(), strict=True)
        found[accelerometer.name] = {name: {"value": value, "sd": sd} for name, value, sd in pairs}
    return found


def effect_rows(calibration: ForceCalibration) -> list[EffectRow]:
    """Return a row for each parameter of each effect of the model, in the units that people read."""
    rows = []
    for effect in calibration.effects:
        rows += rows_of_effect(BY_NAME[effect.name], effect.values, effect.sd, effect.about)
    return rows


def rows_of_effect(effect: ForceEffect, values: Floats, sds: Floats, about: str = "") -> list[EffectRow]:
    """Return a row for each parameter of an effect, of values (a, p) and standard deviations (a, p) in SI.

    a is the number of accelerometers, p that of parameters. A row has the values and standard deviations of all
    accelerometers, still in SI, and the unit and digits to show them with. ``about`` says at which temperature or
    instant the effect is zero, and is added to the names unless empty.
    """
    name = effect.name.replace("_", " ") + (f" ({about})" if about else "")
    rows = []
    for number, parameter in enumerate(effect.parameters):
        own = sds[:, number].tolist()
        rows.append(
            EffectRow(
                name=name if len(effect.parameters) == 1 else f"{name}, {parameter}",
                figure=StateUnit(name, effect.shown_unit, effect.shown, 0, 8).fitted(own),
                values=tuple(values[:, number].tolist()),
                sds=tuple(own),
            )
        )
    return rows


def _accelerometer_object(accelerometer: AccelerometerCalibration) -> dict[str, Any]:
    """Return one accelerometer, in SI: states, sigmas, noise, place, budget; None for a place or noise that is unknown.

    States are under their keys, sigmas and each line of the budget as objects by these keys.
    """
    noise = accelerometer.noise and {
        "vrw_mps2_rthz": accelerometer.noise.mean.arw,
        "instability_mps2": accelerometer.noise.mean.instability,
        "instability_below_mps2": accelerometer.noise.instability_below,
    }
    return {
        "name": accelerometer.name,
        **_by_state(accelerometer.states),
        "sd": _by_state(accelerometer.sd),
        "noise_of_a_sample_mps2": accelerometer.noise_mps2,
        "noise": noise,
        "place_m": accelerometer.place_m if accelerometer.placed else None,
        "place_sd_m": accelerometer.place_sd_m if accelerometer.placed else None,
        "budget": {line.name: _by_state(line.u) for line in accelerometer.budget},
    }


def _by_state(values: np.ndarray) -> dict[str, float]:
    """Return values of the states (4,) by the state's key."""
    return dict(zip(ACCELEROMETER.keys, values.tolist(), strict=True))
