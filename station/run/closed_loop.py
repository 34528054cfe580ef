"""Results of a loop on the bench: its runs, its investigations, its table time."""

from dataclasses import dataclass, field
from pathlib import Path

from estimator.tracing.investigation import Investigation
from station.run.outcome import Verdict
from station.run.session import Result
from station.scripts.next_script import NextScript
from station.scripts.script import Script

CALIBRATION, EXPLORATION, VERIFICATION, NEXT = "calibration", "exploration", "verification", "next"


@dataclass(frozen=True, slots=True)
class Driven:
    """One run of the loop: its purpose, its result, the table time it took."""

    purpose: str
    script: Script
    result: Result
    table_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """One investigation, the number of runs before it, and the script that would decide what it leaves open."""

    runs: int
    investigation: Investigation
    following: NextScript | None
    script_file: Path | None


@dataclass(slots=True, eq=False)
class Loop:
    """The state of a loop.

    ``ended`` says why it stopped; ``stopped`` is the verdict of a run that was aborted or in fault.
    """

    folder: Path
    budget_s: float
    runs: list[Driven] = field(default_factory=list)
    rounds: list[Round] = field(default_factory=list)
    ended: str = ""
    stopped: Verdict | None = None

    @property
    def used_s(self) -> float:
        return sum(run.table_s for run in self.runs)

    @property
    def left_s(self) -> float:
        return self.budget_s - self.used_s

    def recordings(self, *, judging: bool) -> list[Path]:
        """Return the recordings that judge, or those that are fitted."""
        return [run.result.recording for run in self.runs if (run.purpose == VERIFICATION) is judging]
