"""What a person reads of effects and of errors: values with their doubt, probabilities; None is not known."""

import math

from station.views.figures import UNKNOWN, shown_unit, three_digits


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


def human(value: float | None, sd: float | None, unit: str) -> str:
    """Return a value and its standard deviation, in SI, in a unit for people, to two digits of the latter."""
    if value is None:
        return UNKNOWN
    shown, factor = _unit(value, unit)
    number, sd = value * factor, (sd or 0.0) * factor
    if not math.isfinite(sd) or sd <= 0:
        return f"{number:.4g} {shown}".rstrip()
    digits = max(1 - math.floor(math.log10(sd)), 0)
    return f"{number:.{digits}f} ± {sd:.{digits}f} {shown}".rstrip()


def _unit(value: float, unit: str) -> tuple[str, float]:
    if unit == "s" and abs(value) >= 0.5:  # delays are milliseconds, time constants of a warm-up are not
        return unit, 1.0
    return shown_unit(unit)


def dph(rate_rps: float | None) -> str:
    """Return a rate in deg/h with three digits."""
    return three_digits(None if rate_rps is None else math.degrees(rate_rps) * 3600)
