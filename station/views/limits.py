"""The limits of a bench compared with the results of a calibration, for verdicts and reports."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drivers.units import split_quantity
from estimator.calibration.accelerometer import ForceCalibration
from estimator.calibration.values import Calibration
from station.bench.bench import ForceLimits, Limits
from station.errors import sentence
from station.views.accelerometers.result import FORCE_FIGURES, PLACE, names_by_reason
from station.views.figures import StateUnit, state_figures


@dataclass(kw_only=True, frozen=True, slots=True)
class LimitLine:
    """One limit: its subject, the value found, the bounds, in SI.

    For a gyro (``row`` in the calibration) the subject is ``state`` 0 to 3 or, with ``of_u``, that state's standard
    uncertainty, shown in ``unit``. ``written`` is the bound as in the bench file, empty if not known. ``note`` says why
    a gyro has no estimate. Acceptance ends a ``guard`` band before the limits.
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
    unit: StateUnit | None = None
    written: str = ""

    @property
    def stated(self) -> bool:
        """Whether there is a bound at all; an unknown value counts as bounded."""
        return math.isfinite(self.high) or self.low > 0 or math.isnan(self.value)

    @property
    def within(self) -> bool:
        """Whether the value is accepted; an unknown value is not."""
        return self.low + self.guard <= self.value <= self.high - self.guard

    @property
    def broken(self) -> str:
        """The text for a broken limit: value and bound in the units shown, or why there is no estimate.

        Call it only if the limit is broken.
        """
        if self.note:
            verb = "are" if ", " in self.gyro else "is"
            return f"{self.gyro} {verb} not estimated: {self.note}"
        if self.unit is not None:
            quantity = f"{self.gyro} sigma of {self.what}" if self.of_u else f"{self.gyro} {self.what}"
            found, most = self._shown(self.high, self.unit.unit, self.unit.factor)
            return f"{quantity} {found} > {most}"
        if self.what == SAMPLES_LOST:
            found, most = self._shown(self.high, "%", 100.0)
            return f"{found} of the samples lost > {most}"
        return sentence("run.nis", nis=self.value, low=self.low, high=self.high)

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """Subject, value, bound and the excess as a factor or percentage, as texts in the units of the states' table.

        Meant for a broken limit: of one that holds, the excess is the distance to the bound. If there is no estimate,
        the value is the reason or "not known", and bound and excess are empty; the excess also if the bound is 0. The
        bound is the lower one for a mean NIS below it, else the upper one.
        """
        if self.note or not math.isfinite(self.value):
            return f"{self.gyro} {self.what}", self.note or "not known", "", ""
        unit, factor, quantity = "", 1.0, self.what
        if self.unit is not None:
            unit, factor = self.unit.unit, self.unit.factor
            quantity = f"{self.gyro} {'± of ' * self.of_u}{self.what}"
        elif quantity == SAMPLES_LOST:
            unit, factor = "%", 100.0
        bound = self.low if quantity == MEAN_NIS and self.value < self.low else self.high
        found, most = self._shown(bound, unit, factor)
        ratio = abs(self.value) / bound if bound else math.inf
        by = f"{ratio:.0f} times" if ratio > 2 else f"{abs(ratio - 1) * 100:.2g} %"
        return quantity, found, most, by if math.isfinite(ratio) else ""

    def _shown(self, bound: float, unit: str, factor: float) -> tuple[str, str]:
        """Return the size of the value in a unit, and the bound as it was written.

        The bound is followed by itself in that unit if it was written in another, and is in that unit alone if it is
        not known how it was written. Both have enough digits to differ. ``factor`` is that from SI to ``unit``.
        """
        found, most = (f"{text} {unit}".rstrip() for text in _apart(abs(self.value) * factor, bound * factor))
        if not self.written:
            return found, most
        in_unit = (split_quantity(self.written) or (0.0, ""))[1] == unit
        return found, self.written if in_unit else f"{self.written} ({most})"

    @property
    def excess(self) -> float:
        """The value over its upper bound; infinite where that is zero, or the value is not known."""
        return abs(self.value) / self.high if self.high > 0 and math.isfinite(self.value) else math.inf

    @property
    def remedy(self) -> str:
        """What usually helps where this limit is broken, in sentences, "" for a sensor without an estimate."""
        if self.of_u:
            return "Uncertainty too large. Use a longer or better script: `station plan --improve` finds one."
        if self.what == MEAN_NIS:
            return "Mean NIS out of range: `station investigate` looks for errors that the model misses."
        if self.what == SAMPLES_LOST:
            return "Samples lost: `station check` tests each link."
        return "" if self.note else "A state exceeds its limit: out of tolerance, or mounted differently."


