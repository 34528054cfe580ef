"""The recordings of a folder in the terminal: one line each, and below it the states that have moved."""

from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from station.render.terminal import Shown
from station.views.figures import OUTCOME_STYLES

_MOST_MOVES = 2  # named


def recordings_shown(recordings: Sequence[Mapping[str, Any]], console: Console) -> list[Shown]:
    """Return the table of recordings and a line for each that moved; ``recordings`` are rows of ``station history
    --json``.

    Script and bench get a column if they differ. The bench is left out if the table would be too wide.
    """
    columns = ["when", "device", "outcome"]
    read = [row for row in recordings if not row["wrong"]]
    columns += [name for name in ("script", "bench") if len({row[name] for row in read}) > 1]
    columns.append("file")
    if "bench" in columns and _width(_table(columns, recordings), console) > console.width:
        columns.remove("bench")
    moved = [(_moved(row), {"highlight": False}) for row in recordings if row["moved"]]
    return [(_table(columns, recordings), {}), *moved]


def _table(columns: Sequence[str], recordings: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, padding=(0, 2, 0, 0), pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for row in recordings:
        table.add_row(*(_outcome(row) if name == "outcome" else escape(str(row[name])) for name in columns))
    return table


def _outcome(row: Mapping[str, Any]) -> str:
    if row["wrong"]:
        return "[red]UNREADABLE[/]"
    style = OUTCOME_STYLES.get(row["outcome"], "none")
    mark = " [yellow]![/]" if row["moved"] else ""
    return f"[{style}]{escape(row['outcome']) or '-'}[/]{mark}"


def _moved(row: Mapping[str, Any]) -> str:
    """Return in a line which states of a recording moved, in sigmas of both runs."""
    moves = row["moved"]
    parts = [f"{move['state'].partition('_r')[0]} of {move['gyro']} {move['sigmas']:+.1f}" for move in moves]
    more = f" and {len(moves) - _MOST_MOVES} more" if len(moves) > _MOST_MOVES else ""
    return f"[yellow]![/] {escape(row['file'])} moved: {escape(', '.join(parts[:_MOST_MOVES]))}{more} (combined sigmas)"


def _width(table: Table, console: Console) -> int:
    return console.measure(table, options=console.options.update(width=10_000)).maximum
