"""What C and Python say alike of the correction function: its arguments, and what is left to its user."""

from __future__ import annotations

import numpy as np

from estimator.compensation import SLOPE_S
from station.exporting.exported import Exported
from station.exporting.terms import Terms
from station.exporting.written import delay_line, lines_of


def argument_names(terms: Terms) -> list[str]:
    """Return what the function is given of a sample, in order; ``arguments_said`` says what each is."""
    warm = terms.uses("warmth") or terms.uses("slope")
    asked = {"rate_rps": True, "temperature_c": warm, "accel": terms.uses("accel"), "dt_s": terms.keeps_state}
    return [name for name, needed in asked.items() if needed]


def arguments_said(exported: Exported, terms: Terms) -> list[str]:
    """Return a line for each argument of the function, and what holds of them."""
    said = {
        "rate_rps": f"outputs of {', '.join(exported.compensation.array.names)}, in this order, in rad/s",
        "temperature_c": "temperature of the gyros, in degC",
        "accel": "specific force along body x, y, z, in m/s2 (at rest it points up)",
        "dt_s": "time since the sample before, in s",
    }
    lines = [f"{name}: {said[name]}" for name in argument_names(terms)]
    if terms.of_the_rate:
        largest = np.degrees(exported.seen.largest_rps)
        lines.append(f"Effects of the rate were found up to {largest:.4g} deg/s; beyond they are extrapolated.")
    if terms.uses("slope"):
        lines.append(f"The slope of the temperature is taken over {SLOPE_S:g} s.")
    if terms.uses("wdot"):
        lines.append("Angular accelerations are differences of two samples, half a period late.")
    return lines


def cautions(exported: Exported, terms: Terms) -> list[str]:
    """Return what of the calibration the function does not undo, and what undoing costs."""
    lines = [*lines_of(exported.compensation.left_out), *delay_line(exported)]
    if terms.lag is not None and np.isfinite(exported.seen.rate_hz):
        share = float(terms.lag.values.max()) * exported.seen.rate_hz
        lines.append(
            f"bandwidth: the lag is undone by differences of samples, which at {exported.seen.rate_hz:.6g} samples a "
            f"second makes the noise {np.hypot(1 + share, share):.2g} times as large"
        )
    return lines
