"""How far each gyro's output follows the reference: its factor, and a wrong axis, sign or scale.

Sign and scale are taken from the data where the mapping asks for it, and told where it does not.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.errors import RecordingError
from estimator.estimation.gram import Gram
from estimator.geometry.array import SensorArray, sensor_array
from estimator.geometry.kinematics import axis_text
from estimator.geometry.model import Prior
from estimator.importing.mapping.columns import UNITS
from estimator.importing.mapping.mapping import GyroColumns
from estimator.observations.alignment import following
from estimator.observations.external import FAR_OFF
from estimator.observations.rows import observations
from estimator.packaged import sentence
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

_LEAST_RPS = float(np.radians(0.2))  # rms of the least useful rotation
_TURNS = 10.0  # times that, of outputs that turn for certain
_TURNED = 1e-3  # share of the largest variance of body rate from which on a direction counts as turned about
_SENSED = 0.5  # share of a sense axis that the turning must span
_FOLLOWS = 0.5  # share of the output's variance that the turning must explain
_UNIT = 0.05  # how near a factor is to the ratio of two units
_ALONG = 0.97  # cosine between the axis from the data and the stated one, below which it is reported
_ANOTHER = 0.7  # the same, beyond which the columns or their axes are mixed up
_WIDER = 2.0  # a prior from the data is this many times their uncertainty
_NARROW = 0.1  # factors nearer to 1 are scale factor errors, left to k and its usual prior


@dataclass(frozen=True, slots=True, eq=False)
class _Gain:
    """One gyro: its output relative to the expected one along its stated axis, and its output at rest in rad/s.

    ``follows`` is the share of the output explained by the rotation, ``axis`` the sense axis (3,) by the data, None if
    near the stated one; ``mixed_up`` if it is too far off for a tilt.
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


def fitted(recording: Recording, source: str, gyro: GyroColumns) -> tuple[Recording, list[str], Floats | None]:
    """Return the recording with signs and scales taken from the data where asked for, notes, and the factors applied
    (m,).

    ``source`` is the only one of the recording, ``gyro`` its mapping. The prior is widened where gyros are far off.
    Factors are None if no scale was asked for. RecordingError if a gyro follows the rate about an axis more than 45 deg
    off the stated one; smaller deviations are noted.
    """
    found, data, notes, factors = _gains(recording, source), recording.sources[source], list[str](), None
    if gyro.sign_from_data or gyro.scale_from_data:
        array = data.array
        if gyro.sign_from_data and ((signs := _signs(array, found, notes)) < 0).any():
            array = sensor_array(array.p * signs[:, None], names=array.names, part_of_array=True)
        if gyro.scale_from_data:
            factors = _factors(array, found, gyro, notes)
            data = replace(data, rate_rps=data.rate_rps * factors)
        data = replace(data, array=array)
        found = _gains(replace(recording, sources={source: data}), source)
    told = _gain_notes(data.array, found, gyro.columns.scale)
    if any(gain is not None and gain.mixed_up for gain in found):
        raise RecordingError("; ".join(told))
    fitting = replace(data, prior=_prior(data, found))
    return replace(recording, sources={source: fitting}), [*notes, *told], factors


def _gains(recording: Recording, source: str) -> list[_Gain | None]:
    """Return the gain of every gyro of a source, from a line or else from rows; None where the motion does not
    show it.
    """
    data = recording.sources[source]
    line = following(data, recording.reference, recording.site)
    if line is None:
        return _of_rows(recording, data)
    variance, directions = np.linalg.eigh(line.turning())
    turned = variance > _TURNED * variance[-1]
    basis = directions[:, turned]
    slow = line.slow_rows()
    shares = line.follows()
    return [
        _gain(p, basis, basis.T @ slow[:, i], float(shares[i]), float(line.rows[0, i]))
        for i, p in enumerate(data.array.p)
    ]


def _gain(p: Floats, basis: Floats, slope: Floats, follows: float, offset_rps: float) -> _Gain | None:
    """Return the gain of a gyro along p (3,), None if the motion does not turn about that.

    ``slope`` (t,) are its slopes in the t directions (3, t) of rotation in ``basis``, ``follows`` the share of its
    output that these explain, ``offset_rps`` its output at rest. If it follows another axis, the gain has that axis,
    and is ``mixed_up`` if that is far off and explains the output.
    """
    sensed = basis.T @ p
    if np.linalg.norm(sensed) < _SENSED:
        return None
    along = float(slope @ sensed) / max(float(np.linalg.norm(slope) * np.linalg.norm(sensed)), 1e-12)
    elsewhere = basis @ slope if basis.shape[1] > 1 and abs(along) < _ALONG else None
    factor = float(slope @ sensed) / float(sensed @ sensed)
    mixed_up = elsewhere is not None and follows >= _FOLLOWS and abs(along) < _ANOTHER
    return _Gain(factor, offset_rps, follows, elsewhere, mixed_up)


