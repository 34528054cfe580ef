"""What an investigation found of accelerometers, for JSON."""

from typing import Any

from estimator.tracing.accelerometers.trace_forces import ForceFinding, FoundEffect
from station.views.json_values import json_object


def finding_object(finding: ForceFinding) -> dict[str, Any]:
    """Return for JSON what the model of the accelerometers of one source lacks, in SI: effects, suspects, errors.

    With them are the effects that were dropped, recordings that were left out with the reasons, and whether there were
    verification runs. Errors are rms of each accelerometer before and after, null if not finite.
    """
    found: dict[str, Any] = json_object(
        {
            "source": finding.source,
            "names": finding.names,
            "effects": [_effect_object(effect, finding.names) for effect in finding.effects],
            "suspects": dict(finding.suspects),
            "dropped": finding.dropped,
            "left_out": dict(finding.left_out),
            "verified": finding.verified,
            "error_before_mps2": finding.before_mps2,
            "error_after_mps2": finding.after_mps2,
        }
    )
    return found


def _effect_object(effect: FoundEffect, names: tuple[str, ...]) -> dict[str, Any]:
    """Return an effect with its probability, its unit in SI, its parameters by accelerometer, and its rivals.

    ``names`` are the accelerometers in the order of the effect's rows; each parameter has a value and a sigma.
    """
    return {
        "effect": effect.effect.name,
        "probability": effect.probability,
        "unit": effect.effect.unit,
        "values": {
            name: {
                parameter: {"value": float(value), "sd": float(sd)}
                for parameter, value, sd in zip(effect.effect.parameters, values, sds, strict=True)
            }
            for name, values, sds in zip(names, effect.values, effect.sd, strict=True)
        },
        "rivals": dict(effect.rivals),
    }
