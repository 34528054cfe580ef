"""Values in the form of JSON: null for numbers that are not finite."""

import math
from collections.abc import Iterable
from dataclasses import is_dataclass
from typing import Any

from estimator.calibration.gyro import GyroCalibration
from estimator.geometry.model import STATES
from estimator.observations.allan.spectrum import TERMS
from estimator.observations.allan.terms import Term


def json_object(value: Any) -> Any:
    """Return a value with dataclasses, dicts, lists, tuples, arrays and numbers converted to JSON's types, all levels
    down.

    None for floats that are not finite; anything else is returned as it is. Keys of dicts are left as they are.
    """
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: json_object(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_object(item) for item in value]
    if hasattr(value, "tolist"):
        return json_object(value.tolist())
    if is_dataclass(value):  # dataclasses.asdict copies all that it meets, and costs four times as much
        return {name: json_object(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


def named(value: Any, names: Iterable[str]) -> dict[str, Any]:
    """Return some attributes of a value by their names."""
    return {name: getattr(value, name) for name in names}


def by_state(values: Any) -> dict[str, Any]:
    """Return values of the states (4,) by the state's name, as JSON values."""
    return dict(zip(STATES, json_object(values), strict=True))


def term_object(term: Term) -> dict[str, Any]:
    """Return a term of the noise: the likeliest value, its 95 % interval, and whether it was seen."""
    return {"value": term.value, "interval": [term.low, term.high], "seen": term.seen}


def budget_and_noise(gyro: GyroCalibration) -> dict[str, Any]:
    """Return, by "budget", "noise" and "noise_at_rest", a gyro's uncertainty budget by source and state, its noise, and
    its noise at rest, in SI.

    Either noise is None if it is unknown.
    """
    noise = gyro.noise and {
        "arw_rps_rthz": gyro.noise.mean.arw,
        "instability_rps": gyro.noise.mean.instability,
        "instability_below_rps": gyro.noise.instability_below,
        "walk_rps_rts": gyro.noise.mean.walk,
        "walk_below_rps_rts": gyro.noise.walk_below,
    }
    rest = gyro.rest and {
        "span_s": gyro.rest.span_s,
        "longest_s": gyro.rest.longest_s,
        **{name: term_object(gyro.rest.terms[name]) for name in TERMS},
    }
    budget = {line.name: by_state(line.u) for line in gyro.budget}
    return {"budget": budget, "noise": noise, "noise_at_rest": rest}
