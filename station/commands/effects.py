"""station effects: the effects that an investigation searches for."""

import argparse
import json
from dataclasses import asdict, replace
from typing import Any

from estimator.effects.catalogue import everything
from estimator.effects.effect import Effect, Kind
from station.render.terminal import print_rendered, stdout
from station.run.outcome import Outcome


def command_effects(arguments: argparse.Namespace) -> int:
    """Print the catalogue of effects; return 0."""
    listed = [_object(effect) for effect in everything()]
    if arguments.json:
        print(json.dumps(listed))
        return Outcome.PASS.exit_code
    print_rendered(stdout(), "station.render", "effects.rich", {"listed": listed, "law": Kind.LAW})
    return Outcome.PASS.exit_code


def _object(effect: Effect) -> dict[str, Any]:
    """Return an effect for --json; names of parameters leave out the value of a setting that is searched for."""
    record, parameters = effect.record, effect.parameters
    free = [{"name": setting.name, "unit": setting.unit} for setting in record.settings if setting.name]
    names = [p.name.split(" at ")[0] if " at " in p.name else "size" for p in parameters]
    if record.kind is not Kind.LAW or not free:
        names = [p.name for p in parameters]
    return {
        "effect": effect.name,
        "kind": str(record.kind),
        "parameters": [asdict(replace(p, name=name)) for p, name in zip(parameters, names, strict=True)],
        "non_linear": free,
        "shared": effect.shared,
        "shown_by": record.shown_by,
        "confused_with": list(effect.confused_with),
        "needs": sorted(effect.needs),
    }
