"""The comparison of the results with the limits of the bench."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup

from drivers.units import split_quantity
from station.report.chapters.results import badge
from station.report.document_status import Standing
from station.report.figures import ONE, PERCENT, SYMBOLS, Unit, figure, plain, stated, typographic
from station.report.tables import Content, Table, grouped_table
from station.views.limits import MEAN_NIS, SAMPLES_LOST, LimitLine

_NONE = "–"
_U = Markup("<var>u</var> found")
_LIMIT_OF_U = Markup("limit of <var>u</var>")


@dataclass(kw_only=True, frozen=True, slots=True)
class LimitsView:
    """The limits: how many there are and are not met, and each compared with what was found.

    ``false_accept`` is the stated probability of a false acceptance in percent, empty for simple acceptance.
    """

    count: int
    not_met: int
    false_accept: Markup
    table: Table


@dataclass(kw_only=True, frozen=True, slots=True)
class Quantity:
    """The quantity of a limit, its unit, and where the recording holds the value, None if nowhere."""

    name: str
    unit: Unit
    source: str | None


def limits_view(standing: Standing, false_accept: float | None) -> LimitsView | None:
    """Return all limits, and how many are not met; None if the recording states none or has no calibration.

    ``false_accept`` is the probability that sets the guard band, None for simple acceptance. A limit whose value is
    unknown is not met.
    """
    if not standing.lines:
        return None
    return LimitsView(
        count=len(standing.lines),
        not_met=sum(not line.within for line in standing.lines),
        false_accept=Markup() if false_accept is None else plain(false_accept, PERCENT, 3),
        table=_table(standing.lines, guarded=false_accept is not None),
    )


def _table(lines: Sequence[LimitLine], *, guarded: bool) -> Table:
    """Return a row for each quantity of a gyro: the comparison of its value, and that of its uncertainty.

    With ``guarded`` a column has the guarded limit, up to which values are accepted.
    """
    accepted = ["accepted up to"] if guarded else []
    heads = ["gyro", "quantity", "unit", "found", "limit", *accepted, "verdict", _U, _LIMIT_OF_U, "verdict"]
    align = "lllrrrlrrl" if guarded else "lllrrlrrl"
    groups = [
        (gyro, [_row(line, line_of_u, guarded=guarded) for line, line_of_u in quantities])
        for gyro, quantities in limits_by_gyro(lines).items()
    ]
    return grouped_table(heads, align, groups)


def _row(line: LimitLine | None, line_of_u: LimitLine | None, *, guarded: bool) -> list[Content]:
    """Return name and unit of a quantity, value, limit and verdict, then those of its u; one of the two may be None.

    With ``guarded`` there are nine cells instead of eight: how far values are accepted follows the first limit.
    """
    known = line or line_of_u
    assert known is not None
    quantity = quantity_of(known)
    accepted = [_accepted(line)] if guarded else []
    of_value = [_value(line), _limit(line), *accepted, _verdict(line)]
    return [quantity.name, quantity.unit.name, *of_value, _value(line_of_u), _limit(line_of_u), _verdict(line_of_u)]


def limits_by_gyro(lines: Sequence[LimitLine]) -> Mapping[str, list[tuple[LimitLine | None, LimitLine | None]]]:
    """Return by gyro, for each quantity, its limit and that of its standard uncertainty; None where there is none.

    Accelerometers count as gyros here, and what concerns all is by the name "all".
    """
    quantities: dict[tuple[str, str, str], dict[bool, LimitLine]] = {}
    for line in lines:
        quantities.setdefault((line.gyro, line.what, line.note), {})[line.of_u] = line
    gyros: dict[str, list[tuple[LimitLine | None, LimitLine | None]]] = {}
    for (gyro, _, _), of_quantity in quantities.items():
        gyros.setdefault(gyro, []).append((of_quantity.get(False), of_quantity.get(True)))
    return gyros


def quantity_of(line: LimitLine) -> Quantity:
    """Return name, unit and place in the recording of a limit's quantity.

    It is a state, its sigma, a state of an accelerometer, lost samples (in %), the mean NIS, or the estimate that a
    sensor lacks. Only states, sigmas and the mean NIS have a place; NIS and estimate have no unit.
    """
    if line.state is not None and line.unit is not None:
        unit = Unit(typographic(line.unit.unit), line.unit.factor)
        column = "sd" if line.of_u else "states"
        return Quantity(name=SYMBOLS[line.state], unit=unit, source=f"calibration/{column}[{line.row},{line.state}]")
    if line.unit is not None:  # of an accelerometer
        return Quantity(name=line.what, unit=Unit(typographic(line.unit.unit), line.unit.factor), source=None)
    if line.what == SAMPLES_LOST:
        return Quantity(name=line.what, unit=PERCENT, source=None)
    return Quantity(name=line.what, unit=ONE, source="calibration@nis_mean" if line.what == MEAN_NIS else None)


def _value(line: LimitLine | None) -> Content:
    if line is None:
        return _NONE
    if line.note:
        return Markup('<span class="reason">not estimated: {}</span>').format(line.note)
    quantity = quantity_of(line)
    return plain(line.value, quantity.unit, 4, quantity.source)


def _limit(line: LimitLine | None) -> Content:
    """Return a limit as ± or ≤ its upper end, else "low to high"; a dash without one.

    "estimated" for a gyro that had to be estimated but is not. An end that is infinite is "any".
    """
    if line is None:
        return _NONE
    if line.note:
        return "estimated"
    high: Content = written(line) if line.high < math.inf else "any"
    if line.low == -line.high:
        return Markup("± {}").format(high)
    if line.low == 0:
        return Markup("≤ {}").format(high)
    return Markup("{} to {}").format(stated(line.low, quantity_of(line).unit), high)


def written(line: LimitLine) -> Markup:
    """Return the upper bound of a limit as in the bench file; without its unit if that is the column's.

    What is no number with a unit there is given in the unit of the column.
    """
    unit = quantity_of(line).unit
    parsed = split_quantity(line.written)
    if parsed is None:
        return stated(line.high, unit)
    text = line.written.removesuffix(parsed[1]).rstrip() if typographic(parsed[1]) == unit.name else line.written
    return figure(line.high, unit, typographic(text))


def _accepted(line: LimitLine | None) -> Content:
    """Return up to where a value is accepted: a guard band may end that before the limit.

    "nothing" if the guard band leaves nothing, "the limit" if there is no guard band; a dash without a limit or a
    value.
    """
    if line is None or line.note:
        return _NONE
    if line.guard == math.inf:
        return "nothing"
    if not line.guard:
        return "the limit"
    return Markup("± {}").format(plain(line.high - line.guard, quantity_of(line).unit, 4))


def _verdict(line: LimitLine | None) -> Content:
    if line is None:
        return ""
    return badge("PASS" if line.within else "FAIL")
