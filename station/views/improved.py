"""A script that ``station plan --improve`` found, and what it was to reach."""

from dataclasses import dataclass

from drivers.types import Floats
from station.scripts.script import Script
from station.scripts.script_search import FoundScript

_AFTER_MOVE_S = 0.05  # the sequencer asks for the arrival when it is due, and again after this time


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Wanted:
    """The goal: sigmas of gyros (n, 4), and of states and places of accelerometers (m, 7), infinite where none is
    required; the time given, or None for the least time.

    ``poses`` is how many attitudes a script for accelerometers has at least.
    """

    sd: Floats
    force_sd: Floats
    total_s: float | None
    rest_s: float
    poses: int
    criterion: str
    one_way: bool


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Improved:
    """The script found, its goal, and the duration of the search.

    ``gyros`` and ``accelerometers`` are (device, name).
    """

    before: Script
    wanted: Wanted
    found: FoundScript
    gyros: tuple[tuple[str, str], ...]
    accelerometers: tuple[tuple[str, str], ...]
    search_s: float

    @property
    def with_sequencer_s(self) -> float:
        """Duration of the script, including the pauses of the sequencer."""
        script = self.found.script
        return script.least_s + _AFTER_MOVE_S * sum(step.turns for step in script.steps)
