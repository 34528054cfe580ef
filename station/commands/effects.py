"""station effects: the effects that an investigation searches for."""

import argparse
import json

from estimator.effects.catalogue import everything
from station.render.catalogues import print_effects
from station.run.outcome import Outcome
from station.views.effects import effect_view
from station.views.json_values import json_object


def command_effects(arguments: argparse.Namespace) -> int:
    """Print the catalogue of effects, or the same as JSON; return 0."""
    effects = [effect_view(effect) for effect in everything()]
    if arguments.json:
        print(json.dumps(json_object(effects)))
    else:
        print_effects(effects)
    return Outcome.PASS.exit_code
