"""A few lines of Python that apply a correction to arrays of samples.

They undo what ``estimator.compensation`` undoes, in its order. ``station export`` writes the same for one sample after
the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from drivers.arrays import Floats
from estimator.compensation import ADDED, MOST_ITERATIONS, OF_THE_RATE, SLOPE_S, TOLERANCE_RPS, HeldEffect
from estimator.effects.thermal import REFERENCE_C
from estimator.kinematics import GRAVITY_MPS2
from station.report.correction import Correction

_WARMTH = f"(t - {REFERENCE_C:g})"
_CODE: Mapping[str, str] = {
    "thermal_bias": f"{{a}}[:, 0] * {_WARMTH}",
    "thermal_bias_quadratic": f"{{a}}[:, 0] * {_WARMTH} ** 2",
    "warm_up": "{a}[:, 0] * (1 - np.exp(-since / {tau}))",
    "g_sensitivity": f"(np.asarray(accel_mps2) / {GRAVITY_MPS2}) @ {{a}}.T",
    "thermal_gradient": "{a}[:, 0] * warming(t, t_s)",
    "bandwidth": "{a}[:, 0] * slope(left, t_s)",
    "thermal_scale": f"{{a}}[:, 0] * {_WARMTH} * u",
    "scale_asymmetry": "{a}[:, 0] * np.abs(u)",
    "scale_quadratic": "{a}[:, 0] * u**2",
    "scale_cubic": "{a}[:, 0] * u**3",
    "acceleration_sensitivity": "slope(w, t_s) @ {a}.T",
}
"""What each effect adds to the outputs, or a lag takes off them; ``{a}`` is its table (n, parameters)."""
_NEEDS: Mapping[str, Sequence[str]] = {
    "temperature_c": ("thermal_bias", "thermal_bias_quadratic", "thermal_gradient", "thermal_scale"),
    "accel_mps2": ("g_sensitivity",),
    "t_s": ("warm_up", "thermal_gradient", "bandwidth", "acceleration_sensitivity"),
}
"""The arguments beside the outputs, and the effects that need them."""
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
_WARMING = f'''

def warming(t, t_s):
    """Return the slope of temperatures (N, 1), K/s, smoothed over {SLOPE_S:g} s."""
    smooth, slopes = np.nan, []
    for now, step in zip(t[:, 0], np.maximum(np.diff(t_s, prepend=t_s[:1]), 0)):
        if np.isnan(smooth):
            smooth = now
        elif not np.isnan(now):
            smooth += (now - smooth) * step / ({SLOPE_S:g} + step)
        slopes.append((now - smooth) / {SLOPE_S:g})
    return np.array(slopes)[:, None]
'''


def snippet(correction: Correction, origin: str) -> str:
    """Return Python that turns outputs (N, n) into body rates (N, 3), rad/s; ``origin`` becomes its first comment."""
    held = {effect.name for effect in correction.held}
    needs = [argument for argument, effects in _NEEDS.items() if held & set(effects)]
    lines = ["import numpy as np", "", *(f"# {line}" for line in origin.splitlines()), *_tables(correction)]
    if held & {"bandwidth", "acceleration_sensitivity"}:
        lines += _SLOPE.splitlines()
    if "thermal_gradient" in held:
        lines += _WARMING.splitlines()
    name = "own_rates" if correction.axes_only else "body_rate"
    lines += ["", "", f"def {name}({', '.join(['rate_rps', *needs])}):", *_documented(correction, needs)]
    if "temperature_c" in needs:
        lines.append("    t = np.asarray(temperature_c)[:, None]")
    if "warm_up" in held:
        lines.append("    since = np.asarray(t_s)[:, None]")
    lines.append("    left = np.asarray(rate_rps) + BIAS_RPS")
    lines += [f"    left = left + {code}" for code in _of(correction, ("bandwidth",))]
    lines += [f"    left = left - {code}" for code in _of(correction, (*ADDED, "thermal_gradient"))]
    return "\n".join([*lines, *(["    return left / GAIN"] if correction.axes_only else _inverse(correction)), ""])


def _inverse(correction: Correction) -> list[str]:
    """Return the lines that make a body rate of outputs that only the rate has a part in."""
    of_the_rate, past = list(_of(correction, OF_THE_RATE)), list(_of(correction, ("acceleration_sensitivity",)))
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
    return [*lines, f"    return {inverse.format(' - '.join(['left', *past]))}"]


def _of(correction: Correction, names: Sequence[str]) -> Iterator[str]:
    """Yield the expressions of the effects of these names."""
    for effect in correction.held:
        if effect.name in names:
            tau = effect.known.settings.get("time_constant_s")
            yield _CODE[effect.name].format(a=_constant(effect), tau=tau)


def _tables(correction: Correction) -> list[str]:
    compensation = correction.compensation
    lines = [_array("BIAS_RPS", compensation.bias_rps)]
    if correction.axes_only:
        lines.append(_array("GAIN", 1 - compensation.states[:, 0]))
    else:
        lines.append(_array("SENSITIVITY", compensation.sensitivity))
    if any(effect.name in OF_THE_RATE for effect in correction.held):
        lines.append(_array("SENSE_AXES", compensation.array.p))
    for effect in correction.held:
        values = effect.values
        if effect.name == "acceleration_sensitivity":  # about the tilt axes of each gyro; here about x, y, z
            values = values[:, [0]] * compensation.array.j + values[:, [1]] * compensation.array.k
        lines.append(_array(_constant(effect), values))
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


def _constant(effect: HeldEffect) -> str:
    return "".join(c if c.isalnum() else "_" for c in effect.known.called).upper()


def _array(name: str, values: Floats) -> str:
    """Return an assignment with every digit, a row a line."""
    if values.ndim == 1:
        return f"{name} = np.array([{', '.join(map(repr, values.tolist()))}])"
    rows = ",\n".join(f"    [{', '.join(map(repr, row))}]" for row in values.tolist())
    return f"{name} = np.array([\n{rows},\n])"
