"""The recordings of a folder in the terminal: one line each, and below it the states that have moved."""

from collections.abc import Callable, Mapping, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from station.render.archive.moved import moved_in
from station.render.terminal import Shown, line
from station.views.figures import OUTCOME_STYLES
from station.views.history import HistoryRow

_ANY_WIDTH = 10_000
_TEXTS: Mapping[str, Callable[[HistoryRow], str]] = {
    "when": lambda row: row.when,
    "device": lambda row: row.device,
    "script": lambda row: row.script,
    "bench": lambda row: row.bench,
    "file": lambda row: row.file,
}
"""The plain text of a row, by the name of the column."""


def recordings_shown(recordings: Sequence[HistoryRow], console: Console) -> list[Shown]:
    """Return the table of recordings and a line for each that moved.

    The columns are time, device, outcome and file. Script and bench get one before the file if they differ among those
    that could be read. The bench is left out if the table would be too wide for ``console``.
    """
    columns = ["when", "device", "outcome"]
    read = [row for row in recordings if not row.wrong]
    columns += [name for name in ("script", "bench") if len({_TEXTS[name](row) for row in read}) > 1]
    columns.append("file")
    if "bench" in columns and _width(_table(columns, recordings), console) > console.width:
        columns.remove("bench")
    moved = [line(moved_in(row.file, row.moved)) for row in recordings if row.moved]
    return [(_table(columns, recordings), {}), *moved]


def _table(columns: Sequence[str], recordings: Sequence[HistoryRow]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 2, 0, 0), pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in recordings:
        table.add_row(*(_outcome(row) if name == "outcome" else escape(_TEXTS[name](row)) for name in columns))
    return table


def _outcome(row: HistoryRow) -> str:
    if row.wrong:
        return "[red]UNREADABLE[/]"
    style = OUTCOME_STYLES.get(row.outcome, "none")
    mark = " [yellow]![/]" if row.moved else ""
    return f"[{style}]{escape(row.outcome) or '-'}[/]{mark}"


def _width(table: Table, console: Console) -> int:
    return console.measure(table, options=console.options.update(width=_ANY_WIDTH)).maximum
