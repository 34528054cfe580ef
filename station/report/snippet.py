"""A few lines of Python that apply a correction to arrays of samples.

They undo what ``estimator.compensation`` undoes, in its order. ``station export`` writes the same for one sample after
the other.
"""

import re
from collections.abc import Iterator, Mapping, Sequence

from drivers.arrays import Floats
from estimator.compensation import MOST_ITERATIONS, TOLERANCE_RPS, Acts, HeldEffect
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import LAST_SHARE, REFERENCE_C
from estimator.kinematics import GRAVITY_MPS2
from station.exporting.law_text import law_terms
from station.report.correction import Correction

_WARMTH = f"(t - {REFERENCE_C:g})"
_STEPS = "np.maximum(np.diff(t_s, prepend=t_s[:1]), 0)"
_WARMING = f"(t - follow(t, {SLOPE_S:g} / ({SLOPE_S:g} + {_STEPS}), np.inf)) / {SLOPE_S:g}"
_CODE: Mapping[str, str] = {
    "thermal_bias": f"{{a}}[:, 0] * {_WARMTH}",
    "thermal_bias_quadratic": f"{{a}}[:, 0] * {_WARMTH} ** 2",
    "warm_up": "{a}[:, 0] * (1 - np.exp(-since / {tau}))",
    "g_sensitivity": f"(np.asarray(accel_mps2) / {GRAVITY_MPS2}) @ {{a}}.T",
    "thermal_gradient": f"{{a}}[:, 0] * {_WARMING}",
    "bandwidth": "{a}[:, 0] * slope(left, t_s)",
    "thermal_scale": f"{{a}}[:, 0] * {_WARMTH} * u",
    "scale_asymmetry": "{a}[:, 0] * np.abs(u)",
    "scale_quadratic": "{a}[:, 0] * u**2",
    "scale_cubic": "{a}[:, 0] * u**3",
    "acceleration_sensitivity": "slope(w, t_s) @ {a}.T",
}
"""What each effect adds to the outputs, or a lag takes off them; ``{a}`` is its table (n, parameters)."""
_FORCE = f"(np.asarray(accel_mps2) / {GRAVITY_MPS2})"
_VARIABLES: Mapping[str, str] = {
    "u": "u",
    **{f"w{axis}": f"w[:, [{r}]]" for r, axis in enumerate("xyz")},
    "speed": "np.linalg.norm(w, axis=1, keepdims=True)",
    "a": "(slope(w, t_s) @ SENSE_AXES.T)",
    "jolt": "np.linalg.norm(slope(w, t_s), axis=1, keepdims=True)",
    "T": _WARMTH,
    "Tdot": f"({_WARMING})",
    "t": "(since - since[0])",
    **{f"g{axis}": f"{_FORCE}[:, [{r}]]" for r, axis in enumerate("xyz")},
    "gs": f"({_FORCE} @ SENSE_AXES.T)",
}
"""The variables of laws, (N, n) or (N, 1)."""
_NEEDS: Mapping[str, str] = {"temperature_c": r"\bt\b", "accel_mps2": "accel_mps2", "t_s": r"\bt_s\b|since"}
"""The arguments beside the outputs, and what needs them in the code of the effects."""
_U = re.compile(r"\bu\b")
_ARGUMENTS = {
    "temperature_c": "temperature_c (N,) in degC",
    "accel_mps2": "accel_mps2 (N, 3), specific force in body axes, m/s2",
    "t_s": "t_s (N,), instants in s",
}
_SLOPE = '''

def slope(values, t_s):
    """Return rates of change since the row before, zero where they are not known."""
    step, change = np.diff(t_s)[:, None], np.diff(values, axis=0)
    rates = np.zeros_like(values)
    np.divide(change, step, out=rates[1:], where=(step > 0) & np.isfinite(change))
    return rates
'''
_FOLLOW = '''

def follow(x, shares, width):
    """Return what follows x (N, m) by a share of how far behind it was, no more than a width; skips no numbers."""
    out, kept = np.array(x, dtype=float), np.full_like(x[0], np.nan)
    for row, share in enumerate(shares):
        now = out[row].copy()
        moved = np.where(np.isfinite(kept), now + share * np.clip(kept - now, -width, width), now)
        kept = np.where(np.isfinite(now), moved, kept)
        out[row] = np.where(np.isfinite(now), kept, now)
    return out
'''
_LAST = f'''

def last(x, limit=None):
    """Return the sign that x had last beyond a limit, or beyond {LAST_SHARE:g} of its largest size so far."""
    size = np.where(np.isfinite(x), np.abs(x), 0.0)
    beyond = size > ({LAST_SHARE:g} * np.maximum.accumulate(size) if limit is None else limit)
    rows = np.maximum.accumulate(np.where(beyond, np.arange(len(x))[:, None], -1))
    return np.where(rows < 0, 0.0, np.take_along_axis(np.sign(x), np.maximum(rows, 0), 0))
'''
_HELPERS = {"slope(": _SLOPE, "follow(": _FOLLOW, "last(": _LAST}


