"""Source code with the functions that turn outputs of the gyros into the rate of their body, and outputs of
accelerometers into the specific force: C99, plain Python.
"""

import re
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from drivers.types import Floats
from estimator.calibration.compensation import MOST_ITERATIONS, TOLERANCE_RPS
from estimator.effects.conditions import REFERENCE_C, SLOPE_S
from estimator.effects.effect import Acts
from estimator.effects.law import LAST_SHARE
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.errors import sentence
from station.exports.accelerations import ForceCorrection, HeldForces, Part, held_forces
from station.exports.exported import Exported
from station.exports.terms import AXIS_TABLES, Term, Terms, terms_of
from station.exports.written import Written, delay_line, head, lines_of, number
from station.render.template import rendered

_DOUBLE = re.compile(
    r"/\*.*?\*/|\"[^\"\n]*\"|\b(?:cos|exp|expm1|fabs|fmax|fmin|log1p|pow|sin|sqrt|tanh)\b(?=\()|"
    r"(?<![\w.])\d+(?:\.\d*(?:e[+-]?\d+)?|e[+-]?\d+)",
    re.DOTALL,
)
"""What C writes otherwise for floats; comments and strings, in which everything stays."""
_GIVEN = {"warmth": ", double warmth", "time_s": ", double time_s", "accel": ", const double accel[3]"}
_FORCE_ITERATIONS = 8  # each leaves a few thousandths, the size of the effects, of what was wrong before
_MATH = ("cos", "exp", "expm1", "fabs", "isfinite", "isnan", "log1p", "nan", "sin", "sqrt", "tanh")


def write_c(exported: Exported) -> Written:
    """Return the header, with all that ``_header`` says; CompensationError for gyros that do not span space."""
    return _header(exported, "double", identifier(exported.name))


def write_c_float(exported: Exported) -> Written:
    """Return the header in single precision, under names of its own: both can be in one program.

    CompensationError for gyros that do not span space.
    """
    written = _header(exported, "float", f"{identifier(exported.name)}_float")
    return Written(_DOUBLE.sub(_single, str(written.text)), written.not_held)


def _header(exported: Exported, real: str, prefix: str) -> Written:
    """Return the C99 header, in type ``real`` and with names that begin with ``prefix``, and what it leaves out.

    It corrects accelerometers, too, if they are exported, has inputs and results to test it with, and macros of
    identity and validity (see ``_macros``). CompensationError for gyros that do not span space.
    """
    terms = terms_of(exported.compensation)
    forces = _held_forces(exported)
    not_held = _cautions(exported, terms, forces)
    purpose = (
        f"{prefix}_correct: outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s). C99."
    )
    module = _module_of(exported)
    samples, rates = _vectors(exported, terms, module)
    if forces.correction is not None:
        purpose += f" {prefix}_correct_force: {_force_purpose(forces.correction)}"
        outputs, specific_forces = _force_vectors(forces.correction, module)
    else:
        outputs, specific_forces = np.empty((0, 0)), np.empty((0, 3))
    text = _function_text(
        "header.jinja",
        exported,
        terms,
        lambda term: f"{prefix}_{term.table}",
        {"value": "(", "sign": f"{prefix}_sign"}
        | {axis: f"{prefix}_{axis}" for axis in AXIS_TABLES}
        | {name: f"{prefix}_{name}(state, " for name in ("follow", "last")},
        head=[f" *{_comment_text(line.removeprefix(' *'))}" for line in head(exported, purpose, not_held, " *")],
        said=list(map(_comment_text, _argument_comments(exported, terms))),
        p=prefix,
        upper=prefix.upper(),
        names=_argument_names(terms),
        beside="".join(_GIVEN[name].replace("double", real) for name in terms.given_to_the_rate),
        real=real,
        macros=_macros(exported),
        samples=samples,
        rates=rates,
        force=forces.correction,
        force_names=_comment_text(_names_of(forces.correction)),
        force_outputs=outputs,
        forces=specific_forces,
    )
    return Written(text, tuple(not_held))


def _macros(exported: Exported) -> list[tuple[str, str, str]]:
    """Return (name behind the prefix, value, meaning) of the macros that a program may check.

    Identity first, as quoted texts, "" for what is unknown; then validity, the conditions of the calibration, as
    numbers in brackets. Unknown numbers are left out, so that a check of them does not compile.
    """
    texts = {
        "DEVICE": ("device", "device under test"),
        "SERIAL_NUMBER": ("serial number", "its serial number"),
        "MEASURED_UTC": ("measured (UTC)", "when it was measured; empty: in virtual time, or not known"),
        "OUTCOME": ("outcome", "outcome of the run, with the reason"),
        "RECORDING": ("recording", "file that the calibration is from"),
        "RECORDING_SHA256": ("sha256 of the recording", "hash of that file"),
    }
    macros = [(name, _c_string(exported.identity.get(key, "")), meaning) for name, (key, meaning) in texts.items()]
    low_c, _, high_c = exported.seen.temperature_c
    limits = {
        "RATE_MAX_RPS": (exported.seen.largest_rps, "largest rate that a gyro was calibrated at, rad/s"),
        "TEMPERATURE_MIN_C": (low_c, "lowest temperature during the calibration, degC"),
        "TEMPERATURE_MAX_C": (high_c, "highest temperature during the calibration, degC"),
    }
    macros += [(name, f"({number(value)})", meaning) for name, (value, meaning) in limits.items() if np.isfinite(value)]
    return macros


