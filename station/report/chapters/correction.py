"""The correction of each device, by ``estimator.calibration.compensation``: what is undone, what is not, in letters."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from markupsafe import Markup, escape

from estimator.calibration.compensation import Compensation, CompensationError, HeldEffect
from estimator.calibration.values import EffectValue, GyroCalibration
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.effect import Acts
from estimator.effects.law import VARIABLES, variables_of
from estimator.geometry.array import SensorArray
from station.report.figures import ONE, figure
from station.report.recorded import Recorded
from station.report.traced import Traced, found_of


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """The correction of one device. ``axes_only``: its gyros do not tell a body rate, only rates about their own axes.

    ``not_applied``: effects that are not undone, with the reason.
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
    if axes_only:
        of_the_body = [h for h in compensation.effects if h.acts in (Acts.RATE, Acts.MOTION)]
        not_applied |= {held.known.called: "the rate of the body is not known" for held in of_the_body}
    return Correction(device, compensation, axes_only, not_applied)


def origin(recorded: Recorded, data_sha256: str, title: str) -> str:
    """Return the comment that Python for a device begins with."""
    return f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}\n{title}"


def gains(one: Correction, gyro: int) -> list[Markup]:
    """Return the row of the sensitivity of a gyro, or what it has of the rate about its own axis."""
    compensation = one.compensation
    values = [1 - compensation.states[gyro, 0]] if one.axes_only else compensation.sensitivity[gyro].tolist()
    return [figure(float(value), ONE, f"{value:.7f}".replace("-", "−")) for value in values]


def formula_of(effect: HeldEffect) -> Markup:
    """Return what an effect adds to the outputs, with a factor a for each of its terms."""
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
    """Return a law, which holds no sign that HTML knows, as mathematics."""
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
    """Return what the variables mean in the laws of effects."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}{_MORE.get(name, '')}" for name in sorted(names)]
