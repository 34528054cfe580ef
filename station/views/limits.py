"""The limits of a bench beside what a calibration found: what verdicts are made of, and reports show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from estimator.calibration.values import Calibration
from station.bench.bench import Limits
from station.views.figures import STATE_FIGURES, STATE_UNITS


@dataclass(frozen=True, slots=True)
class LimitLine:
    """One limit: what it is of, the value found, the bounds, SI.

    Of a gyro (``row`` in the calibration) it is of ``state`` 0 to 3 or, ``of_u``, of that state's standard
    uncertainty. ``note`` says why a gyro has no estimate.
    """

    gyro: str
    what: str
    value: float
    low: float
    high: float
    row: int | None = None
    state: int | None = None
    of_u: bool = False
    note: str = ""

    @property
    def stated(self) -> bool:
        """Whether there is a bound at all; what is not known is beyond any."""
        return math.isfinite(self.high) or self.low > 0 or math.isnan(self.value)

    @property
    def within(self) -> bool:
        """Whether the value is within its bounds; what is not known is not."""
        return self.low <= self.value <= self.high

    @property
    def broken(self) -> str:
        """How the limit is broken, in words."""
        if self.note:
            return f"{self.gyro} is not estimated: {self.note}"
        if self.state is not None:
            name, unit, factor = STATE_UNITS[self.state]
            if not self.of_u:
                unit, factor = STATE_FIGURES[self.state].unit, STATE_FIGURES[self.state].factor
            what = f"{self.gyro} sigma of {name}" if self.of_u else f"{self.gyro} {name}"
            return f"{what} {abs(self.value) * factor:.4g} {unit} > {self.high * factor:.4g} {unit}"
        if self.what == SAMPLES_LOST:
            return f"{self.value:.2%} of the samples lost > {self.high:.2%}"
        return (
            f"mean NIS {self.value:.3f} outside {self.low:g} to {self.high:g}: the noise or the model is not what was "
            "assumed"
        )


MEAN_NIS, SAMPLES_LOST = "mean NIS", "samples lost"


def limit_lines(found: Calibration, limits: Limits, labels: Sequence[str] | None = None) -> list[LimitLine]:
    """Return each limit that is stated beside what was found; ``labels`` are what to call the gyros, else their names.

    A gyro that is not estimated breaks a limit.
    """
    lines = [LimitLine(e.name, "estimate", math.nan, 0.0, 1.0, note=e.reason) for e in found.excluded]
    for row, gyro in enumerate(found.gyros):
        label = labels[row] if labels else gyro.name
        for s, (state, size, doubt) in enumerate(zip(STATE_FIGURES, limits.sizes, limits.sds, strict=True)):
            lines.append(LimitLine(label, state.name, float(gyro.states[s]), -size, size, row, s))
            lines.append(LimitLine(label, state.name, float(gyro.sd[s]), 0.0, doubt, row, s, of_u=True))
    if math.isfinite(found.nis_mean):
        lines.append(LimitLine("all", MEAN_NIS, found.nis_mean, limits.nis_low, limits.nis_high))
    if limits.lost < 1:
        share = found.lost / max(found.samples + found.lost, 1)
        lines.append(LimitLine("all", SAMPLES_LOST, share, 0.0, limits.lost))
    return [line for line in lines if line.stated]
