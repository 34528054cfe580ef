"""Noise of sensors as people read it: N, B and K with their intervals, each in its everyday unit."""

import math
from collections.abc import Sequence
from typing import Any

from drivers.packaged import packaged_toml
from estimator.observations.allan.duration import record_length_s
from estimator.observations.allan.sensor import RATE, SensorNoise
from estimator.observations.allan.spectrum import TERMS
from estimator.observations.allan.terms import Term
from station.views.figures import UNKNOWN
from station.views.json_values import json_object, term_object

_UNITS: dict[str, list[tuple[str, float, int]]] = packaged_toml("station.views", "units.toml")["noise"]
_LONG = ((2 * 86400.0, "d", 86400.0), (2 * 3600.0, "h", 3600.0), (180.0, "min", 60.0), (0.0, "s", 1.0))
"""From which length on a duration is told in which unit."""
NAMES = {
    RATE: ("angle random walk", "bias instability", "rate random walk"),
    "m/s2": ("velocity random walk", "bias instability", "acceleration random walk"),
}
"""What N, B and K are called, by the unit of the samples."""


def noise_unit(unit: str, term: int) -> tuple[str, float]:
    """Return the everyday unit of a term, 0 to 2 for N, B and K, of samples in an SI unit, and the factor from SI."""
    name, times, power = _UNITS[unit][term]
    return name, times * math.degrees(1) ** power


def term_words(term: Term, factor: float) -> str:
    """Return a term with its interval, or its upper limit, in a unit with this factor from SI."""
    if not term.seen:
        return f"at most {digits(term.high * factor)}"
    return f"{digits(term.value * factor)} ({digits(term.low * factor)} to {digits(term.high * factor)})"


def digits(value: float) -> str:
    """Return three digits that count, without an exponent where that is readable."""
    if value == 0 or not math.isfinite(value):
        return f"{value:.0f}"
    exponent = math.floor(math.log10(abs(value)))
    return f"{value:.2e}" if exponent < -5 or exponent > 6 else f"{value:.{max(2 - exponent, 0)}f}"


def length_words(seconds: float, *, seen: bool) -> str:
    """Return a length of time in its natural unit; "over" it for a term that was not ``seen``, which may be smaller."""
    if not math.isfinite(seconds):
        return UNKNOWN
    name, size = next((name, size) for least, name, size in _LONG if seconds >= least)
    number = seconds / size
    return f"{'' if seen else 'over '}{number:.{0 if number >= 10 else 1}f} {name}"


def lengths_s(noise: SensorNoise, share: float) -> tuple[float, ...]:
    """Return how long a rest must be until N, B and K are known to a share of themselves, one standard uncertainty."""
    return tuple(record_length_s(noise.terms, term, share) for term in range(len(TERMS)))


def noise_object(noise: SensorNoise, share: float) -> dict[str, Any]:
    """Return the noise of a sensor as --json prints it, in SI; null for a recording length of more than three years.

    That is name, unit, length of the rests, the terms by their names, the Allan curve, and where the terms hold or not.
    ``share`` is the relative uncertainty, between 0 and 1, for which the length to record is given with each term.
    """
    curve = noise.curve
    parts = zip(TERMS, lengths_s(noise, share), strict=True)
    terms = {name: {**term_object(noise.terms[name]), "record_s": json_object(length)} for name, length in parts}
    return {
        "name": noise.name,
        "unit": noise.unit,
        "span_s": noise.span_s,
        "longest_s": noise.longest_s,
        **terms,
        "holds_from_s": noise.terms.shortest_s,
        "unlike_hz": noise.terms.unlike_hz,
        "curve": json_object(curve),
    }


def warnings_of(noises: Sequence[SensorNoise]) -> list[str]:
    """Return a sentence for each sensor whose noise N, B and K do not describe at some frequency; none if they do."""
    found = []
    for noise in noises:
        terms = noise.terms
        if terms.unlike_hz is not None:
            found.append(
                f"{noise.name}: its noise about {terms.unlike_hz:.2g} Hz is {terms.unlike:.2g} times what N, B and K "
                "explain: look for vibration, a drift of temperature or an oscillation; the intervals do not hold it"
            )
    return found


def filter_notes(noises: Sequence[SensorNoise]) -> list[str]:
    """Return a sentence for each averaging time from which N, B and K hold, with its sensors.

    None for sensors of which they hold from the shortest one on.
    """
    found = []
    trimmed = [noise for noise in noises if noise.terms.trimmed]
    for shortest_s in dict.fromkeys(noise.terms.shortest_s for noise in trimmed):
        names = ", ".join(noise.name for noise in trimmed if noise.terms.shortest_s == shortest_s)
        found.append(
            f"{names}: N, B and K hold from {digits(shortest_s)} s on; what is faster is shaped by a filter, an "
            "oscillation or the steps of a converter"
        )
    return found
