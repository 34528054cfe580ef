"""A few lines of Python that apply a correction to arrays of samples.

They undo what ``estimator.calibration.compensation`` undoes, in its order. ``station export`` writes the same for
one sample after the other.
"""

import re
from collections.abc import Iterator, Mapping

from drivers.types import Floats
from estimator.calibration.compensation import MOST_ITERATIONS, TOLERANCE_RPS, HeldEffect
from estimator.effects.conditions import REFERENCE_C, SLOPE_S
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.effect import Acts
from estimator.effects.law import LAST_SHARE
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.exports.terms import VARIABLES, law_terms
from station.render.template import rendered
from station.report.chapters.correction import Correction

_STEPS = "np.maximum(np.diff(t_s, prepend=t_s[:1]), 0)"
_NUMBERS = {"GRAVITY": str(GRAVITY_MPS2), "REFERENCE": f"{REFERENCE_C:g}", "SLOPE": f"{SLOPE_S:g}"}
_ROWS = {
    name: re.sub("|".join(_NUMBERS), lambda found: _NUMBERS[found[0]], text) for name, text in VARIABLES["rows"].items()
}
_NEEDS: Mapping[str, str] = {"temperature_c": r"\bt\b", "accel_mps2": "accel_mps2", "t_s": r"\bt_s\b|since"}
"""The arguments beside the outputs, and what needs them in the code of the effects."""
_U = re.compile(r"\bu\b")
_ACTS = (Acts.LAG, Acts.ADDED, Acts.RATE, Acts.MOTION)
_ARGUMENTS = {
    "temperature_c": "temperature_c (N,) in degC",
    "accel_mps2": "accel_mps2 (N, 3), specific force in body axes, m/s2",
    "t_s": "t_s (N,), instants in s",
}


def snippet(correction: Correction, origin: str) -> str:
    """Return Python that turns outputs (N, n) into body rates (N, 3), rad/s; ``origin`` becomes its first comment."""
    lag, added, of_the_rate, of_motion = (list(_of(correction, acts)) for acts in _ACTS)
    code = "\n".join([*lag, *added, *of_the_rate, *of_motion])
    values = {
        "origin": origin,
        "axes_only": correction.axes_only,
        "gyros": correction.compensation.array.names,
        "tables": _tables(correction, code),
        "code": code,
        "lag": lag,
        "added": added,
        "of_the_rate": of_the_rate,
        "of_motion": of_motion,
        "motion_uses_u": any(_U.search(term) for term in of_motion),
        "needs": [argument for argument, names in _NEEDS.items() if re.search(names, code)],
        "arguments": _ARGUMENTS,
        "warms_up": "since" in code,
        "share": f"{LAST_SHARE:g}",
        "iterations": MOST_ITERATIONS,
        "tolerance": TOLERANCE_RPS,
    }
    return rendered("station.report", "snippet.jinja", values)


def _of(correction: Correction, acts: Acts) -> Iterator[str]:
    """Yield the expressions of the effects that act like this."""
    for effect in correction.held:
        if effect.acts is acts:
            table, law = _constant(correction, effect), effect.known.law
            terms = law_terms(law, _ROWS, _called) if law else ["slope(left, t_s)"]  # a lag of the output
            yield f"({' + '.join(f'{table}[:, {n}] * {term}' for n, term in enumerate(terms))})"


def _called(name: str, inner: str, constant: str) -> str:
    """Return the call of a function of laws, on arrays."""
    if name == "pow":
        return f"({inner} ** {constant})"
    if name == "lag":
        return f"follow({inner}, np.exp(-{_STEPS} / {constant}), np.inf)"
    if name == "play":
        return f"follow({inner}, np.ones(len(left)), 0.5 * {constant})"
    return f"last({inner}, {constant or None})" if name == "last" else f"np.{name}({inner})"


def _tables(correction: Correction, code: str) -> dict[str, Floats]:
    """Return the numbers by the names that they have in the code."""
    compensation = correction.compensation
    tables = {"BIAS_RPS": compensation.bias_rps}
    if correction.axes_only:
        tables["GAIN"] = 1 - compensation.states[:, 0]
    else:
        tables["SENSITIVITY"] = compensation.sensitivity
    if "SENSE_AXES" in code or _U.search(code) or any(effect.acts is Acts.RATE for effect in correction.held):
        tables["SENSE_AXES"] = compensation.array.p
    tilts = {"AXES_J": compensation.array.j, "AXES_K": compensation.array.k}
    tables |= {name: axes for name, axes in tilts.items() if name in code}
    return tables | {_constant(correction, effect): effect.values for effect in correction.held}


def _constant(correction: Correction, effect: HeldEffect) -> str:
    if effect.known.record is CONSTRUCTED:
        return f"LAW_{correction.held.index(effect) + 1}"
    return "".join(c if c.isalnum() else "_" for c in effect.known.called).upper()
