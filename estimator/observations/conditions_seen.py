"""The conditions of a recording in words: states hold for these."""

import numpy as np

from estimator.recordings.recording import Recording
from estimator.types import Floats

_STILL_DPS = 0.5


def holds_for(recording: Recording) -> str:
    """Return a text on the rates, directions, temperatures and times after the start that a recording covers.

    It says "rest" for all rates below ``_STILL_DPS``, names axes that turn in one direction only, and says so if no
    temperature was recorded. The time is that of the longest source.
    """
    ranges = [_limits(np.degrees(rate)) for rate in _rates_rps(recording)]
    if max(max(-low, high) for low, high in ranges) < _STILL_DPS:
        said = ["rest"]
    else:
        about = [f"{low:.3g} to {high:.3g} deg/s about {axis}" for (low, high), axis in zip(ranges, "xyz", strict=True)]
        ways = [a for (low, high), a in zip(ranges, "xyz", strict=True) if (low < -_STILL_DPS) != (high > _STILL_DPS)]
        said = [f"rates of {', '.join(about)}" + (f" ({', '.join(ways)} in one direction)" if ways else "")]
    sources = recording.sources.values()
    known = np.concatenate([np.empty(0), *(d.temperature_c for d in sources if d.temperature_c is not None)])
    known = known[np.isfinite(known)]
    said.append(f"{known.min():.1f} to {known.max():.1f} degC" if len(known) else "an unrecorded temperature")
    span_s = max(float(data.t_ns.max() - data.t_ns.min()) for data in sources if len(data.t_ns)) * 1e-9
    return "; ".join([*said, f"0 to {span_s:.0f} s after the start"])


def _rates_rps(recording: Recording) -> list[Floats]:
    """Return three arrays of rates (k,), about x, y, z: of a table's axes, of turns, of a reference, else of the gyros.

    Those of turns are mean rates; lost ones of a reference or a gyro are NaN. An axis that a table does not have rests:
    its array is a single 0. Of several sources the gyros of the first give the rates.
    """
    table = recording.table
    rates = recording.reference.external_rates()
    if table is not None:
        of_axis = dict(zip(table.gimbals, table.rate_rps.T, strict=True))
        return [of_axis.get(axis, np.zeros(1)) for axis in "xyz"]
    if recording.turns is not None:
        return list(recording.turns.mean_rates_rps.T)
    if rates is not None:
        return list(rates.rate_rps.T)
    data = next(iter(recording.sources.values()))  # between poses only the gyros measure
    return list((data.rate_rps @ np.linalg.pinv(data.array.p).T).T)


def _limits(rate: Floats) -> tuple[float, float]:
    """Return the range of rates (k,) without a thousandth at each end, widened to include rest; to a tenth."""
    known = rate[np.isfinite(rate)]
    low, high = np.quantile(known, [0.001, 0.999]) if len(known) else (0.0, 0.0)
    return min(round(float(low), 1), 0.0) + 0.0, max(round(float(high), 1), 0.0) + 0.0