def snippet(correction: Correction, origin: str) -> str:
    """Return Python that turns outputs (N, n) into body rates (N, 3), rad/s; ``origin`` becomes its first comment."""
    code = "\n".join(_of(correction, *Acts))
    needs = [argument for argument, names in _NEEDS.items() if re.search(names, code)]
    lines = ["import numpy as np", "", *(f"# {line}" for line in origin.splitlines()), *_tables(correction, code)]
    lines += [line for name, text in _HELPERS.items() if name in code for line in text.splitlines()]
    name = "own_rates" if correction.axes_only else "body_rate"
    lines += ["", "", f"def {name}({', '.join(['rate_rps', *needs])}):", *_documented(correction, needs)]
    if "temperature_c" in needs:
        lines.append("    t = np.asarray(temperature_c)[:, None]")
    if "since" in code:
        lines.append("    since = np.asarray(t_s)[:, None]")
    lines.append("    left = np.asarray(rate_rps) + BIAS_RPS")
    lines += [f"    left = left + {code}" for code in _of(correction, Acts.LAG)]
    lines += [f"    left = left - {code}" for code in _of(correction, Acts.ADDED)]
    return "\n".join([*lines, *(["    return left / GAIN"] if correction.axes_only else _inverse(correction)), ""])


def _inverse(correction: Correction) -> list[str]:
    """Return the lines that make a body rate of outputs that only the rate has a part in."""
    of_the_rate, past = list(_of(correction, Acts.RATE)), list(_of(correction, Acts.MOTION))
    lines, inverse = ["    solution = np.linalg.pinv(SENSITIVITY).T"], "({}) @ solution"
    if of_the_rate:
        inverse = "undone({})"
        lines += [
            "",
            "    def undone(left):",
            "        w = left @ solution",
            f"        for _ in range({MOST_ITERATIONS}):  # effects of the rate itself",
            "            before, u, rest = w, w @ SENSE_AXES.T, left",
            *(f"            rest = rest - {code}" for code in of_the_rate),
            "            w = rest @ solution",
            f"        w[~(np.abs(w - before).sum(axis=1) <= {TOLERANCE_RPS!r})] = np.nan  # far beyond the calibration",
            "        return w",
            "",
        ]
    if past:
        lines.append(f"    w = {inverse.format('left')}")
        if any(_U.search(code) for code in past):
            lines.append("    u = w @ SENSE_AXES.T")
    return [*lines, f"    return {inverse.format(' - '.join(['left', *past]))}"]


def _of(correction: Correction, *acts: Acts) -> Iterator[str]:
    """Yield the expressions of the effects that act like this."""
    for effect in correction.held:
        if effect.acts in acts:
            table, tau = _constant(correction, effect), effect.known.settings.get("time_constant_s")
            law = law_terms(effect.known.law, _VARIABLES, _called) if effect.known.law else []
            terms = " + ".join(f"{table}[:, {n}] * {term}" for n, term in enumerate(law))
            yield f"({terms})" if terms else _CODE[effect.name].format(a=table, tau=tau)


def _called(name: str, inner: str, constant: str) -> str:
    """Return the call of a function of laws, on arrays."""
    if name == "pow":
        return f"({inner} ** {constant})"
    if name == "lag":
        return f"follow({inner}, np.exp(-{_STEPS} / {constant}), np.inf)"
    if name == "play":
        return f"follow({inner}, np.ones(len(left)), 0.5 * {constant})"
    return f"last({inner}, {constant or None})" if name == "last" else f"np.{name}({inner})"


def _tables(correction: Correction, code: str) -> list[str]:
    compensation = correction.compensation
    lines = [_array("BIAS_RPS", compensation.bias_rps)]
    if correction.axes_only:
        lines.append(_array("GAIN", 1 - compensation.states[:, 0]))
    else:
        lines.append(_array("SENSITIVITY", compensation.sensitivity))
    if "SENSE_AXES" in code or _U.search(code) or any(effect.acts is Acts.RATE for effect in correction.held):
        lines.append(_array("SENSE_AXES", compensation.array.p))
    for effect in correction.held:
        values = effect.values
        if effect.name == "acceleration_sensitivity":  # about the tilt axes of each gyro; here about x, y, z
            values = values[:, [0]] * compensation.array.j + values[:, [1]] * compensation.array.k
        lines.append(_array(_constant(correction, effect), values))
    return lines


def _documented(correction: Correction, needs: Sequence[str]) -> list[str]:
    n = len(correction.compensation.array)
    gives = f"rates about their own axes (N, {n})" if correction.axes_only else "the rate of the body (N, 3)"
    lines = [f'    """Return {gives}, rad/s, from the outputs of the gyros (N, {n}), rad/s, in this order:']
    names = ", ".join(correction.compensation.array.names)
    told = [names, *(_ARGUMENTS[need] for need in needs)]
    if any(effect.name == "warm_up" for effect in correction.held):
        told[-1] += " from when they were switched on"
    lines += [f"    {one}{';' if one is not told[-1] else '.'}" for one in told]
    return [*lines, '    """']


def _constant(correction: Correction, effect: HeldEffect) -> str:
    if effect.known.law:
        return f"LAW_{correction.held.index(effect) + 1}"
    return "".join(c if c.isalnum() else "_" for c in effect.known.called).upper()


def _array(name: str, values: Floats) -> str:
    """Return an assignment with every digit, a row a line."""
    if values.ndim == 1:
        return f"{name} = np.array([{', '.join(map(repr, values.tolist()))}])"
    rows = ",\n".join(f"    [{', '.join(map(repr, row))}]" for row in values.tolist())
    return f"{name} = np.array([\n{rows},\n])"
