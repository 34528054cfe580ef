"""A Python module with the function that turns outputs of the gyros into the rate of their body, in plain Python."""

import re

from estimator.effects.effect import Acts
from station.exports.exported import Exported
from station.exports.forms.function_text import argument_names, arguments_said, cautions, function_text
from station.exports.terms import AXIS_TABLES, terms_of
from station.exports.written import Written, head


def write_python(exported: Exported) -> Written:
    """Return the module; CompensationError for gyros that do not span space."""
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    call = "Correction().correct" if terms.keeps_state else "correct"
    what = f"{call}(...): outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s)."
    text = function_text(
        "module.jinja",
        exported,
        terms,
        lambda term: term.table.upper(),
        {"value": "_value(lambda: ", "sign": "_sign"}
        | {axis: axis.upper() for axis in AXIS_TABLES}
        | {name: f"self._{name}(" for name in ("follow", "last")},
        head=head(exported, what, not_held, "#"),
        said=[line.replace("\\", "/").replace('"""', "'''") for line in arguments_said(exported, terms)],
        names=list(exported.compensation.array.names),
        simple="_solve" if terms.of(Acts.RATE) else "_invert",
        arguments=", ".join(argument_names(terms)),
        beside="".join(f", {name}" for name in terms.given_to_the_rate),
    )
    used = [name for name in _MATH if re.search(rf"\b{name}\b", text)]
    imported = f"from math import {', '.join(used)}\n\n" if used else ""
    return Written(text.replace("from math import _\n\n", imported), tuple(not_held))


_MATH = ("cos", "exp", "expm1", "fabs", "isfinite", "isnan", "log1p", "nan", "sin", "sqrt", "tanh")
