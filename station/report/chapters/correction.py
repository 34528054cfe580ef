"""The correction of each device, by ``estimator.calibration.compensation``, as formulas: effects undone or not."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup, escape

from drivers.types import Floats
from estimator.calibration.compensation import (
    MOST_ITERATIONS,
    TOLERANCE_RPS,
    Compensation,
    CompensationError,
    HeldEffect,
)
from estimator.calibration.gyro import EffectValue, GyroCalibration
from estimator.effects.conditions import REFERENCE_C, SLOPE_S
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.effect import Acts
from estimator.effects.law import LAST_SHARE, VARIABLES, variables_of
from estimator.geometry.array import SensorArray
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.exports.terms import SPELLED, law_terms
from station.render.template import rendered
from station.report.investigation_chapter import ALL, Traced
from station.report.recorded import Recorded

_STEPS = "np.maximum(np.diff(t_s, prepend=t_s[:1]), 0)"
_NUMBERS = {"GRAVITY": str(GRAVITY_MPS2), "REFERENCE": f"{REFERENCE_C:g}", "SLOPE": f"{SLOPE_S:g}"}
_ROWS = {
    name: re.sub("|".join(_NUMBERS), lambda found: _NUMBERS[found[0]], text) for name, text in SPELLED["rows"].items()
}
_NEEDS: Mapping[str, str] = {"temperature_c": r"\bt\b", "accel_mps2": "accel_mps2", "t_s": r"\bt_s\b|since"}
"""The arguments beside the outputs, and what needs them in the code of the effects."""
_U = re.compile(r"\bu\b")
_ACTS = (Acts.LAG, Acts.ADDED, Acts.RATE, Acts.MOTION)


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction of one device. ``axes_only``: its gyros give only rates about their own axes, no body rate.

    ``not_applied``: effects that are not corrected, with the reason.
    """

    device: str
    compensation: Compensation
    axes_only: bool
    not_applied: Mapping[str, str]

    @property
    def held(self) -> tuple[HeldEffect, ...]:
        """Effects that are undone."""
        return tuple(held for held in self.compensation.effects if held.known.called not in self.not_applied)


def corrections_of(recorded: Recorded, traced: Traced | None = None) -> list[Correction]:
    """Return one correction per device: of the calibration, or with states and effects of an investigation.

    Axes are those in the frame of the device, not as it was mounted. Gyros that the investigation does not have are
    left out. The recording must have a calibration, and ``traced`` a model.
    """
    assert recorded.calibration is not None
    gyros, model = list(recorded.calibration.gyros), recorded.calibration.model
    if traced is not None:
        assert traced.model is not None
        model = traced.model.text()
        labelled = zip(gyros, recorded.labels, strict=True)
        gyros = [_augmented(gyro, label, traced) for gyro, label in labelled if label in traced.names]
    arrays = {name: data.own_array for name, data in recorded.recording.sources.items()}
    return [_correction(device, own, arrays, model) for device, own in _by_device(gyros).items()]


def _by_device(gyros: Sequence[GyroCalibration]) -> dict[str, list[GyroCalibration]]:
    found: dict[str, list[GyroCalibration]] = {}
    for gyro in gyros:
        found.setdefault(gyro.device or gyro.source, []).append(gyro)
    return found


def _augmented(gyro: GyroCalibration, label: str, traced: Traced) -> GyroCalibration:
    """Return the gyro ``label`` with the states and effects of the investigation, which must hold it and a model.

    An effect that the investigation does not have for this gyro is 0. The effects have no uncertainty, and the states
    keep that of ``gyro``.
    """
    assert traced.model is not None
    model, none = traced.model.effects, (0.0, 0.0)
    found = {k.called: k.found.get(ALL if k.shared else label, [none] * len(k.sizes)) for k in model}
    effects = tuple(
        EffectValue(
            effect=known.called,
            parameter=size.name,
            value=value,
            sd=0.0,
            unit=size.unit,
            expected_sd=size.sd,
            shared=known.shared,
        )
        for known in model
        for size, (value, _) in zip(known.sizes, found[known.called], strict=True)
    )
    return replace(gyro, states=traced.states[traced.names.index(label)], effects=effects)


def _correction(device: str, gyros: list[GyroCalibration], arrays: Mapping[str, SensorArray], model: str) -> Correction:
    """Return the correction of one device by the error model ``model`` (TOML), of gyros with ``arrays`` by source.

    ``axes_only`` if the gyros do not span space: then effects that need the body rate are not applied either.
    ``not_applied`` has the reason for each effect that cannot be undone.
    """
    compensation = Compensation.of(gyros, arrays, model)
    try:
        axes_only = not compensation.solution.size
    except CompensationError:
        axes_only = True
    not_applied = dict(compensation.left_out)
    if axes_only:
        of_the_body = [h for h in compensation.effects if h.acts in (Acts.RATE, Acts.MOTION)]
        not_applied |= {held.known.called: "the rate of the body is not known" for held in of_the_body}
    return Correction(device, compensation, axes_only, not_applied)


