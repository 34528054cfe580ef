"""The time offset between samples and table readings, a state of every run.

The ramps of a run tell it. What is expected of it before is what links and devices say: readings are known to half of
their round trip, the table's stated timing, and the delays that nobody states.
"""

from dataclasses import dataclass

import numpy as np

from estimator.types import Stamps

_UNSTATED_S = 0.02
"""Delays of links, drivers and filters that nobody states, one standard deviation."""


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """By how much samples are later than the readings of the table, in s, with its standard uncertainty.

    A delay within the gyros is part of it.
    """

    offset_s: float
    sd_s: float


def expected_sd_s(timing_s: float = 0.0, half_width_ns: Stamps | None = None) -> float:
    """Return the expected standard deviation of a time offset about zero, in s.

    ``timing_s`` is the table's stated uncertainty, ``half_width_ns`` (k,) half of the round trips of its readings.
    """
    half_s = float(np.median(half_width_ns)) * 1e-9 if half_width_ns is not None and len(half_width_ns) else 0.0
    return float(np.sqrt(_UNSTATED_S**2 + timing_s**2 + half_s**2 / 3))
