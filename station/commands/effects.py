"""station effects: what an investigation looks for."""

import argparse
import json
from dataclasses import asdict, replace
from typing import Any

from rich.markup import escape

from estimator.effects.catalogue import everything
from estimator.effects.constructed import readable as words
from estimator.effects.effect import Effect, Kind
from station.render.terminal import rich_table, stdout
from station.run.outcome import Outcome
from station.views.figures import human


def command_effects(arguments: argparse.Namespace) -> int:
    """Print the catalogue of effects; always 0."""
    listed = [_object(effect) for effect in everything()]
    if arguments.json:
        print(json.dumps(listed))
        return Outcome.PASS.exit_code
    heads = ("effect", "parameters, up to", "shown by", "looks like")
    table = rich_table("Effects that an investigation looks for", heads, fold=True)
    for one in listed:
        kind = "" if one["kind"] == Kind.LAW else f"\n[dim]{one['kind']}[/]"
        shared = "\n[dim]shared by all gyros[/]" if one["shared"] else ""
        needs = f"; needs {' and '.join(one['needs'])}" if one["needs"] else ""
        table.add_row(
            escape(words(one["effect"])) + kind + shared,
            escape("\n".join(_parameters(one))),
            escape(one["shown_by"] + needs),
            escape(", ".join(map(words, one["confused_with"]))),
        )
        table.add_section()
    stdout().print(table)
    return Outcome.PASS.exit_code


def _parameters(one: dict[str, Any]) -> list[str]:
    largest = [(p["largest"], p["unit"]) for p in one["parameters"]]
    sizes = ["all of it" if (size, unit) == (1, "1") else human(size, 0.0, unit) for size, unit in largest]
    lines = [f"{p['name']} {size}" for p, size in zip(one["parameters"], sizes, strict=True)]
    if len(lines) > 2 and len(set(sizes)) == 1:
        lines = [f"{len(lines)} of {sizes[0]} each"]
    if one["non_linear"]:
        lines.append(", ".join(free["name"] for free in one["non_linear"]) + ": found from the data")
    return lines


def _object(effect: Effect) -> dict[str, Any]:
    """Return an effect as --json prints it, names of parameters without the value of what is looked for."""
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
