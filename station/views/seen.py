"""Conditions that sources went through in a recording: temperatures, rates, sampling."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from estimator.recordings.recording import ImuData


@dataclass(frozen=True, slots=True)
class Seen:
    """Conditions of a calibration: temperature (lowest, mean, highest; NaN if not recorded), rates, sampling.

    ``largest_rps`` is the largest output of the gyros, ``rate_hz`` their sampling rate.
    """

    temperature_c: tuple[float, float, float]
    largest_rps: float
    rate_hz: float


def seen_by(sources: Iterable[ImuData]) -> Seen:
    """Return the conditions of these sources together: least, mean and largest temperature, largest rate, sample rate.

    They are in deg C, rad/s and Hz; the mean is over all samples. Temperatures are NaN if none is recorded, the sample
    rate, the highest of the sources, if it is not known. Rates that are not finite do not count; without any the
    largest, which has no sign, is 0. ValueError without a source.
    """
    used = list(sources)
    temperatures = [data.temperature_c for data in used if data.temperature_c is not None]
    known = np.concatenate([t[np.isfinite(t)] for t in temperatures]) if temperatures else np.empty(0)
    span = (float(known.min()), float(known.mean()), float(known.max())) if len(known) else (float("nan"),) * 3
    outputs = [np.abs(data.rate_rps[np.isfinite(data.rate_rps)]).max(initial=0.0) for data in used]
    periods = [float(np.median(np.diff(data.t_ns))) * 1e-9 for data in used if len(data.t_ns) > 1]
    fastest = 1 / min(periods) if periods and min(periods) > 0 else float("nan")
    return Seen((span[0], span[1], span[2]), float(max(outputs)), fastest)
