"""station effects: what an investigation looks for."""

import argparse
import json
from dataclasses import asdict

from rich.markup import escape

from estimator.effects.effect import Parameter
from estimator.effects.entries import Entry, entries
from estimator.tracing.investigation import Value
from station.render.investigation_printed import human, words
from station.render.rich_table import rich_table
from station.render.terminal import stdout
from station.run.outcome import Outcome


def command_effects(arguments: argparse.Namespace) -> int:
    """Print the catalogue of effects; always 0."""
    listed = entries()
    if arguments.json:
        print(json.dumps([_object(entry) for entry in listed]))
        return Outcome.PASS.exit_code
    heads = ("effect", "parameters, up to", "shown by", "looks like")
    table = rich_table("Effects that an investigation looks for", heads, fold=True)
    for entry in listed:
        name = escape(words(entry.name)) + ("" if entry.kind == "law" else f"\n[dim]{entry.kind}[/]")
        table.add_row(
            name + ("\n[dim]shared by all gyros[/]" if entry.shared else ""),
            escape("\n".join(_parameters(entry))),
            escape(entry.shown_by + (f"; needs {' and '.join(sorted(entry.needs))}" if entry.needs else "")),
            escape(", ".join(map(words, entry.confused_with))),
        )
        table.add_section()
    stdout().print(table)
    return Outcome.PASS.exit_code


def _parameters(entry: Entry) -> list[str]:
    lines = [f"{p.name} {_largest(p)}" for p in entry.parameters]
    sizes = {_largest(p) for p in entry.parameters}
    if len(lines) > 2 and len(sizes) == 1:
        lines = [f"{len(lines)} of {sizes.pop()} each"]
    if entry.free:
        lines.append(", ".join(name for name, _ in entry.free) + ": found from the data")
    return lines


def _largest(parameter: Parameter) -> str:
    value = Value(parameter.largest, 0.0, parameter.unit)
    return "all of it" if parameter.unit == "1" and parameter.largest == 1 else human(value)


def _object(entry: Entry) -> dict[str, object]:
    return {
        "effect": entry.name,
        "kind": str(entry.kind),
        "parameters": [asdict(p) for p in entry.parameters],
        "non_linear": [{"name": name, "unit": unit} for name, unit in entry.free],
        "shared": entry.shared,
        "shown_by": entry.shown_by,
        "confused_with": list(entry.confused_with),
        "needs": sorted(entry.needs),
    }
