"""Tables of the four states by gyro: the states with their sigmas, and their change since an earlier calibration."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from rich.text import Text

from station.run.snapshot import AccelerometerSnapshot, GyroSnapshot
from station.screen.panes.lines import TITLE, joined, line, padded
from station.views.figures import StateUnit, number

_HEAD_ROWS = 2
_RED, _YELLOW, _BOLD, _DIM = "bold red", "yellow", "bold", "dim"


@dataclass(kw_only=True, frozen=True, slots=True)
class StateCell:
    """A figure in the table of states: gyro and state by number, and whether it is the sigma of the state."""

    gyro: int | None
    state: int | None
    of_sigma: bool


@dataclass(kw_only=True, frozen=True, slots=True)
class StatesView:
    """The states of gyros or accelerometers with their sigmas, in the units of ``figures``.

    ``exceeded`` are figures beyond a limit. ``with_nis``: with the NIS of each. ``kind`` heads the column of names.
    """

    figures: Sequence[StateUnit]
    gyros: Sequence[GyroSnapshot | AccelerometerSnapshot]
    kind: str = "gyro"
    exceeded: frozenset[StateCell] = frozenset()
    with_nis: bool = False


def state_lines(view: StatesView) -> list[Text]:
    """Return two lines of headings, and one for each gyro; figures beyond a limit are red.

    Names that two sources have are preceded by that of the source. The NIS comes last if the view is ``with_nis``.
    """
    heads = _headings(view.figures, "±", view.kind)
    times = Counter(gyro.name for gyro in view.gyros)
    names = [gyro.name if times[gyro.name] < 2 else gyro.full_name for gyro in view.gyros]
    rows = [*heads, *([name, *_state_cells(gyro, view.figures)] for name, gyro in zip(names, view.gyros, strict=True))]
    if view.with_nis:
        nis = [number(gyro.nis, 2).rjust(4) for gyro in view.gyros]
        rows = [[*row, cell] for row, cell in zip(rows, ["NIS", "", *nis], strict=True)]
    return [_styled(cells, row - _HEAD_ROWS, view.exceeded) for row, cells in enumerate(padded(rows))]


def _headings(figures: Sequence[StateUnit], sigma_head: str, kind: str = "gyro") -> list[list[str]]:
    """Return the rows of names and units, with a pair of columns for each state."""
    names = chain.from_iterable((figure.name, sigma_head) for figure in figures)
    units = chain.from_iterable((figure.unit, "") for figure in figures)
    return [[kind, *names], ["", *units]]


def _state_cells(gyro: GyroSnapshot | AccelerometerSnapshot, figures: Sequence[StateUnit]) -> list[str]:
    cells = []
    for figure, value, sd in zip(figures, gyro.values, gyro.sds, strict=False):
        cells.append(figure.text(value).rjust(figure.width))
        cells.append(figure.text(sd).rjust(figure.width - 1))
    return cells


def _styled(cells: Sequence[str], gyro: int, exceeded: frozenset[StateCell]) -> Text:
    """Return the line of gyro number ``gyro``, exceeded states and sigmas in red; a heading if the number is negative.

    ``cells`` are its name, the value and the sigma of each state in turn, and any further ones.
    """
    if gyro < 0:
        return Text(" ").join(Text(cell, _BOLD) for cell in cells)
    shown = [Text(cells[0])]
    for column, cell in enumerate(cells[1:]):
        place = StateCell(gyro=gyro, state=column // 2, of_sigma=column % 2 == 1)
        shown.append(Text(cell, _RED if place in exceeded else ""))
    return Text(" ").join(shown)


@dataclass(kw_only=True, frozen=True, slots=True)
class ChangeView:
    """The change of a calibration since the last comparable one.

    ``since`` names that one, empty if there is none; then ``comparable`` says whether there could be one. ``before``
    are the gyros of that calibration, ``moved`` the full names of gyros that changed by more than chance explains.
    """

    figures: Sequence[StateUnit]
    gyros: Sequence[GyroSnapshot]
    comparable: bool
    failed: bool
    since: str = ""
    before: Sequence[GyroSnapshot] = ()
    moved: frozenset[str] = frozenset()


def change_text(view: ChangeView) -> Text:
    """Return the change of each state with its size in combined sigmas, or why there is none."""
    title = "Change since the last comparable calibration"
    if not view.since:
        return joined([line((title, TITLE)), line((_why_no_change(view), _DIM))])
    return joined([line((f"{title}, {view.since}", TITLE)), *_change_lines(view), *_remarks(view)])


def _why_no_change(view: ChangeView) -> str:
    if not view.comparable:
        return "not compared: this needs a serial number and a completed run"
    return "none in this folder: it needs the same serial number, bench, script and gyros, and no FAIL"


def _change_lines(view: ChangeView) -> list[Text]:
    """Return two lines of headings, and one for each gyro that both calibrations have; yellow if it moved."""
    rows = _headings(view.figures, "sigmas")
    styles = [_BOLD] * len(rows)
    for new in view.gyros:
        for old in view.before:
            if (old.source, old.name) == (new.source, new.name):
                rows.append(_change_row(old, new, view.figures))
                styles.append(_YELLOW if new.full_name in view.moved else "")
    return [line((" ".join(cells), style)) for cells, style in zip(padded(rows), styles, strict=True)]


def _change_row(old: GyroSnapshot, new: GyroSnapshot, figures: Sequence[StateUnit]) -> list[str]:
    """Return nine cells: the name of a gyro and, for each state, its change in the unit shown and in sigmas.

    The sigmas are those of the difference; the latter cell is a dash if they are 0.
    """
    cells = [new.name]
    for at, figure in enumerate(figures):
        change = new.values[at] - old.values[at]
        sigma = math.hypot(new.sds[at], old.sds[at])
        ratio = change / sigma if sigma > 0 else None
        cells += [figure.text(change, signed=True), number(ratio, 1, signed=True)]
    return cells


def _remarks(view: ChangeView) -> list[Text]:
    remarks = []
    if any(new.full_name in view.moved for new in view.gyros):
        remarks.append(line(("yellow: a state changed by more than the combined sigmas explain", _DIM)))
    if view.failed:
        remarks.append(line(("this run is a FAIL, so the change may not be real", _YELLOW)))
    return remarks