def _c_string(text: str) -> str:
    """Return a string literal of C in ASCII; other characters become question marks."""
    plain = "".join(c if " " <= c <= "~" and c not in '\\"?' else "'" if c == '"' else "?" for c in text)
    return f'"{plain}"'


def _single(match: re.Match[str]) -> str:
    """Return a function or a number of C in single precision; comments and strings unchanged."""
    text = match.group()
    if not text[0].isdigit():
        return text if text.startswith(("/*", '"')) else f"{text}f"
    return number(float(np.float32(min(float(text), 3e38))), 9) + "f"


def _held_forces(exported: Exported) -> HeldForces:
    """Return what source code holds of the accelerometers."""
    return held_forces(exported, triad=False, parts={Part.EFFECTS, Part.LEVER_ARM})


def _names_of(force: ForceCorrection | None) -> str:
    """Return the names of the accelerometers in the order of the outputs; empty without any."""
    return "" if force is None else ", ".join(force.names)


def _force_purpose(force: ForceCorrection) -> str:
    """Return what the function for accelerometers does."""
    return f"outputs of {len(force.names)} accelerometers (m/s2) to the specific force at their place (m/s2)."


def _module_of(exported: Exported) -> dict[str, Any]:
    """Return the names that the exported Python module defines; it is executed for it."""
    made: dict[str, Any] = {}
    exec(write_python(exported).text, made)  # no text of the recording's stands in it but in comments and quotes
    return made


