"""What a screen may look at while a run goes on."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a run at one instant; times in seconds of the loop's clock."""

    phase: str
    elapsed_s: float
    remaining_s: float
    samples: int
    lost: int
    nis_mean: float

    @property
    def share(self) -> float:
        """How much of the run is done, 0 to 1."""
        return self.elapsed_s / max(self.elapsed_s + self.remaining_s, 1e-9)
