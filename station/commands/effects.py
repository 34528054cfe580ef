"""station effects: what an investigation looks for."""

import argparse
import json
from dataclasses import asdict, replace

from rich.markup import escape

from estimator.effects.catalogue import everything
from estimator.effects.effect import Effect, Kind, Parameter
from estimator.tracing.investigation import Value
from station.render.investigation_printed import human, words
from station.render.rich_table import rich_table
from station.render.terminal import stdout
from station.run.outcome import Outcome


def command_effects(arguments: argparse.Namespace) -> int:
    """Print the catalogue of effects; always 0."""
    listed = everything()
    if arguments.json:
        print(json.dumps([_object(effect) for effect in listed]))
        return Outcome.PASS.exit_code
    heads = ("effect", "parameters, up to", "shown by", "looks like")
    table = rich_table("Effects that an investigation looks for", heads, fold=True)
    for effect in listed:
        record = effect.record
        name = escape(words(effect.name)) + ("" if record.kind is Kind.LAW else f"\n[dim]{record.kind}[/]")
        table.add_row(
            name + ("\n[dim]shared by all gyros[/]" if effect.shared else ""),
            escape("\n".join(_parameters(effect))),
            escape(record.shown_by + _needs(effect)),
            escape(", ".join(map(words, effect.confused_with))),
        )
        table.add_section()
    stdout().print(table)
    return Outcome.PASS.exit_code


def _free(effect: Effect) -> list[tuple[str, str]]:
    """Return name and unit of what is looked for in the data beside the parameters."""
    return [(setting.name, setting.unit) for setting in effect.record.settings if setting.name]


def _sized(effect: Effect) -> list[Parameter]:
    """Return the parameters, without the value that names state of what is looked for."""
    if effect.record.kind is not Kind.LAW or not _free(effect):
        return list(effect.parameters)
    return [replace(p, name=p.name.split(" at ")[0] if " at " in p.name else "size") for p in effect.parameters]


def _parameters(effect: Effect) -> list[str]:
    lines = [f"{p.name} {_largest(p)}" for p in _sized(effect)]
    sizes = {_largest(p) for p in effect.parameters}
    if len(lines) > 2 and len(sizes) == 1:
        lines = [f"{len(lines)} of {sizes.pop()} each"]
    if _free(effect):
        lines.append(", ".join(name for name, _ in _free(effect)) + ": found from the data")
    return lines


def _largest(parameter: Parameter) -> str:
    return "all of it" if parameter.unit == "1" and parameter.largest == 1 else human(_value(parameter))


def _value(parameter: Parameter) -> Value:
    return Value(parameter.largest, 0.0, parameter.unit)


def _needs(effect: Effect) -> str:
    return f"; needs {' and '.join(sorted(effect.needs))}" if effect.needs else ""


def _object(effect: Effect) -> dict[str, object]:
    record = effect.record
    return {
        "effect": effect.name,
        "kind": str(record.kind),
        "parameters": [asdict(p) for p in _sized(effect)],
        "non_linear": [{"name": name, "unit": unit} for name, unit in _free(effect)],
        "shared": effect.shared,
        "shown_by": record.shown_by,
        "confused_with": list(effect.confused_with),
        "needs": sorted(effect.needs),
    }
