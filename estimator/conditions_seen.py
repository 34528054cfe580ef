"""Under which conditions a recording was made, in words: states hold for these."""

from __future__ import annotations

import numpy as np

from estimator.arrays import Floats
from estimator.recording import Recording
from estimator.reference import AttitudeReadings, TableReadings, Turns, rates_from_attitude


def holds_for(recording: Recording) -> str:
    """Return rates and directions that were gone through, temperatures, and times since the start."""
    low, high = _rates_dps(recording)
    if max(-low.min(), high.max()) < 0.5:
        said = ["rest"]
    else:
        ranges = [f"{_whole(a)} to {_whole(b)} about {axis}" for a, b, axis in zip(low, high, "xyz", strict=True)]
        ways = [axis for a, b, axis in zip(low, high, "xyz", strict=True) if (a < -0.5) != (b > 0.5)]
        one_way = f" ({', '.join(ways)} in one direction)" if ways else ""
        said = [f"rates of {', '.join(ranges)} deg/s{one_way}"]
    sources = recording.sources.values()
    warmth = [c[np.isfinite(c)] for c in (data.temperature_c for data in sources) if c is not None]
    known = np.concatenate(warmth) if warmth else np.empty(0)
    said.append(f"{known.min():.1f} to {known.max():.1f} degC" if len(known) else "the temperature that it had")
    span_s = max(float(data.t_ns.max() - data.t_ns.min()) for data in sources if len(data.t_ns)) * 1e-9
    said.append(f"0 to {span_s:.0f} s after its start")
    return "; ".join(said)


def _rates_dps(recording: Recording) -> tuple[Floats, Floats]:
    """Return the least and the largest rate about each axis (3,) in deg/s: of a table about its own axes."""
    reference = recording.reference
    low, high = np.zeros(3), np.zeros(3)
    if isinstance(reference, TableReadings):
        for axis, rate in zip(reference.gimbals, reference.rate_rps.T, strict=True):
            column = "xyz".index(axis)
            low[column], high[column] = _limits(rate)
    else:
        if isinstance(reference, Turns):
            seconds = (reference.t_end_ns - reference.t_start_ns)[:, None] * 1e-9
            rates = reference.turn_rad / np.maximum(seconds, 1e-9)
        else:
            rates = (rates_from_attitude(reference) if isinstance(reference, AttitudeReadings) else reference).rate_rps
        for column, rate in enumerate(rates.T):
            low[column], high[column] = _limits(rate)
    return np.degrees(low), np.degrees(high)


def _limits(rate: Floats) -> tuple[float, float]:
    """Return the range that holds all but a thousandth of rates (k,) at each end, and rest."""
    known = rate[np.isfinite(rate)]
    if not len(known):
        return 0.0, 0.0
    low, high = np.quantile(known, [0.001, 0.999])
    return min(float(low), 0.0), max(float(high), 0.0)


def _whole(rate_dps: float) -> str:
    return f"{rate_dps + 0.0:.0f}" if abs(rate_dps) >= 10 or abs(rate_dps) < 0.05 else f"{rate_dps:.1f}"
