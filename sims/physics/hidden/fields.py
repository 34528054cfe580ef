"""Fields of effects: the quantity of each, and how a table of texts becomes an effect of numbers.

A field's metadata say what it takes. Its key in the file is its name without the unit that the name of an SI number
ends in; without a default it must be there.
"""

import difflib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, replace
from typing import Any, TypeVar, dataclass_transform

import numpy as np

from drivers.types import Floats
from drivers.units import split_quantity, unit_size

Each = float | Sequence[float] | Floats
"""A number for all gyros, or one for each."""
T = TypeVar("T")

SHARE: Mapping[str, object] = {"like": "%", "least": 0.0, "most": 1.0}
"""Describes a share, 0 to 1."""
FLAG: Mapping[str, object] = {"flag": True}
"""Describes true or false."""
WHOLE: Mapping[str, object] = {"whole": True}
"""Describes a whole number from 1 on."""
_SUFFIX = re.compile(r"_(rps|rps2|rad|s|c|hz|rps_rts)$")


class HiddenError(ValueError):
    """An invalid hidden effect; the message names file, table and key where known."""


@dataclass_transform(frozen_default=True, eq_default=False, field_specifiers=(field,))
def hidden(kinds: dict[str, type[Any]], name: str) -> Callable[[type[T]], type[T]]:
    """Return a decorator that makes a class a frozen dataclass and enters it in ``kinds``.

    ``name`` is its key there and in files, and becomes the attribute ``name`` of the class.
    """

    def entered(described: type[T]) -> type[T]:
        kinds[name] = dataclass(frozen=True, slots=True, eq=False)(described)
        kinds[name].name = name
        return kinds[name]

    return entered


def given(like: str, *, least: float | None = None) -> dict[str, object]:
    """Describe a number whose unit measures the same as ``like``; ``least`` is its minimum, in SI."""
    return {"like": like, "least": least}


def each(like: str, *, least: float | None = None) -> dict[str, object]:
    """Describe a number for all gyros, or a list of one each."""
    return {"like": like, "least": least, "each": True}


def choice(choices: Sequence[str]) -> dict[str, object]:
    """Describe one of a few words."""
    return {"choices": tuple(choices)}


def key_of(field: Field[Any]) -> str:
    """Return the key of a field: its name without the unit."""
    return _SUFFIX.sub("", field.name)


def read(kind: type[T], table: object, name: str) -> T:
    """Return the effect of type ``kind`` that a table of texts describes; HiddenError with ``name`` and key if invalid.

    Keys that are unknown or missing without a default are errors, too.
    """
    if not isinstance(table, Mapping):
        raise HiddenError(f"{name}: must be a table")
    declared = {key_of(f): f for f in fields(kind) if f.metadata}  # type: ignore[arg-type]
    refuse_unknown(table, declared, name)
    values = {}
    for key, described in declared.items():
        if key in table:
            try:
                values[described.name] = _value(table[key], described)
            except HiddenError as error:
                raise HiddenError(f"{name}.{key}: {error}") from None
        elif described.default is MISSING:
            raise HiddenError(f"{name}: {key} is missing")
    return kind(**values)


def refuse_unknown(table: Mapping[str, object], known: Mapping[str, object], where: str) -> None:
    """Raise HiddenError for the first key that is not known; it suggests a similar one, or lists all.

    ``where`` is the place of the table in the file.
    """
    for key in table:
        if key not in known:
            close = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"known here: {', '.join(known)}"
            raise HiddenError(f"{where}: unknown key {key!r}; {hint}")


def for_gyros(effect: T, count: int) -> T:
    """Return a copy of an effect with every number that may differ between gyros as an array (count,).

    HiddenError if there are neither one nor ``count`` numbers. An effect without such numbers is returned as it is.
    """
    arrays = {}
    for described in fields(effect):  # type: ignore[arg-type]
        if described.metadata.get("each"):
            value = np.asarray(getattr(effect, described.name), dtype=np.float64)
            if value.ndim and value.shape != (count,):
                name = f"{getattr(effect, 'name', '')}.{key_of(described)}"
                raise HiddenError(f"{name}: {value.size} values for {count} gyros: give one for all, or one each")
            arrays[described.name] = np.broadcast_to(value, (count,))
    return replace(effect, **arrays) if arrays else effect  # type: ignore[type-var]


def check(effect: object) -> None:
    """Check every number of an effect; HiddenError if one is not finite or out of the range of its field.

    A default need not be finite. Fields that are not numbers are not looked at.
    """
    for described in fields(effect):  # type: ignore[arg-type]
        if "like" not in described.metadata:
            continue
        value = np.asarray(getattr(effect, described.name), dtype=np.float64)
        least, most = described.metadata["least"], described.metadata.get("most")
        finite = np.isfinite(value).all() or np.all(value == described.default)
        if not finite or (least is not None and np.any(value < least)) or (most is not None and np.any(value > most)):
            wanted = "a number" if least is None else f"{least:g} or more"
            name = f"{getattr(effect, 'name', '')}.{key_of(described)}".lstrip(".")
            raise HiddenError(f"{name}: give 0 % to 100 %" if most is not None else f"{name}: must be {wanted}")


def _value(raw: object, field: Field[Any]) -> Any:
    """Return a value of the file in SI, checked by the kind of ``field``; HiddenError if it is not of that kind.

    Kinds are a quantity with a unit (an array for a list of them, where gyros may differ), a flag, an integer from 1
    on, or a choice.
    """
    if "like" in field.metadata:
        if field.metadata.get("each") and isinstance(raw, list | tuple):
            return np.array([quantity(r, field.metadata["like"]) for r in raw])
        return quantity(raw, field.metadata["like"])
    if field.metadata.get("flag"):
        if not isinstance(raw, bool):
            raise HiddenError(f"{raw!r} is not true or false")
        return raw
    if field.metadata.get("whole"):
        if not isinstance(raw, int) or isinstance(raw, bool) or raw < 1:
            raise HiddenError(f"{raw!r} is not a whole number from 1 on")
        return raw
    choices = field.metadata["choices"]
    if raw not in choices:
        raise HiddenError(f"{raw!r} is not one of {', '.join(choices)}")
    return raw


def quantity(text: object, like: str) -> float:
    """Return the SI value of a text whose unit measures the same as the unit ``like``.

    HiddenError for no text, no number, no or an unknown unit, or one that measures something else.
    """
    if not isinstance(text, str):
        raise HiddenError(f'{text!r} has no unit: write a text, for instance "1 {like}"')
    if (found := split_quantity(text)) is None:
        raise HiddenError(f'{text!r} is no number with a unit: write for instance "1 {like}"')
    number, unit = found
    try:
        factor, powers = unit_size(unit)
    except ValueError:
        missing = "a unit is missing" if not unit else f"there is no unit {unit!r}"
        raise HiddenError(f'{text!r}: {missing}; write for instance "1 {like}"') from None
    if powers != unit_size(like)[1]:
        raise HiddenError(f"{text!r}: unit {unit!r} does not measure the same as {like!r}")
    return number * factor
