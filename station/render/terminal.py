"""What a person sees in the terminal, from templates: lines with the markup of rich, and tables."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from markupsafe import Markup
from rich.console import Console, ConsoleOptions, OverflowMethod, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table

from estimator.untrusted import harmless
from station.render.template import rendered

_PIPE_WIDTH = 120
Shown: TypeAlias = tuple[RenderableType, dict[str, Any]]
"""A line or a table, and how Console.print is to print it."""


def stdout() -> Console:
    """Return the console for results; a pipe has no width of its own, and a table of 80 columns loses its numbers."""
    console = HarmlessConsole()
    return console if console.is_terminal else HarmlessConsole(width=_PIPE_WIDTH)


class HarmlessConsole(Console):
    """A console on which names out of files cannot steer the terminal."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of what is shown; only rich's own have control characters."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(harmless(segment.text), segment.style)


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


def rich_table(
    title: str | None,
    heads: Sequence[str],
    align: str = "",
    rows: Iterable[Sequence[str]] = (),
    *,
    fold: bool = False,
    centred: bool = False,
) -> Table:
    """Return a table; ``align`` has "l" or "r" for each column, "d" for a dim "r", the last for all others.

    With ``fold`` cells are broken into lines where there is no room, not cut. ``centred`` is the title.
    """
    table = Table(title=title, title_style="bold", title_justify="center" if centred else "left")
    overflow: OverflowMethod = "fold" if fold else "ellipsis"
    for head, side in zip(heads, align.ljust(len(heads), align[-1:] or "l"), strict=True):
        style = "dim" if side == "d" else None
        table.add_column(head, justify="left" if side == "l" else "right", style=style, overflow=overflow)
    for row in rows:
        table.add_row(*row)
    return table
