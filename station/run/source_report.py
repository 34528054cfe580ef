"""What is known of one source at the end of a run: its counts, its clock, its time offset."""

from dataclasses import asdict, dataclass
from typing import Any

from drivers.clocks.sampling import Alignment
from drivers.types import SourceCounts
from estimator.observations.timing import TimeOffset
from station.views.json_values import named

_TIMED_S, _SIGMAS = 0.0005, 4.0  # a reported offset exceeds both


@dataclass(frozen=True, slots=True)
class SourceReport:
    """Counts of one source, and, where known, its clock against the station's and its samples against the table."""

    name: str
    counts: SourceCounts
    clock: Alignment | None
    offset: TimeOffset | None = None

    def attributes(self) -> dict[str, float | int]:
        """Return the attributes of the source in the recording: counts of lost and bad samples, clock and time offset.

        They are lost, repeated, late and corrupt samples; drift with its sigma, sigma of the offset and jitter of the
        clock; the time offset with its sigma. What is not known is left out.
        """
        found: dict[str, float | int] = named(self.counts, ("lost", "repeated", "late", "corrupt"))
        if self.clock is not None:
            found |= {
                "clock_drift_ppm": self.clock.drift_ppm,
                "clock_drift_sd_ppm": self.clock.sd_drift_ppm,
                "clock_offset_sd_s": self.clock.sd_offset_s,
                "arrival_jitter_rms_s": self.clock.jitter_rms_s,
            }
        if self.offset is not None:
            found |= {"time_offset_s": self.offset.offset_s, "time_offset_sd_s": self.offset.sd_s}
        return found

    def as_object(self) -> dict[str, Any]:
        """Return the object for --json, in SI: all counts, and clock and offset, None if not known."""
        return {
            **asdict(self.counts),
            "clock": self.clock and asdict(self.clock),
            "offset_to_table": self.offset and asdict(self.offset),
        }

    @property
    def mistimed(self) -> str:
        """Sentence on samples that were not taken when the table was read; empty if they were."""
        if self.offset is None or abs(self.offset.offset_s) < max(_TIMED_S, _SIGMAS * self.offset.sd_s):
            return ""
        return f"{self.name} is {self.offset.offset_s * 1e3:+.2f} ± {self.offset.sd_s * 1e3:.2f} ms against the table"
