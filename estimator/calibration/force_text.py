"""Calibrations of accelerometers as a text of JSON with a version, as a recording keeps them."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from estimator.calibration.accelerometer import AccelerometerCalibration, ForceCalibration, ForceEffectValues
from estimator.calibration.budget import Contribution
from estimator.geometry.noise import NoiseFound, NoiseModel
from estimator.observations.health import Excluded
from estimator.observations.timing import TimeOffset

VERSION = 1


def forces_text(forces: Sequence[ForceCalibration]) -> str:
    """Return calibrations of accelerometers as JSON."""
    return json.dumps({"version": VERSION, "sources": [_object(one) for one in forces]})


def forces_of(text: str) -> tuple[ForceCalibration, ...]:
    """Return the calibrations in a text of ``forces_text``.

    ValueError if it is of another version or no JSON; that, KeyError, TypeError or AttributeError if it is damaged.
    """
    top = json.loads(text)
    if top.get("version") != VERSION:
        raise ValueError(f"version {top.get('version')} of the calibration of accelerometers")
    return tuple(_calibration(own) for own in top["sources"])


def _object(calibration: ForceCalibration) -> dict[str, Any]:
    """Return all fields of the calibration of a source as values of JSON; ``_calibration`` reads them."""
    return {
        "source": calibration.source,
        "device": calibration.device,
        "accelerometers": [_accelerometer_object(a) for a in calibration.accelerometers],
        "covariance": calibration.covariance.tolist(),
        "arm_m": calibration.arm_m.tolist(),
        "arm_covariance_m2": calibration.arm_covariance_m2.tolist(),
        "gravity_mps2": calibration.gravity_mps2,
        "gravity_from": calibration.gravity_from,
        "offset": None if calibration.offset is None else [calibration.offset.offset_s, calibration.offset.sd_s],
        "excluded": [[e.name, e.reason] for e in calibration.excluded],
        "notes": list(calibration.notes),
        "doubts": list(calibration.doubts),
        "effects": [_effect_object(effect) for effect in calibration.effects],
        "rest_angle_share": calibration.rest_angle_share,
    }


def _effect_object(effect: ForceEffectValues) -> dict[str, Any]:
    """Return all fields of an effect of a model as values of JSON; arrays become lists."""
    return {
        "name": effect.name,
        "unit": effect.unit,
        "parameters": list(effect.parameters),
        "values": effect.values.tolist(),
        "sd": effect.sd.tolist(),
        "about": effect.about,
    }


def _accelerometer_object(accelerometer: AccelerometerCalibration) -> dict[str, Any]:
    """Return one accelerometer as values of JSON, without source and device, which are those of its calibration.

    ``noise`` is [N, B, K, upper limit of B, of K], null if unknown.
    """
    noise = None
    if accelerometer.noise is not None:
        mean = accelerometer.noise.mean
        noise = [
            mean.arw,
            mean.instability,
            mean.walk,
            accelerometer.noise.instability_below,
            accelerometer.noise.walk_below,
        ]
    arrays = ("p", "j", "k_axis", "states", "covariance", "place_m", "place_covariance_m2")
    return {
        "name": accelerometer.name,
        **{key: getattr(accelerometer, key).tolist() for key in arrays},
        "noise_mps2": accelerometer.noise_mps2,
        "budget": [[line.name, line.covariance.tolist()] for line in accelerometer.budget],
        "noise": noise,
    }


def _calibration(source: Mapping[str, Any]) -> ForceCalibration:
    """Return the calibration of a source from values of JSON, as ``_object`` made them; KeyError if one is missing."""
    offset = source["offset"]
    return ForceCalibration(
        source=str(source["source"]),
        device=str(source["device"]),
        accelerometers=tuple(_accelerometer(a, source) for a in source["accelerometers"]),
        covariance=np.array(source["covariance"], dtype=np.float64),
        arm_m=np.array(source["arm_m"], dtype=np.float64),
        arm_covariance_m2=np.array(source["arm_covariance_m2"], dtype=np.float64),
        gravity_mps2=float(source["gravity_mps2"]),
        gravity_from=str(source["gravity_from"]),
        offset=None if offset is None else TimeOffset(float(offset[0]), float(offset[1])),
        excluded=tuple(Excluded(str(name), str(reason)) for name, reason in source["excluded"]),
        notes=tuple(map(str, source["notes"])),
        doubts=tuple(map(str, source["doubts"])),
        effects=tuple(_effect(effect) for effect in source.get("effects", [])),
        rest_angle_share=float(source.get("rest_angle_share", 0.0)),
    )


def _effect(effect: Mapping[str, Any]) -> ForceEffectValues:
    """Return an effect of a model from values of JSON; its parameters are by accelerometer."""
    return ForceEffectValues(
        name=str(effect["name"]),
        unit=str(effect["unit"]),
        parameters=tuple(map(str, effect["parameters"])),
        values=np.array(effect["values"], dtype=np.float64),
        sd=np.array(effect["sd"], dtype=np.float64),
        about=str(effect.get("about", "")),
    )


def _accelerometer(accelerometer: Mapping[str, Any], source: Mapping[str, Any]) -> AccelerometerCalibration:
    """Return one accelerometer of ``source`` from values of JSON, as ``_accelerometer_object`` made them."""
    noise = None
    if accelerometer["noise"] is not None:
        arw, instability, walk, instability_below, walk_below = map(float, accelerometer["noise"])
        noise = NoiseFound(NoiseModel(arw, instability, walk), instability_below, walk_below)
    arrays = ("p", "j", "k_axis", "states", "covariance", "place_m", "place_covariance_m2")
    return AccelerometerCalibration(
        name=str(accelerometer["name"]),
        source=str(source["source"]),
        device=str(source["device"]),
        noise_mps2=float(accelerometer["noise_mps2"]),
        budget=tuple(Contribution(str(name), np.array(c, dtype=np.float64)) for name, c in accelerometer["budget"]),
        noise=noise,
        **{key: np.array(accelerometer[key], dtype=np.float64) for key in arrays},
    )
