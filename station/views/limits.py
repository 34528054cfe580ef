"""The limits of a bench beside what a calibration found: what verdicts are made of, and reports show."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.calibration.values import Calibration
from station.bench.bench import Limits
from station.errors import sentence
from station.views.figures import STATE_FIGURES, STATE_UNITS


@dataclass(frozen=True, slots=True)
class LimitLine:
    """One limit: what it is of, the value found, the bounds, SI.

    Of a gyro (``row`` in the calibration) it is of ``state`` 0 to 3 or, ``of_u``, of that state's standard
    uncertainty. ``note`` says why a gyro has no estimate. What is accepted ends a ``guard`` band before the limits.
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
    guard: float = 0.0

    @property
    def stated(self) -> bool:
        """Whether there is a bound at all; what is not known is beyond any."""
        return math.isfinite(self.high) or self.low > 0 or math.isnan(self.value)

    @property
    def within(self) -> bool:
        """Whether the value is accepted; what is not known is not."""
        return self.low + self.guard <= self.value <= self.high - self.guard

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
            found, most = _apart(abs(self.value) * factor, self.high * factor)
            return f"{what} {found} {unit} > {most} {unit}"
        if self.what == SAMPLES_LOST:
            return f"{self.value:.2%} of the samples lost > {self.high:.2%}"
        return sentence("run.nis", nis=self.value, low=self.low, high=self.high)

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """What it is of, the value found, the bound and by how much that is missed, in units of the states' table."""
        if self.note or not math.isfinite(self.value):
            return f"{self.gyro} {self.what}", self.note or "not known", "", ""
        unit, factor, what = "", 1.0, self.what
        if self.state is not None:
            unit, factor = f" {STATE_FIGURES[self.state].unit}", STATE_FIGURES[self.state].factor
            what = f"{self.gyro} {'± of ' * self.of_u}{self.what}"
        elif what == SAMPLES_LOST:
            unit, factor = " %", 100.0
        bound = self.low if what == MEAN_NIS and self.value < self.low else self.high
        found, most = _apart(abs(self.value) * factor, bound * factor)
        ratio = abs(self.value) / bound if bound else math.inf
        by = f"{ratio:.0f} times" if ratio > 2 else f"{abs(ratio - 1) * 100:.2g} %"
        return what, found + unit, most + unit, by if math.isfinite(ratio) else ""

    @property
    def remedy(self) -> str:
        """What usually helps where it is broken."""
        if self.of_u:
            return "Uncertainty too large. Use a longer or better script: `station plan --improve` finds one."
        return {
            MEAN_NIS: "mean NIS: station investigate looks for what the model lacks",
            SAMPLES_LOST: "losses: station check tells of each link",
        }.get(self.what, "" if self.note else "a state: the device is beyond its tolerance, or mounted another way")


def _apart(value: float, bound: float) -> tuple[str, str]:
    """Return both with as many digits, four or more, as it takes to tell them apart."""
    for digits in range(4, 17):
        texts = tuple(np.format_float_positional(x, digits, fractional=False, trim="-") for x in (value, bound))
        if texts[0] != texts[1]:
            break
    return texts[0], texts[1]


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