def _force_vectors(force: ForceCorrection, module: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return test inputs (8, a), outputs of the accelerometers, and the forces (8, 3) of the ``module``, in m/s2."""
    given = GRAVITY_MPS2 * np.cos(np.outer(np.arange(8), (1.0, 1.7, 2.3)))
    outputs = given @ force.sensitivity.T - force.bias_mps2
    return outputs, np.array([module["correct_force"](row) for row in outputs.tolist()])


def _vectors(exported: Exported, terms: Terms, module: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return test inputs (8, n + 5) of n gyros over the conditions of the calibration, and their results (8, 3).

    Inputs: outputs in rad/s, specific force in m/s2 (3), temperature in degC, time step in s. The results, in rad/s,
    are those of the Python ``module``, row after row with one state. An unknown temperature is ``REFERENCE_C``, an
    unknown sampling rate 100 Hz.
    """
    correct = module["Correction"]().correct if terms.keeps_state else module["correct"]
    held, seen, turns = exported.compensation, exported.seen, np.outer(np.arange(8), (1.0, 1.7, 2.3))
    rate = seen.largest_rps / np.sqrt(3) * np.sin(turns) @ held.sensitivity.T - held.bias_rps
    low, _, high = seen.temperature_c if np.isfinite(seen.temperature_c[1]) else (REFERENCE_C,) * 3
    given = {"rate_rps": rate, "accel": GRAVITY_MPS2 * np.cos(turns), "temperature_c": np.linspace(low, high, 8)}
    given["dt_s"] = np.full(8, 1 / seen.rate_hz if np.isfinite(seen.rate_hz) else 0.01)
    rows = zip(*(given[name].tolist() for name in _argument_names(terms)), strict=True)
    return np.column_stack(list(given.values())), np.array([correct(*row) for row in rows])


def write_python(exported: Exported) -> Written:
    """Return the Python module, with what it does not correct; CompensationError for gyros that do not span space.

    It has a class instead of a function if effects keep a state, and a further function if accelerometers are exported.
    """
    terms = terms_of(exported.compensation)
    forces = _held_forces(exported)
    not_held = _cautions(exported, terms, forces)
    call = "Correction().correct" if terms.keeps_state else "correct"
    purpose = f"{call}(...): outputs of {len(exported.gyros)} gyros (rad/s) to the rate of their body (rad/s)."
    if forces.correction is not None:
        purpose += f" correct_force(...): {_force_purpose(forces.correction)}"
    text = _function_text(
        "module.jinja",
        exported,
        terms,
        lambda term: term.table.upper(),
        {"value": "_value(lambda: ", "sign": "_sign"}
        | {axis: axis.upper() for axis in AXIS_TABLES}
        | {name: f"self._{name}(" for name in ("follow", "last")},
        head=head(exported, purpose, not_held, "#"),
        said=[line.replace("\\", "/").replace('"""', "'''") for line in _argument_comments(exported, terms)],
        names=list(exported.compensation.array.names),
        simple="_solve" if terms.of(Acts.RATE) else "_invert",
        arguments=", ".join(_argument_names(terms)),
        beside="".join(f", {name}" for name in terms.given_to_the_rate),
        force=forces.correction,
        force_names=list(forces.correction.names) if forces.correction else [],
    )
    used = [name for name in _MATH if re.search(rf"\b{name}\b", text)]
    imported = f"from math import {', '.join(used)}\n\n" if used else ""
    return Written(text.replace("from math import _\n\n", imported), tuple(not_held))


def identifier(name: str) -> str:
    """Return the identifier of a device in source code."""
    word = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_") or "imu"
    return word if word[0].isalpha() else f"imu_{word}"


def _comment_text(text: str) -> str:
    """Return a text that may stand in a comment."""
    return text.replace("*/", "* /").replace("/*", "/ *").replace("??/", "?? /")


def _argument_names(terms: Terms) -> list[str]:
    """Return the names of the function's arguments for a sample, in order; ``_argument_comments`` explains each.

    All but the outputs of the gyros are there only if a term needs them.
    """
    warm = terms.uses("warmth") or terms.uses("slope")
    asked = {"rate_rps": True, "temperature_c": warm, "accel": terms.uses("accel"), "dt_s": terms.timed}
    return [name for name, needed in asked.items() if needed]


def _argument_comments(exported: Exported, terms: Terms) -> list[str]:
    """Return one line about each argument of the function, and the conditions for all."""
    used = {name: terms.uses(name) for name in ("slope", "wdot")} | {"rate": bool(terms.of(Acts.RATE))}
    given = {
        "names": _argument_names(terms),
        "gyros": exported.compensation.array.names,
        "largest_dps": np.degrees(exported.seen.largest_rps),
        "slope_s": SLOPE_S,
    }
    return rendered("station.exports", "arguments.jinja", given | used).splitlines()


def _cautions(exported: Exported, terms: Terms, forces: HeldForces) -> list[str]:
    """Return what the function does not hold, a line each.

    That is effects that it does not correct, the delay, the noise that correcting a lag adds at the recorded sample
    rate, and what is lacking of the accelerometers.
    """
    lines = [*lines_of(exported.compensation.left_out), *delay_line(exported)]
    if terms.lag is not None and np.isfinite(exported.seen.rate_hz):
        share = float(terms.lag.values.max()) * exported.seen.rate_hz
        noise = np.hypot(1 + share, share)
        lines.append(sentence("export.lag", lag=terms.lag.table, rate_hz=exported.seen.rate_hz, noise=noise))
    return [*lines, *forces.lines]


def _function_text(
    template: str,
    exported: Exported,
    terms: Terms,
    name_of: Callable[[Term], str],
    helpers: Mapping[str, str],
    **values: object,
) -> str:
    """Return the source code from a template, with ``values`` as further names in it.

    ``name_of`` names the table of a term; ``helpers`` are the target language's texts for the placeholders in braces in
    a term's expression.
    """

    def written(acts: Acts) -> list[str]:
        return [term.written(name_of(term), helpers) for term in terms.of(acts)]

    used = {name: terms.uses(name) for name in ("warmth", "time_s", "slope", "wdot", "last", "sign")}
    used |= {name: used["slope"] or terms.uses(name) for name in ("step", "follow")}
    values |= {
        **used,
        "added": written(Acts.ADDED),
        "of_rate": written(Acts.RATE),
        "of_motion": written(Acts.MOTION),
        "u_rate": terms.uses("u", Acts.RATE),
        "u_motion": terms.uses("u", Acts.MOTION),
        "rate": bool(terms.of(Acts.RATE)),
        "motion": bool(terms.of(Acts.MOTION)),
        "law": terms.uses("value"),
        "state": terms.keeps_state,
        "dt_s": terms.timed,
        "lag": name_of(terms.lag) if terms.lag is not None else "",
        "held": exported.compensation,
        "terms": terms,
        "numbers": lambda row: ", ".join(number(x) if np.isfinite(x) else "NAN" for x in row),
        "gyros": len(exported.gyros),
        "delay_s": number(exported.compensation.delay_s),
        "iterations": MOST_ITERATIONS,
        "force_iterations": _FORCE_ITERATIONS,
        "gravity_mps2": number(GRAVITY_MPS2),
        "tolerance": number(TOLERANCE_RPS),
        "reference_c": number(REFERENCE_C),
        "slope_s": number(SLOPE_S),
        "passed": "".join(f", {name}" for name in terms.given_to_the_rate),
        "places": terms.places,
        "share": number(LAST_SHARE),
    }
    lines = rendered("station.exports", template, values).split("\n")
    return "\n".join(line.rstrip() for line in lines)
