"""How often the table must be read to see each ramp, and which links are too slow for it."""

from station.errors import sentence
from station.scripts.script import Script

_READINGS_A_RAMP = 20
_FEWEST = 3  # readings needed for a ramp's slope
MARGIN_S = 0.1
"""By which a ramp may come earlier or later than it is planned."""


def wanted_hz(length_s: float) -> float:
    """Return how often the table should be read during a ramp of this length."""
    return _READINGS_A_RAMP / length_s if length_s > 0 else 0.0


def too_steep(script: Script, read_s: float) -> list[str]:
    """Return a sentence for each step with a ramp that is too short for a table that takes ``read_s`` to read an axis.

    A ramp needs three readings; of several ramps of steps with the same label the last counts.
    """
    steep: dict[str, float] = {}
    for timed in script.timeline():
        for _, turn in timed.turns():
            if 0 < turn.ramp_s < _FEWEST * read_s:
                steep[timed.step.label] = turn.ramp_s
    return [sentence("script.steep", step=label, length_s=length_s, read_s=read_s) for label, length_s in steep.items()]
