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
    """Return the calibrations in a text of ``forces_text``; ValueError if it is of another version or damaged."""
    top = json.loads(text)
    if top.get("version") != VERSION:
        raise ValueError(f"version {top.get('version')} of the calibration of accelerometers")
    return tuple(_calibration(own) for own in top["sources"])


def _object(one: ForceCalibration) -> dict[str, Any]:
    """Return the calibration of a source as values of JSON."""
    return {
        "source": one.source,
        "device": one.device,
        "accelerometers": [_accelerometer_object(a) for a in one.accelerometers],
        "covariance": one.covariance.tolist(),
        "arm_m": one.arm_m.tolist(),
        "arm_covariance_m2": one.arm_covariance_m2.tolist(),
        "gravity_mps2": one.gravity_mps2,
        "gravity_from": one.gravity_from,
        "offset": None if one.offset is None else [one.offset.offset_s, one.offset.sd_s],
        "excluded": [[e.name, e.reason] for e in one.excluded],
        "notes": list(one.notes),
        "doubts": list(one.doubts),
        "effects": [_effect_object(effect) for effect in one.effects],
    }


def _effect_object(effect: ForceEffectValues) -> dict[str, Any]:
    """Return an effect of a model as values of JSON."""
    return {
        "name": effect.name,
        "unit": effect.unit,
        "parameters": list(effect.parameters),
        "values": effect.values.tolist(),
        "sd": effect.sd.tolist(),
        "about": effect.about,
    }


def _accelerometer_object(one: AccelerometerCalibration) -> dict[str, Any]:
    """Return one accelerometer as values of JSON."""
    noise = None
    if one.noise is not None:
        mean = one.noise.mean
        noise = [mean.arw, mean.instability, mean.walk, one.noise.instability_below, one.noise.walk_below]
    arrays = ("p", "j", "k_axis", "states", "covariance", "place_m", "place_covariance_m2")
    return {
        "name": one.name,
        **{key: getattr(one, key).tolist() for key in arrays},
        "noise_mps2": one.noise_mps2,
        "budget": [[line.name, line.covariance.tolist()] for line in one.budget],
        "noise": noise,
    }


def _calibration(own: Mapping[str, Any]) -> ForceCalibration:
    """Return the calibration of a source."""
    offset = own["offset"]
    return ForceCalibration(
        source=str(own["source"]),
        device=str(own["device"]),
        accelerometers=tuple(_accelerometer(a, own) for a in own["accelerometers"]),
        covariance=np.array(own["covariance"], dtype=np.float64),
        arm_m=np.array(own["arm_m"], dtype=np.float64),
        arm_covariance_m2=np.array(own["arm_covariance_m2"], dtype=np.float64),
        gravity_mps2=float(own["gravity_mps2"]),
        gravity_from=str(own["gravity_from"]),
        offset=None if offset is None else TimeOffset(float(offset[0]), float(offset[1])),
        excluded=tuple(Excluded(str(name), str(reason)) for name, reason in own["excluded"]),
        notes=tuple(map(str, own["notes"])),
        doubts=tuple(map(str, own["doubts"])),
        effects=tuple(_effect(effect) for effect in own.get("effects", [])),
    )


def _effect(own: Mapping[str, Any]) -> ForceEffectValues:
    """Return an effect of a model."""
    return ForceEffectValues(
        name=str(own["name"]),
        unit=str(own["unit"]),
        parameters=tuple(map(str, own["parameters"])),
        values=np.array(own["values"], dtype=np.float64),
        sd=np.array(own["sd"], dtype=np.float64),
        about=str(own.get("about", "")),
    )


def _accelerometer(own: Mapping[str, Any], source: Mapping[str, Any]) -> AccelerometerCalibration:
    """Return one accelerometer of a source."""
    noise = None
    if own["noise"] is not None:
        arw, instability, walk, instability_below, walk_below = map(float, own["noise"])
        noise = NoiseFound(NoiseModel(arw, instability, walk), instability_below, walk_below)
    arrays = ("p", "j", "k_axis", "states", "covariance", "place_m", "place_covariance_m2")
    return AccelerometerCalibration(
        name=str(own["name"]),
        source=str(source["source"]),
        device=str(source["device"]),
        noise_mps2=float(own["noise_mps2"]),
        budget=tuple(Contribution(str(name), np.array(c, dtype=np.float64)) for name, c in own["budget"]),
        noise=noise,
        **{key: np.array(own[key], dtype=np.float64) for key in arrays},
    )
