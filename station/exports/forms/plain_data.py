"""All of a calibration as JSON, YAML and MAT-file, and its states as CSV."""

import csv
import io
import json
import re
from typing import Any

import numpy as np
from scipy.io import savemat

from drivers.types import Floats
from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.compensation import CompensationError
from estimator.calibration.gyro import GyroCalibration
from estimator.geometry.model import STATES
from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.sensors.gyros import GYRO
from station.exports.accelerations import sensitivity_of, spans_space
from station.exports.exported import Exported
from station.exports.written import Written, json_text, lines_of, number, yaml_text
from station.views.accelerometers.result import force_object
from station.views.json_values import budget_and_noise, by_state, json_object, named

FORMAT = "turntable-calibration"
FORMAT_VERSION = 1
_MAT_TEXT = 116  # bytes of text at the head of a MAT-file
_FORMULA = "y = G w - b + effects, so w = H (y + b - effects); rows of G: (1 - k)(p - sigma_k j + sigma_j k)"
_FORCE_FORMULA = (
    "y = S f - b + effects, so f = M (y + b - effects); rows of S: (1 - k)(p - sigma_k j + sigma_j k); "
    "effects: the sum of parameters times what each adds, with a, aj, ak the specific force along p, j, k in m/s2, "
    "g = 9.80665 m/s2, w the body rate in rad/s, T the temperature in degC, t the time of the run in s"
)


def write_json(exported: Exported) -> Written:
    """Return everything as one JSON object, SI units; UsageError for a number that is not finite."""
    return Written(json_text(_object(exported)))


def write_yaml(exported: Exported) -> Written:
    """Return the same as YAML; UsageError as ``write_json``."""
    return Written(yaml_text(_object(exported)))


def write_matlab(exported: Exported) -> Written:
    """Return what ``write_json`` has as a MAT-file of version 5: the struct ``calibration``, lists of structs as cells.

    What is null in JSON is left out, and keys become names that MATLAB allows. UsageError as ``write_json``.
    """
    file = io.BytesIO()
    savemat(file, {"calibration": _matlab(json.loads(json_text(_object(exported))))}, long_field_names=True)
    text = b"MATLAB 5.0 MAT-file, turntable calibration"  # in place of one with the time of writing
    return Written(text.ljust(_MAT_TEXT) + file.getvalue()[_MAT_TEXT:])


def _matlab(value: Any) -> Any:
    """Return a JSON value in the form for savemat: lists become arrays, or cells if they hold objects or texts.

    None is left out of objects; keys become names that MATLAB allows.
    """
    if isinstance(value, dict):
        return {re.sub(r"\W", "_", f"{key}", flags=re.ASCII): _matlab(x) for key, x in value.items() if x is not None}
    if not isinstance(value, list) or all(isinstance(x, float | int | list) for x in value):
        return np.array(value) if isinstance(value, list) else value
    cells = np.empty(len(value), dtype=object)
    cells[:] = [_matlab(x) for x in value]
    return cells


