"""A C99 header with the function that turns outputs of the gyros into the rate of their body, in double."""

import re

from estimator.effects.effect import Acts
from station.exports.exported import Exported
from station.exports.forms.function_text import argument_names, arguments_said, cautions, function_text
from station.exports.terms import AXIS_TABLES, terms_of
from station.exports.written import Written, head


def write_c(exported: Exported) -> Written:
    """Return the header; CompensationError for gyros that do not span space."""
    terms = terms_of(exported.compensation)
    not_held = cautions(exported, terms)
    prefix = identifier(exported.name)
    what = f"{prefix}_correct: outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s). C99."
    declared = {
        "rate_rps": f"const double rate_rps[{prefix}_gyros]",
        "temperature_c": "double temperature_c",
        "accel": "const double accel[3]",
        "dt_s": "double dt_s",
    }
    arguments = [f"{prefix}_state *state"] if terms.keeps_state else []
    arguments += [*(declared[name] for name in argument_names(terms)), "double w_rps[3]"]
    text = function_text(
        "header.jinja",
        exported,
        terms,
        lambda term: f"{prefix}_{term.table}",
        {"value": "(", "sign": f"{prefix}_sign"}
        | {axis: f"{prefix}_{axis}" for axis in AXIS_TABLES}
        | {name: f"{prefix}_{name}(state, " for name in ("follow", "last")},
        head=list(map(_said_line, head(exported, what, not_held, " *"))),
        said=list(map(_said, arguments_said(exported, terms))),
        p=prefix,
        upper=prefix.upper(),
        arguments=", ".join(arguments),
        beside="".join(_GIVEN[name] for name in terms.given_to_the_rate),
        simple=f"void {prefix}_solve" if terms.of(Acts.RATE) else f"int {prefix}_invert",
    )
    return Written(text, tuple(not_held))


_GIVEN = {"warmth": ", double warmth", "time_s": ", double time_s", "accel": ", const double accel[3]"}


def identifier(name: str) -> str:
    """Return what a device is called in source code."""
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "imu"
    return word if word[0].isalpha() else f"imu_{word}"


def _said_line(line: str) -> str:
    return " *" + _said(line.removeprefix(" *"))


def _said(text: str) -> str:
    """Return a text that may stand in a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /")
