"""What a person reads of effects and of errors: names, values with their doubt, probabilities."""

import math

from estimator.effects.constructed import readable
from estimator.tracing.investigation import Value
from station.views.figures import effect_units

_UNITS = effect_units("traced")


def words(name: str) -> str:
    """Return the name of an effect as people say it; "a + b" for several."""
    return readable(name)


def probability(share: float) -> str:
    """Return a probability that is never rounded to certainty."""
    if share > 0.999:
        return "above 99.9 %"
    return "below 0.1 %" if share < 0.001 else f"{share * 100:.1f} %"


def human(value: Value) -> str:
    """Return a value and its standard deviation in a unit for people, to two digits of the latter."""
    unit, factor = _unit(value)
    number, sd = value.value * factor, value.sd * factor
    if not math.isfinite(sd) or sd <= 0:
        return f"{number:.4g} {unit}".rstrip()
    digits = max(1 - math.floor(math.log10(sd)), 0)
    return f"{number:.{digits}f} ± {sd:.{digits}f} {unit}".rstrip()


def _unit(value: Value) -> tuple[str, float]:
    if value.unit == "s":  # delays are milliseconds, time constants of a warm-up are not
        return ("ms", 1e3) if abs(value.value) < 0.5 else ("s", 1.0)
    return _UNITS.get(value.unit, (value.unit, 1.0))


def dph(rate_rps: float) -> str:
    """Return a rate in deg/h with three digits."""
    value = math.degrees(rate_rps) * 3600
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
