"""Sign and scale of foreign gyros, taken from the data where the mapping asks for it and told where it does not."""

from dataclasses import replace

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.array import SensorArray, sensor_array
from estimator.geometry.kinematics import axis_text
from estimator.geometry.model import Prior
from estimator.importing.gains import Gain, gain_notes, gains
from estimator.importing.mapping.mapping import GyroColumns
from estimator.recordings.recording import ImuData, Recording
from estimator.types import Floats

_WIDER = 2.0  # a prior from the data is this many times what they show
_NARROW = 0.1  # factors nearer to 1 are scale factor errors, left to k and its usual prior


def fitted(recording: Recording, source: str, gyro: GyroColumns) -> tuple[Recording, list[str], Floats | None]:
    """Return the recording with signs and scales as asked for, what is to be told, and the factors applied (m,).

    Raises RecordingError if a gyro follows the rate about another axis than the mapping states.
    """
    found = gains(recording, source)
    notes: list[str] = []
    factors = None
    if gyro.sign_from_data or gyro.scale_from_data:
        data = recording.sources[source]
        signs = _signs(data.array, found, notes) if gyro.sign_from_data else np.ones(len(data.array))
        factors = _factors(data.array, found, gyro, notes) if gyro.scale_from_data else None
        data = replace(
            data,
            array=_turned(data.array, signs),
            rate_rps=data.rate_rps if factors is None else data.rate_rps * factors,
        )
        recording = replace(recording, sources={source: data})
        found = gains(recording, source)
    data = recording.sources[source]
    told = gain_notes(data.array.names, data.array.p, found, gyro.columns.scale)
    if any(gain is not None and gain.mixed_up for gain in found):
        raise RecordingError("; ".join(told))
    notes += told
    return replace(recording, sources={source: replace(data, prior=_prior(data, found))}), notes, factors


def _signs(array: SensorArray, found: list[Gain | None], notes: list[str]) -> Floats:
    signs = np.ones(len(array))
    for i, (name, gain) in enumerate(zip(array.names, found, strict=True)):
        if gain is None or not gain.told:
            notes.append(f"{name}: the motion does not tell its sign, which is taken as stated")
        elif gain.factor < 0:
            signs[i] = -1.0
            notes.append(f"{name}: its output is opposite to the stated axis: {axis_text(-array.p[i])} is taken")
    return signs


def _factors(array: SensorArray, found: list[Gain | None], gyro: GyroColumns, notes: list[str]) -> Floats:
    """Return by what each output is multiplied (m,), rounded: the rest is the scale factor error."""
    size_dps = float(np.degrees(gyro.columns.scale)) if gyro.columns.raw else 1.0
    own = [abs(1 / gain.factor) if gain and gain.told and gain.factor else np.nan for gain in found]
    others = float(np.nanmedian(own)) if np.isfinite(own).any() else 1.0
    factors = np.empty(len(array))
    for i, (name, factor) in enumerate(zip(array.names, own, strict=True)):
        taken = factor if np.isfinite(factor) else others
        if abs(taken - 1) < _NARROW:
            factors[i] = 1.0
            continue
        size = float(f"{size_dps * taken:.3g}")
        factors[i] = size / size_dps
        how = "from the data" if np.isfinite(factor) else "as of the others: the motion does not tell it"
        what = f"one count is {size:g} deg/s" if gyro.columns.raw else f"its output is multiplied by {size:g}"
        notes.append(f"{name}: {what}, {how}")
    return factors


def _turned(array: SensorArray, signs: Floats) -> SensorArray:
    if (signs > 0).all():
        return array
    return sensor_array(array.p * signs[:, None], names=array.names, part_of_array=True)


def _prior(data: ImuData, found: list[Gain | None]) -> Prior:
    """Return the usual prior, wider where factor or offset of a gyro is far beyond it and would be pulled."""
    usual = data.prior
    off = max((abs(g.factor - 1) for g in found if g is not None and g.told), default=0.0)
    offset = [float(np.abs(g.offset_rps)) for g in found if g is not None and g.told]
    offset += [abs(float(np.nanmean(data.rate_rps[:, i]))) for i, g in enumerate(found) if g is None or not g.told]
    return Prior(
        max(usual.k, _WIDER * off if off > _NARROW else 0.0), max(usual.b_rps, _WIDER * max(offset)), usual.sigma_rad
    )
