"""From the outputs of gyros to the rate of their body: the error model undone, sample by sample.

With the sensitivity G (n, 3) of the array, rows (1 - k)(p - sigma_k j + sigma_j k), and the effects e of the error
model, gyros put out ``y = G w - b + e``, so ``w = H (y + b - e)`` with H the inverse of G, by least squares where
there are more gyros than axes. What an effect needs of a sample (temperature, specific force, the samples before it)
must be given; effects of the rate itself are undone by iteration. What remembers the rate, depends on its change, or
jumps where the rate changes sign, is worked out from the rate without it, once (``Acts.MOTION``). No sample is waited
for: rates of change are differences from the sample before, so they lag by half a period.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Self

import numpy as np

from estimator.calibration.error_model import ErrorModel, KnownEffect
from estimator.calibration.gyro import GyroCalibration
from estimator.effects.conditions import REFERENCE_C
from estimator.effects.effect import Acts
from estimator.effects.law import settled
from estimator.errors import EstimatorError
from estimator.geometry.array import TOLERANCE, SensorArray
from estimator.geometry.model import decode, predicted_output
from estimator.packaged import sentence
from estimator.types import Floats

MOST_ITERATIONS = 30
"""After which effects of the rate that are not undone to ``TOLERANCE_RPS`` are beyond what the model can be undone."""
TOLERANCE_RPS = 1e-13

_OF_THAT_TABLE = "it belongs to the axes of the table on which it was found, and is absent elsewhere"


class CompensationError(EstimatorError):
    """Gyros that do not determine a body rate, or samples without data that the effects need."""


@dataclass(frozen=True, slots=True, eq=False)
class HeldEffect:
    """An effect that is corrected, and how it ``acts``; ``values`` (n, p) are its parameters for each gyro, in SI
    units.
    """

    known: KnownEffect
    values: Floats
    acts: Acts

    @property
    def name(self) -> str:
        """Name in the catalogue; that of laws is "constructed"."""
        return self.known.name


@dataclass(frozen=True, slots=True, eq=False)
class Compensation:
    """Everything needed to turn the outputs of n gyros into the rate of their body.

    ``states`` (n, 4) are those of ``model.STATES``. ``delay_s``: stamps of samples are late by that much. ``left_out``
    are effects of the error model that are not corrected, with the reason.
    """

    array: SensorArray
    states: Floats
    effects: tuple[HeldEffect, ...] = ()
    delay_s: float = 0.0
    left_out: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, gyros: Sequence[GyroCalibration], arrays: Mapping[str, SensorArray], model: str = "") -> Self:
        """Return the compensation of calibrated gyros; ``arrays`` are those of their sources, ``model`` the
        calibration's.

        If two gyros have one name, all get that of their device, or else source, in front. A delay of the stamps
        becomes ``delay_s``. Effects of a table's axes or base, and those whose record says so, are ``left_out``.
        ModelError for a model of another version, CompensationError for an effect that this version cannot correct.
        """
        known = {effect.called: effect for effect in ErrorModel.parse(model, "calibration").effects} if model else {}
        effects: list[HeldEffect] = []
        left_out: dict[str, str] = {}
        delay_s = 0.0
        listed = gyros[0].effects if gyros else ()
        for called, group in groupby(range(len(listed)), key=lambda number: listed[number].effect):
            columns = list(group)
            values = np.array([[gyro.effects[column].value for column in columns] for gyro in gyros])
            effect = known[called]
            acts = effect.effect(()).acts
            if acts is Acts.STAMPS:
                delay_s += float(values[0, 0])
            elif effect.record.left_out:
                left_out[called] = effect.record.left_out
            elif effect.of_the_table:
                left_out[called] = _OF_THAT_TABLE
            elif acts is None:
                raise CompensationError(f"the calibration has the effect {called}, which this version cannot correct")
            else:
                effects.append(HeldEffect(effect, values, acts))
        return cls(_joined(gyros, arrays), np.array([g.states for g in gyros]), tuple(effects), delay_s, left_out)

    @property
    def bias_rps(self) -> Floats:
        """Biases b (n,), to be added to the outputs."""
        return self.states[:, 1]

    @property
    def sensitivity(self) -> Floats:
        """Sensitivity G (n, 3): outputs per body rate."""
        return (predicted_output(self.array, self.states, np.eye(3)) + self.bias_rps).T

    @property
    def solution(self) -> Floats:
        """Inverse H (3, n) of the sensitivity; CompensationError if the gyros do not span space."""
        g = self.sensitivity
        if len(g) < 3 or np.linalg.svd(g, compute_uv=False)[2] < TOLERANCE:
            raise CompensationError(sentence("calibration.no_solution", names=", ".join(self.array.names)))
        return np.asarray(np.linalg.pinv(g))

    def held(self, name: str) -> Floats | None:
        """Return the parameters (n, p) of an effect that there is once at most, None if there is none."""
        return next((effect.values for effect in self.effects if effect.name == name), None)

    def simplified(self, keep: Collection[str], temperature_c: float) -> tuple[Self, dict[str, str]]:
        """Return a compensation with only the effects ``keep``, and for each other effect why it is left out.

        ``keep`` has names in the catalogue; the reasons are by ``KnownEffect.called``. Of effects of the temperature
        the constants then include the value at ``temperature_c`` (NaN: that of the reference), and a warm-up is over.
        An effect without such a steady value is dropped uncorrected.
        """
        g, b = self.sensitivity, self.bias_rps.copy()
        above = temperature_c - REFERENCE_C if np.isfinite(temperature_c) else 0.0
        held, dropped = [], {}
        for effect in self.effects:
            if effect.name in keep:
                held.append(effect)
                continue
            steady = settled(effect.known.law, above) if effect.known.law else None
            if steady is None:
                why = "it is not corrected"
            else:
                of_bias, of_gain = (effect.values @ part for part in steady)
                b -= of_bias
                g = g + of_gain[:, None] * self.array.p
                of_temperature = "temperature" in effect.known.effect(()).needs
                why = f"its part at {REFERENCE_C + above:.4g} degC is in the constants"
                why = why if of_temperature else "the bias is that after it"
            dropped[effect.known.called] = why
        p, j, k = (np.einsum("ij,ij->i", g, axes) for axes in (self.array.p, self.array.j, self.array.k))
        x = np.stack([1 - p, b, k, -j], axis=1)
        states = np.array([decode(row, np.zeros((4, 4)))[0] for row in x])
        return replace(self, states=states, effects=tuple(held)), dropped


def _joined(gyros: Sequence[GyroCalibration], arrays: Mapping[str, SensorArray]) -> SensorArray:
    """Return the gyros of all sources as one array.

    If a name comes twice, all get their device, or else source, in front. ``arrays`` are by source.
    """
    names = [gyro.name for gyro in gyros]
    if len(set(names)) < len(names):
        names = [f"{gyro.device or gyro.source} {gyro.name}" for gyro in gyros]
    parts = [arrays[gyro.source].select([arrays[gyro.source].names.index(gyro.name)]) for gyro in gyros]
    p, j, k = (np.vstack([getattr(part, axis) for part in parts]) for axis in "pjk")
    return SensorArray(tuple(names), p, j, k)
