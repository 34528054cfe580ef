"""A Python module with the function that turns outputs of the gyros into the rate of their body, in plain Python."""

from __future__ import annotations

from drivers.arrays import Floats
from station.exporting.exported import Exported
from station.exporting.function_text import argument_names, arguments_said, cautions, function_text
from station.exporting.terms import Terms, terms_of
from station.exporting.written import Written, head, number


def write_python(exported: Exported) -> Written:
    """Return the module; CompensationError for gyros that do not span space."""
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    call = "Correction().correct" if terms.keeps_state else "correct"
    what = f"{call}(...): outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s)."
    keeps = any(terms.uses(name) for name in ("wdot", "follow", "last"))
    needed = {
        **{name: terms.uses(name) for name in ("cos", "exp", "expm1")},
        "fabs": bool(terms.of_the_rate) or terms.uses("fabs") or terms.uses("last"),
        "isfinite": terms.lag is not None or keeps,
        "isnan": terms.uses("slope") or terms.uses("sign"),
        **{name: terms.uses(name) for name in ("log1p", "sin", "sqrt", "tanh")},
        "nan": bool(terms.of_the_rate) or terms.has_law,
    }
    functions = [name for name, used in needed.items() if used]

    text = function_text(
        ["module", "class" if terms.keeps_state else "function"],
        exported,
        terms,
        lambda term: term.table.upper(),
        {"axis": "AXIS", "value": "_value(lambda: ", "sign": "_sign"}
        | {name: f"self._{name}(" for name in ("follow", "last")},
        {
            "head": head(exported, what, not_held, "#"),
            "import": [f"from math import {', '.join(functions)}", ""] if functions else [],
            "tables": _tables(exported, terms),
            "docstring": _docstring(exported, terms),
        },
        names=list(exported.compensation.array.names),
        simple="_solve" if terms.of_the_rate else "_invert",
        arguments=", ".join(argument_names(terms)),
        beside="".join(f", {name}" for name in terms.given_to_the_rate),
    )
    return Written(text, tuple(not_held))


def _tables(exported: Exported, terms: Terms) -> list[str]:
    lines = [
        "# Body rate per output: the inverse of the sensitivity, rows x, y, z.",
        *_table("SOLUTION", exported.compensation.solution),
        "# Biases, to be added to the outputs, in rad/s.",
        *_table("BIAS", exported.compensation.bias_rps),
    ]
    if terms.uses_axes:
        lines += ["# Nominal sense axes.", *_table("AXIS", exported.compensation.array.p)]
    for term in terms.all:
        lines += [f"# {term.effect.replace('_', ' ')}: {term.unit}", *_table(term.table.upper(), term.values)]
    return [*lines, ""]


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
    if terms.of_the_rate:
        lines.append("It is nan where effects of the rate cannot be undone: far beyond the rates of the calibration.")
    return [*lines, '"""']