def formula_of(effect: HeldEffect) -> Markup:
    """Return what an effect adds to the outputs as HTML, with a factor a for each of its terms, numbered if several.

    Laws are typeset as mathematics; those that an investigation constructed stand as code.
    """
    known = effect.known
    shown = "<code>{}</code>" if known.record is CONSTRUCTED else "{}"
    terms = [term.strip() for term in (known.law or str(escape(known.record.formula))).split(";")]
    if known.law and known.record is not CONSTRUCTED:
        terms = list(map(_typeset, terms))
    subs = [f"<sub>{n}</sub>" if len(terms) > 1 else "" for n in range(1, len(terms) + 1)]
    return Markup(" + ".join(f"<var>a</var>{sub} {shown.format(term)}" for sub, term in zip(subs, terms, strict=True)))


_SIGNS: Mapping[str, str | Callable[[re.Match[str]], str]] = {
    r"-expm1\((.*)\)": r"(1 - exp(\1))",
    r"abs\(([^()]*)\)": r"|\1|",
    r" ?\*\* ?(\w+)": r"<sup>\1</sup>",
    r" ?\* ?": " ",
    "-": "−",
    r"\bTdot\b": "dT/dt",
    rf"\b({'|'.join(map(re.escape, VARIABLES))})\b": lambda found: _letter(found[1]),
}


def _typeset(law: str) -> str:
    """Return a law as mathematics in HTML; laws hold no characters special to HTML."""
    for pattern, sign in _SIGNS.items():
        law = re.sub(pattern, sign, law)
    return law


def _letter(name: str) -> str:
    return f"<var>{name[0]}</var>" + (f"<sub>{name[1:].lstrip('_')}</sub>" if name[1:] else "")


_MORE = {
    "u": ", found by iteration",
    "Tdot": f", taken over {SLOPE_S:g} s",
    "t": ", from switching on",
    **dict.fromkeys(("a", "aj", "ak", "jolt"), ", a difference of two samples"),
}


def variables_of_laws(effects: Sequence[HeldEffect]) -> list[str]:
    """Return the meanings of the variables in the laws of effects."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}{_MORE.get(name, '')}" for name in sorted(names)]


def snippet(correction: Correction, origin: str) -> str:
    """Return Python code that turns outputs (N, n) into body rates (N, 3), rad/s; ``origin`` becomes its first comment.

    If the correction is ``axes_only``, the result is the rate of each gyro about its axis. Temperature, acceleration
    and time are arguments only where effects need them.
    """
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
        "warms_up": "since" in code,
        "share": f"{LAST_SHARE:g}",
        "iterations": MOST_ITERATIONS,
        "tolerance": TOLERANCE_RPS,
    }
    return rendered("station.report", "snippet.jinja", values)


def _of(correction: Correction, acts: Acts) -> Iterator[str]:
    """Yield the expressions of the effects that act at this place of the chain."""
    for effect in correction.held:
        if effect.acts is acts:
            table, law = _constant(correction, effect), effect.known.law
            terms = law_terms(law, _ROWS, _called) if law else ["slope(left, t_s)"]  # a lag of the output
            yield f"({' + '.join(f'{table}[:, {n}] * {term}' for n, term in enumerate(terms))})"


def _called(name: str, inner: str, constant: str) -> str:
    """Return the call of a law's function ``name`` in the code, on arrays.

    ``inner`` is its argument as code, ``constant`` its number: a power, a lag in s, a width of play, or a limit, which
    may be empty. Other functions are NumPy's.
    """
    if name == "pow":
        return f"({inner} ** {constant})"
    if name == "lag":
        return f"follow({inner}, np.exp(-{_STEPS} / {constant}), np.inf)"
    if name == "play":
        return f"follow({inner}, np.ones(len(left)), 0.5 * {constant})"
    return f"last({inner}, {constant or None})" if name == "last" else f"np.{name}({inner})"


def _tables(correction: Correction, code: str) -> dict[str, Floats]:
    """Return the arrays that ``code`` needs, by their names in it.

    Always there are the biases (n,), and the sensitivities (n, 3) or, of gyros that do not span space, the gains (n,).
    The others are axes (n, 3), and the values of each effect (n, parameters).
    """
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