def _apart(value: float, bound: float) -> tuple[str, str]:
    """Return both values with four or more digits, as many as make them differ; 16 if they are equal."""
    for digits in range(4, 17):
        texts = tuple(np.format_float_positional(x, digits, fractional=False, trim="-") for x in (value, bound))
        if texts[0] != texts[1]:
            break
    return texts[0], texts[1]


def worst_first(lines: Sequence[LimitLine]) -> list[LimitLine]:
    """Return broken limits: first those of no gyro, which may cause the others, then by excess."""
    return sorted(lines, key=lambda line: (line.row is not None, -line.excess))


MEAN_NIS, SAMPLES_LOST = "mean NIS", "samples lost"


def limit_lines(calibration: Calibration, limits: Limits, labels: Sequence[str] | None = None) -> list[LimitLine]:
    """Return every stated limit with its value, broken or not: of states and sigmas, accelerometers, NIS, lost samples.

    ``labels`` name the gyros in their order, by default their own names. A sensor that was excluded is a broken limit;
    accelerometers of a source that are excluded for one reason are one. Without a mean NIS there is no limit of it.
    """
    unknown = [(e.name, e.reason) for e in calibration.excluded]
    for one in calibration.forces:
        unknown += [(", ".join(names), reason) for reason, names in names_by_reason(one.excluded).items()]
    lines = [
        LimitLine(gyro=names, what="estimate", value=math.nan, low=0.0, high=1.0, note=reason)
        for names, reason in unknown
    ]
    for row, gyro in enumerate(calibration.gyros):
        label = labels[row] if labels else gyro.name
        for s, unit in enumerate(state_figures(limits.units)):
            bounds = limits.sizes[s], limits.written_sizes[s], limits.sds[s], limits.written_sds[s]
            values = float(gyro.states[s]), float(gyro.sd[s])
            lines += _state_lines(label, unit, values, bounds, row=row, state=s)
    for source in calibration.forces:
        for accelerometer in source.accelerometers:
            label = (
                accelerometer.name
                if len(calibration.forces) == 1
                else f"{source.device or source.source} {accelerometer.name}"
            )
            for s, unit in enumerate(FORCE_FIGURES):
                values = float(accelerometer.states[s]), float(accelerometer.sd[s])
                lines += _state_lines(label, unit, values, limits.forces.of_state(s))
        if math.isfinite(limits.forces.sd_arm_m) and source.accelerometers:
            lines += _arm_lines(source, limits.forces, alone=len(calibration.forces) == 1)
    if math.isfinite(calibration.nis_mean):
        lines.append(
            LimitLine(gyro="all", what=MEAN_NIS, value=calibration.nis_mean, low=limits.nis_low, high=limits.nis_high)
        )
    if limits.lost < 1:
        share = calibration.lost / max(calibration.samples + calibration.lost, 1)
        written = limits.written.get("lost", "")
        lines.append(LimitLine(gyro="all", what=SAMPLES_LOST, value=share, low=0.0, high=limits.lost, written=written))
    return [line for line in lines if line.stated]


def _arm_lines(source: ForceCalibration, limits: ForceLimits, *, alone: bool) -> list[LimitLine]:
    """Return the limits of the sigmas of the lever arm along x, y and z, also if none is stated.

    ``alone``: no other device has accelerometers, and the label leaves out the device. Empty for a joined calibration,
    which has a lever arm for each mounting and states none.
    """
    label = "accel" if alone else f"{source.device or source.source} accel"
    if not source.placed:
        return []
    return [
        LimitLine(
            gyro=label,
            what=f"lever arm {axis}",
            value=sd_m,
            low=0.0,
            high=limits.sd_arm_m,
            of_u=True,
            unit=PLACE,
            written=limits.written.get("sd_arm_m", ""),
        )
        for axis, sd_m in zip("xyz", source.arm_sd_m.tolist(), strict=True)
    ]


def _state_lines(
    label: str,
    unit: StateUnit,
    values: tuple[float, float],
    bounds: tuple[float, str, float, str],
    *,
    row: int | None = None,
    state: int | None = None,
) -> tuple[LimitLine, LimitLine]:
    """Return the limits of a state and of its sigma, with the ``values`` of both that were found, in SI.

    ``bounds`` are the largest size and the largest sigma, each followed by its text in the bench file. ``label`` names
    the sensor; ``row`` and ``state`` are numbers of a gyro in the calibration and its state, None for an accelerometer.
    """
    (value, sd), (size, written_size, most_sd, written_sd) = values, bounds
    of_state = LimitLine(
        gyro=label,
        what=unit.name,
        value=value,
        low=-size,
        high=size,
        row=row,
        state=state,
        unit=unit,
        written=written_size,
    )
    return of_state, replace(of_state, value=sd, low=0.0, high=most_sd, of_u=True, written=written_sd)
