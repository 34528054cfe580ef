"""The recordings of a folder as comma-separated values, for spreadsheets."""

from collections.abc import Callable, Mapping, Sequence

from estimator.geometry.model import STATES
from station.views.history import HistoryRow, Move

_Cell = str | float | None
_FORMULAS = ("=", "+", "-", "@", "\t")
"""A spreadsheet takes a text that begins so for a formula, and computes it."""
_COLUMNS: Mapping[str, Callable[[HistoryRow], _Cell]] = {
    "when": lambda row: row.when,
    "when_utc_s": lambda row: row.when_utc_s,
    "serial": lambda row: row.serial,
    "device": lambda row: row.device,
    "bench": lambda row: row.bench,
    "script": lambda row: row.script,
    "outcome": lambda row: row.outcome,
    "reason": lambda row: row.reason,
    "operator": lambda row: row.operator,
    "accepted_by": lambda row: row.accepted_by,
    "accepted_utc": lambda row: row.accepted_utc,
    "file": lambda row: row.file,
    "wrong": lambda row: row.wrong,
}


def csv_text(recordings: Sequence[HistoryRow]) -> str:
    """Return a line of headings and one for each recording, with the states of every gyro that any of them has."""
    names = list(dict.fromkeys(gyro.name for row in recordings for gyro in row.gyros))
    lines = [_heads(names), *(_line(row, names) for row in recordings)]
    return "".join(f"{','.join(cells)}\n" for cells in lines)


def _heads(names: Sequence[str]) -> list[str]:
    heads = [*_COLUMNS, "moved"]
    for name in names:
        for state in STATES:
            heads += _pair(f"{name} {state}", f"{name} sd {state}")
    return heads


def _line(row: HistoryRow, names: Sequence[str]) -> list[str]:
    """Return the quoted cells of a recording: its facts, what moved, and value and sd of each state of gyros ``names``.

    States that moved share one cell, separated by "; ". Facts and values that are not known are quoted empty texts;
    the two cells of each state of a gyro that the recording does not have are empty without quotation marks.
    """
    cells = [_quoted(value(row)) for value in _COLUMNS.values()]
    cells.append(_quoted("; ".join(map(_move, row.moved))))
    gyros = {gyro.name: gyro for gyro in row.gyros}
    for name in names:
        gyro = gyros.get(name)
        for state in STATES:
            cells += ("", "") if gyro is None else _pair(gyro.values[state], gyro.sds[state])
    return cells


def _pair(value: _Cell, sd: _Cell) -> tuple[str, str]:
    return _quoted(value), _quoted(sd)


def _move(move: Move) -> str:
    return f"{move.state} of {move.gyro} {move.sigmas:+.1f} sigmas"


def _quoted(value: _Cell) -> str:
    """Return a value in quotation marks; a text that is like a formula begins with an apostrophe."""
    text = "" if value is None else str(value)
    if isinstance(value, str) and value.startswith(_FORMULAS):
        text = f"'{text}"
    doubled = text.replace('"', '""')
    return f'"{doubled}"'
