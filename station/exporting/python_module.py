"""A Python module with the function that turns outputs of the gyros into the rate of their body, in plain Python."""

from __future__ import annotations

from drivers.arrays import Floats
from estimator.compensation import MOST_ITERATIONS, SLOPE_S, TOLERANCE_RPS
from estimator.effects.thermal import REFERENCE_C
from station.exporting.exported import Exported
from station.exporting.function_text import argument_names, arguments_said, cautions
from station.exporting.terms import Terms, terms_of
from station.exporting.written import Written, head, number


def write_python(exported: Exported) -> Written:
    """Return the module; CompensationError for gyros that do not span space."""
    solution = exported.compensation.solution
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    call = "Correction().correct" if terms.keeps_state else "correct"
    what = f"{call}(...): outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s)."
    functions = ["expm1"] if terms.uses("expm1(") else []
    functions += ["fabs"] if terms.of_the_rate else []
    functions += ["isfinite"] if terms.lag is not None or terms.of_acceleration is not None else []
    functions += ["isnan"] if terms.uses("slope") else []
    functions += ["nan"] if terms.of_the_rate else []
    lines = [
        *head(exported, what, not_held, "#"),
        "",
        *([f"from math import {', '.join(functions)}", ""] if functions else []),
        f"GYROS = {list(exported.compensation.array.names)!r}",
        "",
        "# A sample stamped t shows the rate at t less this, in s.",
        f"DELAY_S = {number(exported.compensation.delay_s)}",
        "",
        *_tables(exported, terms, solution),
        *_inverse(terms),
        *(_class(exported, terms) if terms.keeps_state else _function(exported, terms)),
    ]
    return Written("\n".join(lines) + "\n", tuple(not_held))


def _tables(exported: Exported, terms: Terms, solution: Floats) -> list[str]:
    lines = [
        "# Body rate per output: the inverse of the sensitivity, rows x, y, z.",
        *_table("SOLUTION", solution),
        "# Biases, to be added to the outputs, in rad/s.",
        *_table("BIAS", exported.compensation.bias_rps),
    ]
    if terms.of_the_rate:
        lines += ["# Nominal sense axes.", *_table("AXIS", exported.compensation.array.p)]
    for term in terms.all:
        lines += [f"# {term.effect.replace('_', ' ')}: {term.unit}", *_table(term.table.upper(), term.values)]
    return [*lines, ""]


def _table(name: str, values: Floats) -> list[str]:
    if values.ndim == 1:
        return [f"{name} = ({', '.join(map(number, values))},)"]
    return [f"{name} = (", *(f"    ({', '.join(map(number, row))})," for row in values), ")"]


def _inverse(terms: Terms) -> list[str]:
    name = "_solve" if terms.of_the_rate else "_invert"
    lines = [
        "",
        f"def {name}(left):",
        "    return [sum(h * value for h, value in zip(row, left)) for row in SOLUTION]",
        "",
    ]
    if not terms.of_the_rate:
        return [*lines, ""]
    return [
        *lines,
        "",
        f"def _invert(left{_warmth_given(terms)}):",
        '    """Undo what depends on the rate itself, by iteration."""',
        "    w = _solve(left)",
        f"    for _ in range({MOST_ITERATIONS}):",
        "        less = list(left)",
        "        for i in range(len(less)):",
        "            u = AXIS[i][0] * w[0] + AXIS[i][1] * w[1] + AXIS[i][2] * w[2]",
        *(f"            less[i] -= {term.written(term.table.upper())}" for term in terms.of_the_rate),
        "        before, w = w, _solve(less)",
        f"        if sum(fabs(a - b) for a, b in zip(w, before)) <= {number(TOLERANCE_RPS)}:",
        "            return w",
        "    return [nan, nan, nan]",
        "",
        "",
    ]


def _docstring(exported: Exported, terms: Terms, indent: str) -> list[str]:
    lines = [
        '"""Return the rate [x, y, z] of the body about its axes, in rad/s.',
        "",
        *(line.replace("\\", "/").replace('"""', "'''") for line in arguments_said(exported, terms)),
    ]
    if terms.of_the_rate:
        lines.append("It is nan where effects of the rate cannot be undone: far beyond the rates of the calibration.")
    return [f"{indent}{line}".rstrip() for line in [*lines, '"""']]


def _function(exported: Exported, terms: Terms) -> list[str]:
    warmth = ["    warmth = temperature_c - " + number(REFERENCE_C)] if terms.uses("warmth") else []
    return [
        f"def correct({', '.join(argument_names(terms))}):",
        *_docstring(exported, terms, "    "),
        *warmth,
        "    left = [output + bias for output, bias in zip(rate_rps, BIAS, strict=True)]",
        *_added(terms, "    "),
        f"    return _invert(left{_warmth_given(terms)})",
    ]


def _added(terms: Terms, indent: str) -> list[str]:
    if not terms.added:
        return []
    return [
        f"{indent}for i in range(len(left)):",
        *(f"{indent}    left[i] -= {term.written(term.table.upper())}" for term in terms.added),
    ]


def _warmth_given(terms: Terms) -> str:
    return ", warmth" if terms.warms_the_rate else ""


def _class(exported: Exported, terms: Terms) -> list[str]:
    lines = [
        "class Correction:",
        '    """Keeps what is needed of the samples before; make a new one at the start and after a gap."""',
        "",
    ]
    if terms.uses("time_s"):
        lines += [
            "    def __init__(self, time_s=0.0):",
            '        """``time_s``: since the gyros were switched on."""',
            "        self.time_s = time_s",
        ]
    else:
        lines.append("    def __init__(self):")
    lines.append("        self.started = False")
    lines += [
        "",
        f"    def correct({', '.join(['self', *argument_names(terms)])}):",
        *_docstring(exported, terms, "        "),
        "        step = dt_s if self.started and dt_s > 0.0 else 0.0",
    ]
    if terms.uses("warmth"):
        lines.append(f"        warmth = temperature_c - {number(REFERENCE_C)}")
    if terms.uses("time_s"):
        lines += ["        if self.started:", "            self.time_s += dt_s", "        time_s = self.time_s"]
    if terms.uses("slope"):
        lines += [
            "        if not self.started or isnan(self.smooth_c):",
            "            self.smooth_c = temperature_c",
            "        elif not isnan(temperature_c):",
            f"            self.smooth_c += (temperature_c - self.smooth_c) * step / ({number(SLOPE_S)} + step)",
            f"        slope = (temperature_c - self.smooth_c) / {number(SLOPE_S)}",
        ]
    lines.append("        left = [output + bias for output, bias in zip(rate_rps, BIAS, strict=True)]")
    if terms.lag is not None:
        table = terms.lag.table.upper()
        lines += [
            "        if step:",
            "            for i in range(len(left)):",
            "                change = rate_rps[i] - self.rate_rps[i]",
            f"                left[i] += {table}[i] * change / step if isfinite(change) else 0.0",
            "        self.rate_rps = list(rate_rps)",
        ]
    lines += _added(terms, "        ")
    if terms.of_acceleration is not None:
        lines += [
            f"        w = _invert(left{_warmth_given(terms)})",
            "        wdot = [0.0, 0.0, 0.0]",
            "        for r in range(3 if step else 0):",
            "            change = w[r] - self.w_rps[r]",
            "            wdot[r] = change / step if isfinite(change) else 0.0",
            "        self.w_rps = w",
            "        for i in range(len(left)):",
            f"            left[i] -= {terms.of_acceleration.written(terms.of_acceleration.table.upper())}",
        ]
    return [*lines, "        self.started = True", f"        return _invert(left{_warmth_given(terms)})"]