def write_csv(exported: Exported) -> Written:
    """Return one line per gyro: axes, states, sigmas, row of the sensitivity matrix, effects; headings have SI units.

    Lines of accelerometers follow: their names stand in the column "accelerometer" in place of "gyro".
    Cells of columns that a line does not have are empty. Noted as lacking are covariances and uncertainty budget.
    UsageError for a number that is not finite.
    """
    lines = [_line(exported, i, gyro) for i, gyro in enumerate(exported.gyros)]
    for force in exported.forces:
        rows = sensitivity_of(force.accelerometers) if force.accelerometers else ()
        lines += [_force_line(force, place, row) for place, row in enumerate(rows)]
    headings = dict.fromkeys(heading for line in lines for heading in line)
    file = io.StringIO()
    writer = csv.DictWriter(file, list(headings), restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    lacking = ("covariances, uncertainty budget and where it comes from: json and yaml hold them",)
    return Written(file.getvalue(), lacking)


def _line(exported: Exported, i: int, gyro: GyroCalibration) -> dict[str, str]:
    """Return the values of gyro number ``i`` as texts by heading: names, axes, states, sensitivity, noise, effects.

    States and effects have their sigmas beside them. UsageError for a number that is not finite.
    """
    array, gain = exported.compensation.array, exported.compensation.sensitivity
    values = {f"{a}_{part}": x for a in "pjk" for part, x in zip("xyz", getattr(array, a)[i], strict=True)}
    for key, unit, state, sd in zip(STATES, GYRO.units, gyro.states, gyro.sd, strict=True):
        values |= {f"{key} ({unit})": state, f"sd {key} ({unit})": sd}
    values |= {f"g_{part}": x for part, x in zip("xyz", gain[i], strict=True)}
    values["noise of a sample (rad/s)"] = gyro.noise_rps
    for effect in gyro.effects:
        named = f"{effect.effect}: {effect.parameter} ({effect.unit})"
        values |= {named: effect.value, f"sd {named}": effect.sd}
    who = {"gyro": array.names[i], "source": gyro.source, "device": gyro.device}
    return who | {heading: number(value) for heading, value in values.items()}


def _force_line(force: ForceCalibration, place: int, row: Floats) -> dict[str, str]:
    """Return the values of accelerometer number ``place`` as texts by heading; ``row`` (3,) is its sensitivity.

    They are names, axes, sensitivity, states, place, noise, delay and effects, with sigmas. Columns of places, delay
    and effects are left out if they are not known. UsageError for a number that is not finite.
    """
    one = force.accelerometers[place]
    values: dict[str, float] = {}
    for letter, axis in (("p", one.p), ("j", one.j), ("k", one.k_axis), ("g", row)):
        values |= {f"{letter}_{part}": x for part, x in zip("xyz", axis, strict=True)}
    for state, value, sd in zip(ACCELEROMETER.states, one.states, one.sd, strict=True):
        values |= {f"{state.key} ({state.unit})": value, f"sd {state.key} ({state.unit})": sd}
    for part, place_m, sd_m in zip("xyz", one.place_m, one.place_sd_m, strict=True) if force.placed else ():
        values |= {f"place_{part} (m)": place_m, f"sd place_{part} (m)": sd_m}
    values["noise of a sample (m/s2)"] = one.noise_mps2
    if force.offset is not None:
        values |= {"delay (s)": force.offset.offset_s, "sd delay (s)": force.offset.sd_s}
    for effect in force.effects:
        pairs = zip(effect.parameters, effect.values[place].tolist(), effect.sd[place].tolist(), strict=True)
        for parameter, value, sd in pairs:
            heading = f"{effect.name}: {parameter} ({effect.unit})"
            values |= {heading: value, f"sd {heading}": sd}
    who = {"accelerometer": one.name, "source": one.source, "device": one.device}
    return who | {heading: number(value) for heading, value in values.items()}


def _object(exported: Exported) -> dict[str, Any]:
    """Return the complete export as a JSON object; ``solution_h`` is null if the gyros do not span space.

    ``effects`` are those that a correction undoes, ``not_corrected`` has a line on each other. Keys on accelerometers
    are there only if the calibration has sources of some, calibrated or not.
    """
    compensation = exported.compensation
    try:
        solution: Any = compensation.solution.tolist()
    except CompensationError:
        solution = None
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "identity": {key.replace(" ", "_"): value for key, value in exported.identity.items()},
        "units": "SI: rad, rad/s, s, degC; axes and body rates in the body frame of the recording",
        "formula": _FORMULA,
        "calibrated_at": json_object(exported.seen),
        "gyros": [_gyro(exported, i, gyro) for i, gyro in enumerate(exported.gyros)],
        "sensitivity_g": compensation.sensitivity.tolist(),
        "bias_b_rps": compensation.bias_rps.tolist(),
        "solution_h": solution,
        "delay_s": compensation.delay_s,
        "effects": [
            {
                "effect": held.name,
                **held.known.settings,
                "parameters": [{"name": s.name, "unit": s.unit} for s in held.known.sizes],
                "values": held.values.tolist(),
            }
            for held in compensation.effects
        ],
        "not_corrected": lines_of(compensation.left_out),
        "excluded": {e.name: e.reason for e in exported.calibration.excluded},
        "notes": list(exported.calibration.notes),
        "nis_mean": json_object(exported.calibration.nis_mean),
        **named(exported.calibration, ("samples", "lost")),
        **_forces(exported),
    }


def _forces(exported: Exported) -> dict[str, Any]:
    """Return the part of the export about accelerometers, by key; empty if the calibration has no sources of some."""
    if not exported.forces:
        return {}
    return {"force_formula": _FORCE_FORMULA, "accelerometers": [_force(one) for one in exported.forces]}


def _force(calibration: ForceCalibration) -> dict[str, Any]:
    """Return the JSON object of the accelerometers of a source: that of a result, and axes, covariances and constants.

    ``solution_m`` is null if they do not span space. Covariances of places are missing if these are unknown, and the
    constants if there are no accelerometers.
    """
    found = force_object(calibration)
    for told, accelerometer in zip(found["accelerometers"], calibration.accelerometers, strict=True):
        told["p"] = accelerometer.p.tolist()
        told["j"] = accelerometer.j.tolist()
        told["k_axis"] = accelerometer.k_axis.tolist()
        told["covariance"] = accelerometer.covariance.tolist()
        if accelerometer.placed:
            told["place_covariance_m2"] = accelerometer.place_covariance_m2.tolist()
    found["notes"] = list(calibration.notes)
    found["doubts"] = list(calibration.doubts)
    if calibration.accelerometers:
        sensitivity = sensitivity_of(calibration.accelerometers)
        if calibration.placed:
            found["lever_arm"]["covariance_m2"] = calibration.arm_covariance_m2.tolist()
        found["sensitivity_s"] = sensitivity.tolist()
        found["bias_b_mps2"] = [accelerometer.states[1] for accelerometer in calibration.accelerometers]
        found["solution_m"] = np.linalg.pinv(sensitivity).tolist() if spans_space(sensitivity) else None
    return found


def _gyro(exported: Exported, number_of: int, gyro: GyroCalibration) -> dict[str, Any]:
    """Return the JSON object of gyro number ``number_of``: axes, states, covariance, budget, noise, effects."""
    array = exported.compensation.array
    return {
        "name": array.names[number_of],
        "source": gyro.source,
        "device": gyro.device,
        **{axis: getattr(array, axis)[number_of].tolist() for axis in "pjk"},
        "states": dict(zip(STATES, gyro.states.tolist(), strict=True)),
        "sd": by_state(gyro.sd),
        "covariance": gyro.covariance.tolist(),
        **budget_and_noise(gyro),
        "noise_of_a_sample_rps": gyro.noise_rps,
        "effects": [named(value, ("effect", "parameter", "value", "sd", "unit")) for value in gyro.effects],
    }
