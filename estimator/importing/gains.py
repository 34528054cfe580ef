"""How far each gyro's output follows the reference: its factor, and an axis, a sign or a scale that is wrong."""

from dataclasses import dataclass

import numpy as np

from estimator.estimation.gram import Gram
from estimator.geometry.kinematics import axis_text
from estimator.importing.mapping.columns import UNITS
from estimator.observations.foreign import FAR_OFF
from estimator.observations.rows import observations
from estimator.recordings.recording import Recording
from estimator.types import Floats

_LEAST_RPS = float(np.radians(0.2))  # rms of a turning that tells anything
_TURNS = 10.0  # times that, of outputs that turn for certain
_TURNED = 1e-3  # share of the largest variance of body rate from which on a direction counts as turned about
_SENSED = 0.5  # share of a sense axis that the turning must span
_FOLLOWS = 0.5  # share of the output's variance that the turning must explain
_UNIT = 0.05  # how near a factor is to the ratio of two units
_ALONG = 0.97  # cosine between the axis that the data show and the stated one, beyond which it is told
_ANOTHER = 0.7  # the same, beyond which the columns or their axes are mixed up


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """One gyro: output over what its stated axis calls for, and its output at rest in rad/s.

    ``follows`` is the share of the output that the turning explains, ``axis`` where the data show the sense axis
    (3,), None near the stated line; ``mixed_up`` if that is so far from it that no tilt explains it.
    """

    factor: float
    offset_rps: float
    follows: float
    axis: Floats | None
    mixed_up: bool = False

    @property
    def told(self) -> bool:
        """Whether the factor means anything."""
        return self.follows >= _FOLLOWS and self.axis is None


def gains(recording: Recording, source: str) -> list[Gain | None]:
    """Return the gain of every gyro of a source; None where the motion does not tell it."""
    data = recording.sources[source]
    m = len(data.array)
    gram = Gram.empty(m)
    for part in observations(recording, data):
        gram += Gram.of(part.w_rps, part.y_rps, part.weight)
    total = gram.products[0, 0]
    if gram.rows < 4 or not total > 0:
        return [None] * m
    mean = gram.products[0, 1:] / total
    covariance = gram.products[1:, 1:] / total - np.outer(mean, mean)
    variance, directions = np.linalg.eigh(covariance[:3, :3])
    if variance[-1] < _LEAST_RPS**2:  # who turns beside a reference that does not is told
        loud = np.diag(covariance)[3:] > (_TURNS * _LEAST_RPS) ** 2
        return [Gain(0.0, float(b), 0.0, None) if own else None for b, own in zip(mean[3:], loud, strict=True)]
    turned = variance > _TURNED * variance[-1]
    basis = directions[:, turned]
    found: list[Gain | None] = []
    for i, p in enumerate(data.array.p):
        cross, own = basis.T @ covariance[:3, 3 + i], float(covariance[3 + i, 3 + i])
        slope = cross / variance[turned]
        sensed = basis.T @ p
        if np.linalg.norm(sensed) < _SENSED:
            found.append(None)
            continue
        follows = float(slope @ cross) / own if own > 0 else 0.0
        along = float(slope @ sensed) / max(float(np.linalg.norm(slope) * np.linalg.norm(sensed)), 1e-12)
        elsewhere = basis @ slope if turned.sum() > 1 and abs(along) < _ALONG else None
        factor = float(slope @ sensed) / float(sensed @ sensed)
        offset = float(mean[3 + i] - mean[:3] @ basis @ slope)
        mixed_up = elsewhere is not None and follows >= _FOLLOWS and abs(along) < _ANOTHER
        found.append(Gain(factor, offset, follows, elsewhere, mixed_up))
    return found


def gain_notes(names: tuple[str, ...], p: Floats, found: list[Gain | None], size_rps: float) -> list[str]:
    """Return what is wrong with sign, scale or axis of each gyro, and what to write in the mapping.

    ``size_rps`` is that of the unit of their columns.
    """
    notes = []
    for name, axis, gain in zip(names, p, found, strict=True):
        if gain is None:
            continue
        if gain.follows < _FOLLOWS:
            notes.append(
                f"{name}: its output hardly follows the reference ({gain.follows:.0%} of its variance): check columns, "
                "axes, and that gyro and reference belong to the same times (two files: offset_s)"
            )
        elif gain.axis is not None:
            notes.append(
                f"{name}: its output follows the body rate about {axis_text(gain.axis, 0.95)}, not about "
                f"{axis_text(axis)} as stated: check axes and the order of columns in [gyro]"
            )
        elif abs(gain.factor + 1) < FAR_OFF:
            notes.append(
                f"{name}: its output is opposite to the reference (factor {gain.factor:.3f}): write axis "
                f'{axis_text(-axis)} in place of {axis_text(axis)} in [gyro], or sign = "from data"'
            )
        elif abs(gain.factor - 1) > FAR_OFF:
            sign = ' and sign = "from data"' if gain.factor < 0 else ""
            unit = [
                f", as in {unit}"
                for unit, size in UNITS["rate"].items()
                if abs(size * abs(gain.factor) / size_rps - 1) < _UNIT
            ]
            notes.append(
                f"{name}: its output is {gain.factor:.3g} times what the reference says{''.join(unit[:1])}: check unit "
                f'and count in [gyro], or write scale = "from data"{sign}'
            )
    return notes
