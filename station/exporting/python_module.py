"""A Python module with the function that turns outputs of the gyros into the rate of their body, in plain Python."""

from __future__ import annotations

import re

from drivers.arrays import Floats
from estimator.compensation import Acts
from station.exporting.exported import Exported
from station.exporting.function_text import argument_names, arguments_said, cautions, function_text, tables
from station.exporting.terms import Terms, terms_of
from station.exporting.written import Written, head, number


def write_python(exported: Exported) -> Written:
    """Return the module; CompensationError for gyros that do not span space."""
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    call = "Correction().correct" if terms.keeps_state else "correct"
    what = f"{call}(...): outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s)."
    text = function_text(
        _MODULE + (_CLASS if terms.keeps_state else _FUNCTION),
        exported,
        terms,
        lambda term: term.table.upper(),
        {"axis": "AXIS", "value": "_value(lambda: ", "sign": "_sign"}
        | {name: f"self._{name}(" for name in ("follow", "last")},
        {
            "head": head(exported, what, not_held, "#"),
            "tables": [*tables(exported, terms, "# {}".format, str.upper, _table), ""],
            "docstring": _docstring(exported, terms),
        },
        names=list(exported.compensation.array.names),
        simple="_solve" if terms.of(Acts.RATE) else "_invert",
        arguments=", ".join(argument_names(terms)),
        beside="".join(f", {name}" for name in terms.given_to_the_rate),
    )
    used = [name for name in _MATH if re.search(rf"\b{name}\b", text)]
    imported = f"from math import {', '.join(used)}\n\n" if used else ""
    return Written(text.replace("from math import _\n\n", imported), tuple(not_held))


_MATH = ("cos", "exp", "expm1", "fabs", "isfinite", "isnan", "log1p", "nan", "sin", "sqrt", "tanh")


_MODULE = """
head      |$it
          |
          |from math import _
          |
          |GYROS = $names
          |
          |# A sample stamped t shows the rate at t less this, in s.
          |DELAY_S = $delay_s
          |
tables    |$it
          |
          |def $simple(left):
          |    return [sum(h * value for h, value in zip(row, left)) for row in SOLUTION]
          |
          |
law       |def _value(formula):
law       |    try:
law       |        return formula()
law       |    except (ArithmeticError, ValueError):
law       |        return nan
law       |
law       |
sign      |def _sign(x):
sign      |    return x if isnan(x) else float((x > 0.0) - (x < 0.0))
sign      |
sign      |
rate      |def _invert(left$beside):
rate      |    \"""Undo what depends on the rate itself, by iteration.\"""
rate      |    w = _solve(left)
rate      |    for _ in range($iterations):
rate      |        less = list(left)
rate      |        for i in range(len(less)):
u rate    |            u = AXIS[i][0] * w[0] + AXIS[i][1] * w[1] + AXIS[i][2] * w[2]
of rate   |            less[i] -= $it
rate      |        before, w = w, _solve(less)
rate      |        if sum(fabs(a - b) for a, b in zip(w, before)) <= $tolerance:
rate      |            return w
rate      |    return [nan, nan, nan]
rate      |
rate      |
"""
_FUNCTION = """\
          |def correct($arguments):
docstring |    $it
warmth    |    warmth = temperature_c - $reference_c
          |    left = [output + bias for output, bias in zip(rate_rps, BIAS, strict=True)]
adds      |    for i in range(len(left)):
added     |        left[i] -= $it
motion    |    w = _invert(left$passed)
motion    |    for i in range(len(left)):
u motion  |        u = AXIS[i][0] * w[0] + AXIS[i][1] * w[1] + AXIS[i][2] * w[2]
of motion |        left[i] -= $it
          |    return _invert(left$passed)
"""
_CLASS = """\
          |class Correction:
          |    \"""Keeps what is needed of the samples before; make a new one at the start and after a gap.\"""
          |
time_s    |    def __init__(self, time_s=0.0):
time_s    |        \"""``time_s``: since the gyros were switched on.\"""
time_s    |        self.time_s = time_s
no time_s |    def __init__(self):
memory    |        self.kept = [[0.0] * len(GYROS) for _ in range($places)]
          |        self.started = False
          |
          |    def correct(self, $arguments):
docstring |        $it
dt_s      |        step = dt_s if self.started and dt_s > 0.0 else 0.0
warmth    |        warmth = temperature_c - $reference_c
time_s    |        if self.started:
time_s    |            self.time_s += dt_s
time_s    |        time_s = self.time_s
slope     |        smooth = self._follow($places - 1, 0, temperature_c, $slope_s / ($slope_s + step), 1e300)
slope     |        slope = (temperature_c - smooth) / $slope_s
          |        left = [output + bias for output, bias in zip(rate_rps, BIAS, strict=True)]
bandwidth |        if step:
bandwidth |            for i in range(len(left)):
bandwidth |                change = rate_rps[i] - self.rate_rps[i]
bandwidth |                left[i] += $lag[i] * change / step if isfinite(change) else 0.0
bandwidth |        self.rate_rps = list(rate_rps)
adds      |        for i in range(len(left)):
added     |            left[i] -= $it
motion    |        w = _invert(left$passed)
wdot      |        wdot = [0.0, 0.0, 0.0]
wdot      |        for r in range(3 if step else 0):
wdot      |            change = w[r] - self.w_rps[r]
wdot      |            wdot[r] = change / step if isfinite(change) else 0.0
wdot      |        self.w_rps = w
motion    |        for i in range(len(left)):
u motion  |            u = AXIS[i][0] * w[0] + AXIS[i][1] * w[1] + AXIS[i][2] * w[2]
of motion |            left[i] -= $it
          |        self.started = True
          |        return _invert(left$passed)
follow    |
follow    |    def _follow(self, at, i, x, share, width):
follow    |        kept = self.kept[at]
follow    |        if not self.started or not isfinite(kept[i]):
follow    |            kept[i] = x
follow    |        elif isfinite(x):
follow    |            kept[i] = x + share * min(max(kept[i] - x, -width), width)
follow    |        return kept[i] if isfinite(x) else x
last      |
last      |    def _last(self, at, i, x, limit):
last      |        largest, sign = self.kept[at], self.kept[at + 1]
last      |        if isfinite(x):
last      |            largest[i] = max(largest[i], fabs(x))
last      |            if fabs(x) > (limit or $share * largest[i]):  # of its largest size so far
last      |                sign[i] = 1.0 if x > 0.0 else -1.0
last      |        return sign[i]
"""


def _table(name: str, values: Floats) -> list[str]:
    if values.ndim == 1:
        return [f"{name} = ({', '.join(map(number, values))},)"]
    return [f"{name} = (", *(f"    ({', '.join(map(number, row))})," for row in values), ")"]


def _docstring(exported: Exported, terms: Terms) -> list[str]:
    lines = [
        '"""Return the rate [x, y, z] of the body about its axes, in rad/s.',
        "",
        *(line.replace("\\", "/").replace('"""', "'''") for line in arguments_said(exported, terms)),
    ]
    if terms.of(Acts.RATE):
        lines.append("It is nan where effects of the rate cannot be undone: far beyond the rates of the calibration.")
    return [*lines, '"""']
