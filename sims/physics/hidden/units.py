"""Numbers with units made of other units: "0.005 deg/s/degC", "200 ppm/(deg/s)2", to SI."""

import math
import re
from collections.abc import Iterator
from functools import cache

from sims.physics.hidden.errors import HiddenError

Powers = tuple[float, float, float, float]
"""Powers of radian, second, kelvin and g."""

_DEG = math.pi / 180
_NONE = (0.0, 0.0, 0.0, 0.0)
_ANGLE, _TIME, _TEMPERATURE, _G = (1.0, 0, 0, 0), (0, 1.0, 0, 0), (0, 0, 1.0, 0), (0, 0, 0, 1.0)
_RATE, _ROOT_TIME = (1.0, -1.0, 0, 0), (0, 0.5, 0, 0)
_BY_POWERS: dict[Powers, dict[str, float]] = {
    _NONE: {"1": 1.0, "ppm": 1e-6, "%": 1e-2},
    _ANGLE: {"rad": 1.0, "mrad": 1e-3, "urad": 1e-6, "deg": _DEG, "arcmin": _DEG / 60, "arcsec": _DEG / 3600},
    _RATE: {"rpm": 2 * math.pi / 60},
    _TIME: {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    _ROOT_TIME: {"rts": 1.0, "rth": 60.0},
    (0, -1.0, 0, 0): {"Hz": 1.0, "kHz": 1e3},
    _TEMPERATURE: {"degC": 1.0},
    _G: {"g": 1.0},
}
_UNITS = {unit: (factor, powers) for powers, units in _BY_POWERS.items() for unit, factor in units.items()}
_NUMBER = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$")
_WORD = re.compile(r"\s*([A-Za-z%]+|\d|[()/*])")


def quantity(text: object, like: str) -> float:
    """Return the SI value of a text whose unit measures the same as ``like``; HiddenError if it does not."""
    if not isinstance(text, str):
        raise HiddenError(f'{text!r} has no unit: write a text, for instance "1 {like}"')
    match = _NUMBER.match(text)
    if match is None:
        raise HiddenError(f'{text!r} is no number with a unit: write for instance "1 {like}"')
    number, unit = match.groups()
    try:
        factor, powers = _unit(unit)
    except ValueError:
        missing = "a unit is missing" if not unit else f"there is no unit {unit!r}"
        raise HiddenError(f'{text!r}: {missing}; write for instance "1 {like}"') from None
    if powers != _unit(like)[1]:
        raise HiddenError(f"{text!r}: unit {unit!r} does not measure the same as {like!r}")
    return float(number) * factor


@cache
def _unit(text: str) -> tuple[float, Powers]:
    """Return factor to SI and powers of a unit; ValueError if it is none."""
    words, at = [], 0
    while at < len(text.rstrip()):
        match = _WORD.match(text, at)
        if match is None:
            raise ValueError(text)
        words.append(match.group(1))
        at = match.end()
    rest = iter([*words, ""])
    factor, powers, end = _product(rest, next(rest))
    if end:
        raise ValueError(text)
    return factor, powers


def _product(words: Iterator[str], word: str) -> tuple[float, Powers, str]:
    """Read factors between * and /, each with a power behind it, up to a word that is none."""
    factor, powers, sign = 1.0, _NONE, 1.0
    while True:
        if word == "(":
            size, of, end = _product(words, next(words))
            if end != ")":
                raise ValueError(end)
        elif word in _UNITS:
            size, of = _UNITS[word]
        else:
            raise ValueError(word)
        word = next(words)
        power = sign
        if word.isdigit():
            power, word = sign * int(word), next(words)
        factor *= size**power
        a, b, c, d = (x + power * y for x, y in zip(powers, of, strict=True))
        powers = (a, b, c, d)
        if word not in ("*", "/"):
            return factor, powers, word
        sign, word = (1.0 if word == "*" else -1.0), next(words)
