"""What a person sees in the terminal, from templates: lines with the markup of rich, and tables."""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

from markupsafe import Markup
from rich.console import Console, RenderableType
from rich.markup import escape

from station.render.rich_table import rich_table
from station.render.template import rendered

_PIPE_WIDTH = 120
Shown: TypeAlias = tuple[RenderableType, dict[str, Any]]
"""A line or a table, and how Console.print is to print it."""


def stdout() -> Console:
    """Return the console for results; a pipe has no width of its own, and a table of 80 columns loses its numbers."""
    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)


def print_rendered(console: Console, package: str, name: str, values: Mapping[str, Any]) -> None:
    """Print a template line by line, see ``shown_of``."""
    print_all(console, shown_of(package, name, values))


def print_all(console: Console, shown: Iterable[Shown]) -> None:
    """Print lines and tables."""
    for what, how in shown:
        console.print(what, **how)


def shown_of(package: str, name: str, values: Mapping[str, Any]) -> list[Shown]:
    """Return lines and tables of a template. ``table`` in it begins a ``rich_table``, ``show`` has it where it stands.

    Of a text ``show`` takes what Console.print takes, for instance soft_wrap. What goes into tables is markup: in it
    ``escape`` is for names.
    """
    shown: list[Shown] = []

    def show(what: RenderableType, **how: Any) -> Markup:
        shown.append((what, how))
        return Markup(f"\0{len(shown) - 1}")

    lines = rendered(package, name, {"table": rich_table, "escape": escape, "show": show, **values}).splitlines()
    return [shown[int(line[1:])] if line.startswith("\0") else (line, {"highlight": False}) for line in lines]
