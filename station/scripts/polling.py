"""How often the table is read: so often that each ramp is seen, and what a link is too slow for."""

import math

from station.errors import sentence
from station.scripts.script import Rest, Script

_READINGS_A_RAMP = 20
_FEWEST = 3  # readings that tell a ramp's slope
MARGIN_S = 0.1
"""By which a ramp may come earlier or later than it is planned."""


def ramp_s(rate_rps: float, acceleration_rps2: float, way_rad: float) -> float:
    """Return how long a ramp of a move takes, which may be too short to reach its rate."""
    return min(abs(rate_rps) / acceleration_rps2, math.sqrt(abs(way_rad) / acceleration_rps2))


def wanted_hz(length_s: float) -> float:
    """Return how often the table should be read during a ramp of this length."""
    return _READINGS_A_RAMP / length_s if length_s > 0 else 0.0


def too_steep(script: Script, read_s: float) -> list[str]:
    """Return, in words, the ramps that are over before a table that takes so long to read has been read enough."""
    steep: dict[str, float] = {}
    for timed in script.timeline():
        if not isinstance(step := timed.step, Rest):
            length_s = ramp_s(step.rate_rps, step.acceleration_rps2, timed.to_rad - timed.from_rad)
            if 0 < length_s < _FEWEST * read_s:
                steep[step.label] = length_s
    return [sentence("script.steep", step=label, length_s=length_s, read_s=read_s) for label, length_s in steep.items()]
