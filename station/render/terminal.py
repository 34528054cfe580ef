"""Output to the terminal: lines with the markup of rich, and tables."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, TypeAlias

from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, OverflowMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Column, Table
from rich.text import Text, TextType

from estimator.untrusted import harmless
from station.render.lines import LINE_WIDTH, glued, unglued
from station.render.template import rendered

_PIPE_WIDTH = 120
_ANY_WIDTH = 10_000
_DIM = "dim"
Shown: TypeAlias = tuple[RenderableType, dict[str, Any]]
"""A line or a table, and how Console.print is to print it."""


def line(markup: str) -> Shown:
    """Return a line of markup, in which names must have gone through ``escape``; its figures are not coloured."""
    return markup, {"highlight": False}


def title(text: str) -> Shown:
    """Return a line of plain text above a table that has no title itself."""
    return text, {"style": "bold", "highlight": False, "markup": False}


def unbroken(text: str) -> Shown:
    """Return a line of plain text, such as a command or a path, that is not broken between words."""
    return text, {"highlight": False, "markup": False, "soft_wrap": True}


def stdout() -> Console:
    """Return the console for results; a pipe has no width of its own, and a table of 80 columns loses its numbers."""
    console = HarmlessConsole()
    return console if console.is_terminal else HarmlessConsole(width=_PIPE_WIDTH)


class HarmlessConsole(Console):
    """A console on which control characters in names from files have no effect."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a renderable; only rich's own may have control characters."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(harmless(segment.text), segment.style)


def print_all(console: Console, shown: Iterable[Shown]) -> None:
    """Print lines and tables; lines are broken at 80 columns, but never between a figure and its unit.

    A line with ``soft_wrap`` or ``no_wrap`` is left as it is.
    """
    for item, how in shown:
        if isinstance(item, str) and not how.keys() & {"soft_wrap", "no_wrap"}:
            for part in _wrapped(item, console, markup=how.get("markup", True)):
                console.print(part, **{key: value for key, value in how.items() if key != "markup"})
        else:
            console.print(item, **how)


def _wrapped(item: str, console: Console, *, markup: bool) -> list[Text]:
    """Return a line broken to fit the console and 80 columns, without trailing spaces.

    ``item`` is read as rich's markup if ``markup`` is set.
    """
    text = Text.from_markup(item, emoji=False) if markup else Text(item)
    text.plain = glued(text.plain)
    broken = list(text.wrap(console, min(console.width, LINE_WIDTH))) or [text]
    for part in broken:
        part.rstrip()
        part.plain = unglued(part.plain)
    return broken


def template_lines(package: str, name: str, values: Mapping[str, Any]) -> list[Shown]:
    """Return the lines of a template with the markup of rich; values are escaped."""
    return [line(text) for text in rendered(package, name, values).splitlines()]


class FittingTable(Table):
    """A table that a narrow console shows in parts below each other, each with the names on the left.

    No figure is cut, and dim columns stay with the column before. Columns that fold are left to fold.
    """

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield the table if it fits the console or has a column that folds, else its parts."""
        if self._fits(self, console, options) or any(column.overflow == "fold" for column in self.columns):
            yield from super().__rich_console__(console, options)
        else:
            for part in self._parts(console, options):
                yield from part.__rich_console__(console, options)

    def _parts(self, console: Console, options: ConsoleOptions) -> Iterator[Table]:
        """Yield the table as parts that fit the console, each with the leading columns that are aligned left.

        Only the first part has the title. A part has at least one further column, and its dim ones, even if it is then
        too wide.
        """
        names = next((n for n, column in enumerate(self.columns) if column.justify != "left"), 1)
        shown, title = list(self.columns[:names]), self.title
        for column in self.columns[names:]:
            together = [*shown, column]
            if column.style == _DIM or len(shown) == names or self._fits(self._part(together, title), console, options):
                shown = together
            else:
                yield self._part(shown, title)
                shown, title = [*self.columns[:names], column], None
        yield self._part(shown, title)

    def _part(self, columns: Sequence[Column], title: TextType | None) -> Table:
        part = Table(title=title, title_style="bold", title_justify=self.title_justify)
        for column in columns:
            part.add_column(column.header, justify=column.justify, style=column.style, overflow=column.overflow)
        for row in zip(*(column.cells for column in columns), strict=True):
            part.add_row(*row)
        return part

    @staticmethod
    def _fits(table: Table, console: Console, options: ConsoleOptions) -> bool:
        return Measurement.get(console, options.update(width=_ANY_WIDTH), table).maximum <= options.max_width


def rich_table(
    title: str | None,
    heads: Sequence[str],
    align: str = "",
    rows: Iterable[Sequence[str]] = (),
    *,
    fold: bool = False,
    centred: bool = False,
    frameless: bool = False,
) -> Table:
    """Return a table; ``align`` has "l" or "r" for each column, "d" for a dim "r", the last letter for all others.

    With ``fold`` long cells are broken into lines instead of cut. ``centred`` is about the title. A ``frameless`` table
    has only a line below its heads.
    """
    table = FittingTable(title=title, title_style="bold", title_justify="center" if centred else "left")
    if frameless:
        table.box = SIMPLE_HEAD
        table.show_edge = False
        table.pad_edge = False
    overflow: OverflowMethod = "fold" if fold else "ellipsis"
    for head, side in zip(heads, align.ljust(len(heads), align[-1:] or "l"), strict=True):
        style = _DIM if side == "d" else None
        table.add_column(head, justify="left" if side == "l" else "right", style=style, overflow=overflow)
    for row in rows:
        table.add_row(*row)
    return table
