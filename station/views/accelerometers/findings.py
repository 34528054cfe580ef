"""What an investigation found of accelerometers, for JSON."""

from typing import Any

from estimator.tracing.accelerometers.trace_forces import ForceFinding, FoundEffect
from station.views.json_values import json_object


def finding_object(one: ForceFinding) -> dict[str, Any]:
    """Return what the accelerometers of one source lack, in SI."""
    found: dict[str, Any] = json_object(
        {
            "source": one.source,
            "names": one.names,
            "effects": [_effect_object(effect, one.names) for effect in one.effects],
            "suspects": dict(one.suspects),
            "dropped": one.dropped,
            "left_out": dict(one.left_out),
            "verified": one.verified,
            "error_before_mps2": one.before_mps2,
            "error_after_mps2": one.after_mps2,
        }
    )
    return found


def _effect_object(one: FoundEffect, names: tuple[str, ...]) -> dict[str, Any]:
    """Return an effect with its parameters by accelerometer."""
    return {
        "effect": one.effect.name,
        "probability": one.probability,
        "unit": one.effect.unit,
        "values": {
            name: {
                parameter: {"value": float(value), "sd": float(sd)}
                for parameter, value, sd in zip(one.effect.parameters, values, sds, strict=True)
            }
            for name, values, sds in zip(names, one.values, one.sd, strict=True)
        },
        "rivals": dict(one.rivals),
    }
