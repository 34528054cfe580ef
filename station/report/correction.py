"""The correction of a device: its formula with its numbers, and a few lines of Python that apply it.

The numbers are those of ``estimator.compensation``; ``station export`` writes the same correction for other programs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.array import SensorArray
from estimator.calibration import EffectValue, GyroCalibration
from estimator.compensation import ADDED, OF_THE_RATE, Compensation, CompensationError
from estimator.effects.thermal import REFERENCE_C
from estimator.kinematics import GRAVITY_MPS2
from station.report.recorded import Recorded
from station.report.traced import Traced, found_of

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Term:
    """How an effect stands in the formula (HTML) and in Python; ``needs`` names the argument of the function."""

    formula: str
    code: str
    needs: str = ""


_T = f"(<var>T</var> − {REFERENCE_C:g} °C)"
_CODE_T = f"(t - {REFERENCE_C:g})"
TERMS: Mapping[str, Term] = {
    "thermal_bias": Term(f"<var>a</var> {_T}", f"{{a}} * {_CODE_T}", "temperature_c"),
    "thermal_bias_quadratic": Term(f"<var>a</var> {_T}<sup>2</sup>", f"{{a}} * {_CODE_T} ** 2", "temperature_c"),
    "thermal_scale": Term(f"<var>a</var> {_T} <var>u</var>", f"{{a}} * {_CODE_T} * u", "temperature_c"),
    "scale_asymmetry": Term("<var>a</var> |<var>u</var>|", "{a} * np.abs(u)"),
    "scale_quadratic": Term("<var>a</var> <var>u</var><sup>2</sup>", "{a} * u**2"),
    "scale_cubic": Term("<var>a</var> <var>u</var><sup>3</sup>", "{a} * u**3"),
    "g_sensitivity": Term(
        "<b>a</b> · <b>f</b> / <var>g</var>", f"(np.asarray(accel_mps2) / {GRAVITY_MPS2}) @ {{all}}.T", "accel_mps2"
    ),
    "warm_up": Term(
        "<var>a</var> (1 − exp(−<var>t</var> / <var>τ</var>))", "{a} * (1 - np.exp(-since / {tau}))", "t_s"
    ),
}
"""Effects that a sample alone tells; <var>u</var> is the rate about the nominal sense axis."""
_ARGUMENTS = {
    "temperature_c": "temperature_c (N,) in degC",
    "accel_mps2": "accel_mps2 (N, 3), specific force in body axes, m/s2",
    "t_s": "t_s (N,), time since switching on, s",
}


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction of one device. ``axes_only``: its gyros do not tell a body rate, only rates about their own axes.

    ``not_applied``: effects that the snippet goes without, with the reason.
    """

    device: str
    compensation: Compensation
    axes_only: bool
    not_applied: Mapping[str, str]

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that the snippet undoes, as the model calls them."""
        return tuple(held.known.called for held in self.compensation.effects if held.name in TERMS)


def corrections_of(recorded: Recorded, traced: Traced | None = None) -> list[Correction]:
    """Return one correction a device: of the calibration, or with the states and effects of an investigation."""
    assert recorded.calibration is not None
    gyros, model = list(recorded.calibration.gyros), recorded.calibration.model
    if traced is not None:
        assert traced.model is not None
        model = traced.model.text()
        labelled = [(gyro, recorded.label(gyro.source, gyro.name)) for gyro in gyros]
        gyros = [_augmented(gyro, label, traced) for gyro, label in labelled if label in traced.names]
    arrays = {name: data.array for name, data in recorded.recording.sources.items()}
    return [_correction(device, own, arrays, model) for device, own in _by_device(gyros).items()]


def _by_device(gyros: Sequence[GyroCalibration]) -> dict[str, list[GyroCalibration]]:
    found: dict[str, list[GyroCalibration]] = {}
    for gyro in gyros:
        found.setdefault(gyro.device or gyro.source, []).append(gyro)
    return found


def _augmented(gyro: GyroCalibration, label: str, traced: Traced) -> GyroCalibration:
    assert traced.model is not None
    values = found_of(traced, label)
    effects = tuple(
        EffectValue(known.called, size.name, value, 0.0, size.unit, size.sd, known.shared)
        for known in traced.model.effects
        for size, value in zip(known.sizes, values.get(known.called, [0.0] * len(known.sizes)), strict=True)
    )
    return replace(gyro, states=traced.states[traced.names.index(label)], effects=effects)


def _correction(device: str, gyros: list[GyroCalibration], arrays: Mapping[str, SensorArray], model: str) -> Correction:
    compensation = Compensation.of(gyros, arrays, model)
    try:
        axes_only = not compensation.solution.size
    except CompensationError:
        axes_only = True
    not_applied = dict(compensation.left_out)
    for held in compensation.effects:
        if held.name not in TERMS:
            not_applied[held.known.called] = (
                "the samples before are needed, so use the module that station export --format python writes"
            )
        elif axes_only and held.name in OF_THE_RATE:
            not_applied[held.known.called] = "the rate of the body is not known"
    return Correction(device, compensation, axes_only, not_applied)


def snippet(correction: Correction, origin: str) -> str:
    """Return Python that turns outputs (N, n) into body rates (N, 3), rad/s; ``origin`` becomes its first comment."""
    compensation = correction.compensation
    held = [h for h in compensation.effects if h.known.called not in correction.not_applied]
    needs = list(dict.fromkeys(TERMS[h.name].needs for h in held if TERMS[h.name].needs))
    lines = ["import numpy as np", "", *(f"# {line}" for line in origin.splitlines())]
    lines.append(_array("BIAS_RPS", compensation.bias_rps))
    if correction.axes_only:
        lines.append(_array("GAIN", 1 - compensation.states[:, 0]))
    else:
        lines.append(_array("SENSITIVITY", compensation.sensitivity))
        if any(h.name in OF_THE_RATE for h in held):
            lines.append(_array("SENSE_AXES", compensation.array.p))
    lines += [_array(_constant(h.known.called), h.values) for h in held]
    lines += ["", "", f"def {'own_rates' if correction.axes_only else 'body_rate'}({', '.join(['rate_rps', *needs])}):"]
    lines += _documented(correction, needs)
    if "temperature_c" in needs:
        lines.append("    t = np.asarray(temperature_c)[:, None]")
    if "t_s" in needs:
        lines.append("    since = np.asarray(t_s)[:, None]")
    lines.append("    left = np.asarray(rate_rps) + BIAS_RPS")
    lines += [f"    left = left - {_code(h.known.called, h.known.settings)}" for h in held if h.name in ADDED]
    if correction.axes_only:
        return "\n".join([*lines, "    return left / GAIN", ""])
    lines += ["    solution = np.linalg.pinv(SENSITIVITY).T", "    w = left @ solution"]
    rate = [_code(h.known.called, h.known.settings) for h in held if h.name in OF_THE_RATE]
    if rate:
        lines += ["    for _ in range(30):  # effects of the rate itself", "        u = w @ SENSE_AXES.T"]
        lines.append(f"        w = (left - {' - '.join(rate)}) @ solution")
    return "\n".join([*lines, "    return w", ""])


def _documented(correction: Correction, needs: Sequence[str]) -> list[str]:
    n = len(correction.compensation.array)
    gives = f"rates about their own axes (N, {n})" if correction.axes_only else "the rate of the body (N, 3)"
    lines = [f'    """Return {gives}, rad/s, from the outputs of the gyros (N, {n}), rad/s, in this order:']
    names = ", ".join(correction.compensation.array.names)
    told = "; ".join(_ARGUMENTS[need] for need in needs)
    return [*lines, f"    {names}{f'; {told}' if told else ''}.", '    """']


def _code(called: str, settings: Mapping[str, float | int | str]) -> str:
    constant = _constant(called)
    tau = settings.get("time_constant_s")
    return TERMS[called.split()[0]].code.format(a=f"{constant}[:, 0]", all=constant, tau=tau)


def _constant(called: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in called).upper()


def _array(name: str, values: Floats) -> str:
    """Return an assignment with every digit, a row a line."""
    if values.ndim == 1:
        return f"{name} = np.array([{', '.join(map(repr, values.tolist()))}])"
    rows = ",\n".join(f"    [{', '.join(map(repr, row))}]" for row in values.tolist())
    return f"{name} = np.array([\n{rows},\n])"
