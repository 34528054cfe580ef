"""What C and Python have in common: the arguments of the correction function, what is left to its user, its text."""

from collections.abc import Callable, Mapping

import numpy as np

from drivers.types import Floats
from estimator.calibration.compensation import MOST_ITERATIONS, TOLERANCE_RPS
from estimator.effects.conditions import REFERENCE_C, SLOPE_S
from estimator.effects.effect import Acts
from estimator.effects.law import LAST_SHARE
from station.exports.exported import Exported
from station.exports.terms import Term, Terms
from station.exports.written import delay_line, lines_of, number
from station.render.template import rendered


def argument_names(terms: Terms) -> list[str]:
    """Return what the function is given of a sample, in order; ``arguments_said`` says what each is."""
    warm = terms.uses("warmth") or terms.uses("slope")
    asked = {"rate_rps": True, "temperature_c": warm, "accel": terms.uses("accel"), "dt_s": terms.timed}
    return [name for name, needed in asked.items() if needed]


def arguments_said(exported: Exported, terms: Terms) -> list[str]:
    """Return a line for each argument of the function, and what holds of them."""
    said = {
        "rate_rps": f"outputs of {', '.join(exported.compensation.array.names)}, in this order, in rad/s",
        "temperature_c": "temperature of the gyros, in degC",
        "accel": "specific force along body x, y, z, in m/s2 (at rest it points up)",
        "dt_s": "time since the sample before, in s",
    }
    lines = [f"{name}: {said[name]}" for name in argument_names(terms)]
    if terms.of(Acts.RATE):
        largest = np.degrees(exported.seen.largest_rps)
        lines.append(f"Effects of the rate were found up to {largest:.4g} deg/s; beyond they are extrapolated.")
    if terms.uses("slope"):
        lines.append(f"The slope of the temperature is taken over {SLOPE_S:g} s.")
    if terms.uses("wdot"):
        lines.append("Angular accelerations are differences of two samples, half a period late.")
    return lines


def cautions(exported: Exported, terms: Terms) -> list[str]:
    """Return what of the calibration the function does not undo, and what undoing costs."""
    lines = [*lines_of(exported.compensation.left_out), *delay_line(exported)]
    if terms.lag is not None and np.isfinite(exported.seen.rate_hz):
        share = float(terms.lag.values.max()) * exported.seen.rate_hz
        lines.append(
            f"{terms.lag.table}: the lag is undone by differences of samples, which at {exported.seen.rate_hz:.6g} "
            f"samples a second makes the noise {np.hypot(1 + share, share):.2g} times as large"
        )
    return lines


def function_text(
    template: str,
    exported: Exported,
    terms: Terms,
    name_of: Callable[[Term], str],
    helpers: Mapping[str, str],
    **values: object,
) -> str:
    """Return the source code of a template; ``name_of`` names the table of a term, ``helpers`` are how the language
    writes what stands in braces in its expression. ``values`` are more names that the template uses.
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
        "tables": _tables(exported, terms),
        "numbers": lambda row: ", ".join(map(number, row)),
        "gyros": len(exported.gyros),
        "delay_s": number(exported.compensation.delay_s),
        "iterations": MOST_ITERATIONS,
        "tolerance": number(TOLERANCE_RPS),
        "reference_c": number(REFERENCE_C),
        "slope_s": number(SLOPE_S),
        "passed": "".join(f", {name}" for name in terms.given_to_the_rate),
        "places": terms.places,
        "share": number(LAST_SHARE),
    }
    lines = rendered("station.exports", template, values).split("\n")
    return "\n".join(line.rstrip() for line in lines)


def _tables(exported: Exported, terms: Terms) -> list[tuple[str, str, Floats]]:
    """Return all numbers of the correction: of each table what it is, its name, its values."""
    held = exported.compensation
    return [
        ("Body rate per output: the inverse of the sensitivity, rows x, y, z.", "solution", held.solution),
        ("Biases, to be added to the outputs, in rad/s.", "bias", held.bias_rps),
        *([("Nominal sense axes.", "axis", held.array.p)] if terms.uses("u") or terms.uses("axis") else []),
        *([("Nominal tilt axes j.", "axis_j", held.array.j)] if terms.uses("axis_j") else []),
        *([("Nominal tilt axes k.", "axis_k", held.array.k)] if terms.uses("axis_k") else []),
        *((f"{term.effect.replace('_', ' ')}: {term.unit}", term.table, term.values) for term in terms.all),
    ]
