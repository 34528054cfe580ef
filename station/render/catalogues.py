"""What the station knows, in tables: effects that an investigation looks for, formats of exports."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

from estimator.effects.constructed import readable
from estimator.effects.effect import Kind
from station.render.terminal import print_all, rich_table, stdout
from station.views.effects import EffectView, ParameterView
from station.views.figures import human

_MOST_SIZES = 2
"""More parameters of one size than these are told together."""


@dataclass(kw_only=True, frozen=True, slots=True)
class FormatView:
    """A format of ``station export``: what a file in it holds, and what of the calibration it lacks."""

    name: str
    holds: str
    lacks: str


def print_effects(effects: Sequence[EffectView]) -> None:
    """Print the catalogue of effects."""
    heads = ["effect", "parameters, up to", "shown by", "looks like"]
    table = rich_table("Effects that an investigation looks for", heads, fold=True)
    for effect in effects:
        _add_effect(table, effect)
    print_all(stdout(), [(table, {})])


def print_formats(formats: Sequence[FormatView]) -> None:
    """Print what each format of an export holds and lacks."""
    rows = [[escape(one.name), escape(one.holds), escape(one.lacks)] for one in formats]
    table = rich_table("Formats of station export", ["--format", "holds", "lacks"], rows=rows, fold=True)
    print_all(stdout(), [(table, {})])


def _add_effect(table: Table, effect: EffectView) -> None:
    """Add the row of an effect: name, parameters, what shows it and what that needs, and similar effects."""
    needs = f"; needs {' and '.join(effect.needs)}" if effect.needs else ""
    table.add_row(
        _name(effect),
        escape("\n".join(_parameters(effect))),
        escape(f"{effect.shown_by}{needs}"),
        escape(", ".join(map(readable, effect.confused_with))),
        end_section=True,
    )


def _name(effect: EffectView) -> str:
    """Return the name of an effect, below it its kind unless it is a law of the rate, and whether gyros share it."""
    lines = [escape(readable(effect.effect))]
    if effect.kind != Kind.LAW:
        lines.append(f"[dim]{effect.kind}[/]")
    if effect.shared:
        lines.append("[dim]shared by all gyros[/]")
    return "\n".join(lines)


def _parameters(effect: EffectView) -> list[str]:
    """Return a line on each parameter with its largest size, or one on all if more than two have the same.

    A last line names the settings that are found from the data, if there are any.
    """
    sizes = [_largest(parameter) for parameter in effect.parameters]
    lines = [f"{parameter.name} {size}" for parameter, size in zip(effect.parameters, sizes, strict=True)]
    if len(sizes) > _MOST_SIZES and len(set(sizes)) == 1:
        lines = [f"{len(sizes)} of {sizes[0]} each"]
    if effect.non_linear:
        names = ", ".join(setting.name for setting in effect.non_linear)
        lines.append(f"{names}: found from the data")
    return lines


def _largest(parameter: ParameterView) -> str:
    if parameter.largest == 1 and parameter.unit == "1":
        return "complete"
    return human(parameter.largest, 0.0, parameter.unit)
