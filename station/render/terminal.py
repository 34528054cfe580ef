"""What a person sees in the terminal, from templates: lines with the markup of rich, and tables."""

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup
from rich.console import Console, RenderableType
from rich.markup import escape

from station.render.rich_table import rich_table
from station.render.template import rendered

_PIPE_WIDTH = 120


def stdout() -> Console:
    """Return the console for results; a pipe has no width of its own, and a table of 80 columns loses its numbers."""
    console = Console()
    return console if console.is_terminal else Console(width=_PIPE_WIDTH)


def print_rendered(console: Console, package: str, name: str, values: Mapping[str, Any]) -> None:
    """Print a template line by line. ``table`` in it begins a ``rich_table``, ``show`` prints one where it stands.

    Of a text ``show`` takes what Console.print takes, for instance soft_wrap. What goes into tables is markup: in it
    ``escape`` is for names.
    """
    shown: list[tuple[RenderableType, dict[str, Any]]] = []

    def show(what: RenderableType, **how: Any) -> Markup:
        shown.append((what, how))
        return Markup(f"\0{len(shown) - 1}")

    for line in rendered(package, name, {"table": rich_table, "escape": escape, "show": show, **values}).splitlines():
        what, how = shown[int(line[1:])] if line.startswith("\0") else (line, {"highlight": False})
        console.print(what, **how)