def _of_rows(recording: Recording, data: ImuData) -> list[_Gain | None]:
    """Return gains from rows of a reference that cannot show a delay: turns, or a body at rest.

    All are None with fewer than four rows. At rest a gyro has one, of slope 0, only if it reports rotation
    nevertheless.
    """
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
    if variance[-1] < _LEAST_RPS**2:  # a gyro that turns beside a reference at rest is reported
        loud = np.diag(covariance)[3:] > (_TURNS * _LEAST_RPS) ** 2
        return [_Gain(0.0, float(b), 0.0, None) if own else None for b, own in zip(mean[3:], loud, strict=True)]
    turned = variance > _TURNED * variance[-1]
    basis = directions[:, turned]
    found: list[_Gain | None] = []
    for i, p in enumerate(data.array.p):
        cross, own = basis.T @ covariance[:3, 3 + i], float(covariance[3 + i, 3 + i])
        slope = cross / variance[turned]
        follows = float(slope @ cross) / own if own > 0 else 0.0
        found.append(_gain(p, basis, slope, follows, float(mean[3 + i] - mean[:3] @ basis @ slope)))
    return found


def _signs(array: SensorArray, gains: Sequence[_Gain | None], notes: list[str]) -> Floats:
    """Return the sign (m,) of each gyro by the data, 1 where they do not show it; notes on both are appended to
    ``notes``.
    """
    signs = np.ones(len(array))
    for i, (name, gain) in enumerate(zip(array.names, gains, strict=True)):
        if gain is None or not gain.told:
            notes.append(f"{name}: the motion does not show its sign, so the stated sign is used")
        elif gain.factor < 0:
            signs[i] = -1.0
            notes.append(f"{name}: its output is opposite to the stated axis, so {axis_text(-array.p[i])} is used")
    return signs


def _factors(array: SensorArray, gains: Sequence[_Gain | None], gyro: GyroColumns, notes: list[str]) -> Floats:
    """Return the factor (m,) for each output, rounded to three digits; what remains is its scale factor error.

    It is 1 where the output is right to 10 %, and the median of the others where the motion does not show it, 1 if it
    shows none. What was applied is appended to ``notes``.
    """
    size_dps = float(np.degrees(gyro.columns.scale)) if gyro.columns.raw else 1.0
    own = [abs(1 / gain.factor) if gain and gain.told and gain.factor else np.nan for gain in gains]
    others = float(np.nanmedian(own)) if np.isfinite(own).any() else 1.0
    factors = np.empty(len(array))
    for i, (name, factor) in enumerate(zip(array.names, own, strict=True)):
        taken = factor if np.isfinite(factor) else others
        if abs(taken - 1) < _NARROW:
            factors[i] = 1.0
            continue
        size = float(f"{size_dps * taken:.3g}")
        factors[i] = size / size_dps
        how = "from the data" if np.isfinite(factor) else "the same as the others, since the motion does not show it"
        what = f"one count is {size:g} deg/s" if gyro.columns.raw else f"its output is multiplied by {size:g}"
        notes.append(f"{name}: {what}, {how}")
    return factors


def _prior(data: ImuData, gains: Sequence[_Gain | None]) -> Prior:
    """Return one prior for all gyros: the usual one, wider where the largest factor error or offset asks for it.

    ``gains`` has one for each gyro, None if it was not determined. ``k`` becomes at least ``_WIDER`` times the
    largest deviation of a factor from 1 if that is above ``_NARROW``, ``b_rps`` at least ``_WIDER`` times the largest
    offset. A gyro without a meaningful factor counts with its mean output as offset. ``sigma_rad`` is kept.
    """
    usual, told = data.prior, [gain for gain in gains if gain is not None and gain.told]
    off = max((abs(gain.factor - 1) for gain in told), default=0.0)
    offset = [abs(gain.offset_rps) for gain in told]
    offset += [
        abs(float(np.nanmean(y))) for y, g in zip(data.rate_rps.T, gains, strict=True) if g is None or not g.told
    ]
    return Prior(
        max(usual.k, _WIDER * off if off > _NARROW else 0.0), max(usual.b_rps, _WIDER * max(offset)), usual.sigma_rad
    )


def _gain_notes(array: SensorArray, gains: Sequence[_Gain | None], size_rps: float) -> list[str]:
    """Return notes on gyros that do not follow the reference, or whose axis, sign or scale is wrong.

    The notes say what to write in the mapping, the first fault of a gyro only. ``gains`` has one for each gyro, None if
    it was not determined; such gyros get no note. ``size_rps`` is the stated unit of their columns in rad/s.
    """
    notes = []
    for name, axis, gain in zip(array.names, array.p, gains, strict=True):
        if gain is None:
            continue
        if gain.follows < _FOLLOWS:
            notes.append(sentence("importing.not_following", name=name, share=gain.follows))
        elif gain.axis is not None:
            notes.append(
                sentence("importing.another_axis", name=name, axis=axis_text(gain.axis, _ALONG), stated=axis_text(axis))
            )
        elif abs(gain.factor + 1) < FAR_OFF:
            notes.append(
                f"{name}: its output is opposite to the reference (factor {gain.factor:.3f}). Write axis "
                f'{axis_text(-axis)} instead of {axis_text(axis)} in [gyro], or sign = "from data"'
            )
        elif abs(gain.factor - 1) > FAR_OFF:
            sign = ' and sign = "from data"' if gain.factor < 0 else ""
            unit = [
                f", as in {unit}"
                for unit, size in UNITS["rate"].items()
                if abs(size * abs(gain.factor) / size_rps - 1) < _UNIT
            ]
            notes.append(
                sentence("importing.wrong_scale", name=name, factor=gain.factor, unit="".join(unit[:1]), sign=sign)
            )
    return notes
