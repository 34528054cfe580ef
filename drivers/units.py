"""Units and products of them, "deg/s", "ppm/(deg/s)2", with their size in SI."""

import re
from collections.abc import Iterator
from functools import cache

from drivers.packaged import packaged_toml

Powers = tuple[float, float, float, float]
"""Powers of radian, second, kelvin and g."""

_NONE = (0.0, 0.0, 0.0, 0.0)
_UNITS: dict[str, tuple[float, Powers]] = {
    unit: (size, tuple(known["powers"]))
    for known in packaged_toml("drivers", "unit_sizes.toml").values()
    for unit, size in known["units"].items()
}
_QUANTITY = re.compile(r"^\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$")
_LONGEST = 100  # characters of a number and its unit
_WORD = re.compile(r"\s*([A-Za-z%]+|\d|[()/*])")


def split_quantity(text: str) -> tuple[float, str] | None:
    """Return the number and the unit of a text such as "0.1 deg/s", None if it does not begin with a number."""
    match = _QUANTITY.match(text) if len(text) <= _LONGEST else None
    return (float(match[1]), match[2]) if match else None


@cache
def unit_size(text: str) -> tuple[float, Powers]:
    """Return the factor to SI of a unit such as "deg/s2", and its powers of radian, second, kelvin and g.

    Lengths have no power, and g is a unit of its own with the factor 1, not 9.8 m/s2. ValueError if it
    is empty, not a unit, or has more than 100 characters.
    """
    if len(text) > _LONGEST:  # brackets within brackets
        raise ValueError(text[:_LONGEST])
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
    """Read factors joined by * and /, each a unit or a bracket with an optional power, starting with ``word``.

    ``words`` are those after it, ended by an empty one. A power is a single digit. Return the factor to SI, the powers
    and the first word that does not belong. ValueError for an unknown unit or a bracket that is not closed.
    """
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
