"""Figures as people read them: states in everyday units, durations as a clock has them, a dash for the unknown."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Self

from drivers.packaged import packaged_toml
from drivers.units import unit_size
from station.bench.units import Units

UNKNOWN = "-"
_MOST_DIGITS = 6
_STYLES = packaged_toml("station.views", "styles.toml")
OUTCOME_STYLES: dict[str, str] = _STYLES["outcomes"]
"""Colours of outcomes; the word always stands there too."""
FINDING_STYLES: dict[str, str] = _STYLES["findings"]
"""Colours of what an investigation comes to."""


@dataclass(frozen=True, slots=True)
class StateUnit:
    """How a state is shown: its name, unit, factor from SI, decimals, and width."""

    name: str
    unit: str
    factor: float
    digits: int
    width: int

    def text(self, value: float, *, signed: bool = False) -> str:
        """Return a value in SI as digits in the unit."""
        return number(value * self.factor, self.digits, signed=signed)

    def figure(self, value: float, sd: float) -> str:
        """Return a value and its sigma, both in SI, as digits in the unit."""
        return f"{self.text(value)} ± {self.text(sd)}"

    def fitted(self, sds: Iterable[float]) -> Self:
        """Return the unit with enough digits for two significant ones of the smallest sigma (given in SI)."""
        known = [sd * self.factor for sd in sds if 0 < sd < math.inf]
        if not known:
            return self
        digits = min(max(1 - math.floor(math.log10(min(known))), 0), _MOST_DIGITS)
        return replace(self, digits=digits, width=self.width + digits - self.digits)


def _effect_units() -> dict[str, tuple[str, float]]:
    """Return by SI unit of an effect the displayed unit, and the factor."""
    shown = _TABLES["effects"].items()
    return {key: (unit, times * math.degrees(1) ** power) for key, (unit, times, power) in shown}


def shown_unit(si: str) -> tuple[str, float]:
    """Return the displayed unit for an effect's SI unit, and the factor."""
    from estimator.effects.catalogue import records

    own = (record.display[si] for record in records() if si in record.display)
    return _EFFECTS.get(si) or next(own, (si, 1.0))


_TABLES = packaged_toml("station.views", "units.toml")
_EFFECTS = _effect_units()


@cache
def state_figures(units: Units) -> tuple[StateUnit, ...]:
    """Return how each of the four states is shown, in order, in the ``units`` of a bench file.

    They are the same for values, sigmas and limits.
    """
    found = []
    for state, key in _TABLES["states"].items():
        unit = getattr(units, key)
        digits, width = _TABLES["digits"][unit]
        found.append(StateUnit(state, unit, 1 / unit_size(unit)[0], digits, width))
    return tuple(found)


def figures_from(stated: Any) -> tuple[StateUnit, ...]:
    """Return the states in the units of a session or file, given as JSON; the usual units if there are none."""
    try:
        return state_figures(Units(**stated)) if stated else STATE_FIGURES
    except (TypeError, KeyError):  # of another version of the station
        return STATE_FIGURES


STATE_FIGURES = state_figures(Units())
"""The four states in order, in the units that are usual in the field: where no bench file is at hand."""


def number(value: float | None, digits: int, *, signed: bool = False) -> str:
    """Return a number with ``digits`` digits after the point, or a dash if unknown."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    text = f"{value:+.{digits}f}" if signed else f"{value:.{digits}f}"
    return text.lstrip("+-") if float(text) == 0 and not signed else text


def three_digits(value: float | None) -> str:
    """Return a number with three digits and no exponent, or a dash."""
    return UNKNOWN if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds."""
    if not math.isfinite(seconds):
        return UNKNOWN
    whole = max(round(seconds), 0)
    return f"{whole // 60}:{whole % 60:02d}"


def clock_between(least_s: float, longer_s: float = 0.0) -> str:
    """Return a duration, perhaps longer by ``longer_s``, in minutes and seconds: "3:00 to 8:00", "3:00 or more"."""
    least = clock(least_s)
    if not math.isfinite(longer_s):
        return f"{least} or more"
    most = clock(least_s + longer_s)
    return least if most == least else f"{least} to {most}"


def seconds_between(least_s: float, most_s: float, form: str = "g") -> str:
    """Return a duration between two in seconds, each number in this form: "60 to 600 s", "60 s or more"."""
    least = f"{least_s:{form}}"
    if not math.isfinite(most_s):
        return f"{least} s or more"
    most = f"{most_s:{form}}"
    return f"{least} s" if most == least else f"{least} to {most} s"


def probability(share: float | None) -> str:
    """Return a probability that is never rounded to certainty."""
    if share is None:
        return UNKNOWN
    if share > 0.999:
        return "above 99.9 %"
    return "below 0.1 %" if share < 0.001 else f"{share * 100:.1f} %"


def percent(share: float | None) -> str:
    """Return a share in percent."""
    return UNKNOWN if share is None else f"{share:.1%}"


def whole_percent(share: float | None) -> str:
    """Return a share in percent without decimals."""
    return UNKNOWN if share is None else f"{100 * share:.0f}%"


def human(value: float | None, sd: float | None, unit: str) -> str:
    """Return a value with its standard deviation, both in SI, as text in a readable unit, rounded to two digits of the
    latter.

    ``unit`` is the SI unit; one without a readable counterpart is shown itself. "-" if the value is None; the value
    alone, with four digits, if the standard deviation is None, 0 or not finite.
    """
    if value is None:
        return UNKNOWN
    # Delays are milliseconds, time constants of a warm-up are not.
    shown, factor = (unit, 1.0) if unit == "s" and abs(value) >= 0.5 else shown_unit(unit)
    size, sd = value * factor, (sd or 0.0) * factor
    if not math.isfinite(sd) or sd <= 0:
        return f"{size:.4g} {shown}".rstrip()
    digits = max(1 - math.floor(math.log10(sd)), 0)
    return f"{size:.{digits}f} ± {sd:.{digits}f} {shown}".rstrip()


def dph(rate_rps: float | None) -> str:
    """Return a rate in deg/h with three digits."""
    return three_digits(None if rate_rps is None else math.degrees(rate_rps) * 3600)
