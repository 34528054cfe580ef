"""What a run had of each source: samples, losses, the device's clock, and when its samples were taken."""

from dataclasses import asdict, dataclass
from typing import Any

from drivers.clocks.sampling import Alignment
from drivers.types import SourceCounts
from estimator.observations.timing import TimeOffset

_TIMED_S, _SIGMAS = 0.0005, 4.0  # an offset that is told lies beyond both


@dataclass(frozen=True, slots=True)
class SourceReport:
    """Counts of one source; its clock against the station's, and its samples against the table, where known."""

    name: str
    counts: SourceCounts
    clock: Alignment | None
    offset: TimeOffset | None = None

    def attributes(self) -> dict[str, float | int]:
        """Return what the recording keeps beside the samples."""
        found: dict[str, float | int] = {
            key: value for key, value in asdict(self.counts).items() if key in ("lost", "repeated", "late", "corrupt")
        }
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
        """Return what --json prints, in SI."""
        return {
            **asdict(self.counts),
            "clock": self.clock and asdict(self.clock),
            "offset_to_table": self.offset and asdict(self.offset),
        }

    @property
    def mistimed(self) -> str:
        """Say so if the samples were not taken when the table was read."""
        if self.offset is None or abs(self.offset.offset_s) < max(_TIMED_S, _SIGMAS * self.offset.sd_s):
            return ""
        return f"{self.name} is {self.offset.offset_s * 1e3:+.2f} ± {self.offset.sd_s * 1e3:.2f} ms against the table"

    def text(self) -> str:
        """Return one line for people."""
        counts = self.counts
        line = (
            f"{self.name}: {counts.samples} samples, {counts.lost} lost, {counts.repeated} repeated, "
            f"{counts.late} late, {counts.corrupt} corrupt"
        )
        if self.clock is not None:
            line += f"; clock {self.clock.drift_ppm:+.1f} ± {self.clock.sd_drift_ppm:.1f} ppm"
            line += f", arrivals jitter {self.clock.jitter_rms_s * 1e3:.2f} ms"
        if self.offset is not None:
            line += f"; {self.offset.offset_s * 1e3:+.2f} ± {self.offset.sd_s * 1e3:.2f} ms against the table"
        return line
