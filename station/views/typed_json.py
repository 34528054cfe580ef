"""Values read back from JSON: objects become the dataclasses that their types name."""

import math
import types
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, TypeVar, Union, cast, get_args, get_origin, get_type_hints

import numpy as np

View = TypeVar("View")
_UNIONS = (Union, types.UnionType)


def view_of(kind: type[View], values: Mapping[str, Any]) -> View:
    """Return the dataclass ``kind`` that an object of JSON holds, with all that is nested in it.

    Fields may be other dataclasses, texts, words of an enumeration, numbers, flags, None, arrays of numbers, and lists,
    tuples and mappings of them. null where a number is expected becomes NaN. Unknown keys are ignored; a missing key
    takes the default of its field.

    KeyError for a missing key without a default, TypeError for a value of another type, ValueError for a word that is
    none of its enumeration.
    """
    return cast(View, _read(kind, values))


def _read(kind: Any, value: Any) -> Any:
    """Return a value of JSON as the annotated type ``kind``; KeyError, TypeError or ValueError if it cannot be one."""
    origin = get_origin(kind)
    if kind is Any:
        return value
    if origin in _UNIONS:
        return _read_optional(kind, value)
    if origin is tuple:
        return _read_tuple(get_args(kind), value)
    if origin is list:
        return list(_read_tuple((*get_args(kind), Ellipsis), value))
    if origin is np.ndarray:
        return np.array(value, dtype=np.float64)
    if origin is not None:
        return _read_mapping(get_args(kind)[1], value)
    if is_dataclass(kind):
        return _read_dataclass(cast(type, kind), value)
    return _read_plain(kind, value)


def _read_optional(kind: Any, value: Any) -> Any:
    """Return a value of a type that may also be None."""
    if value is None:
        return None
    (inner,) = (part for part in get_args(kind) if part is not types.NoneType)
    return _read(inner, value)


def _read_tuple(parts: tuple[Any, ...], value: Any) -> tuple[Any, ...]:
    """Return a list of JSON as a tuple: of one type, or of a type for each place."""
    if not isinstance(value, list | tuple):
        raise TypeError(f"{value!r} is not a list")
    if len(parts) == 2 and parts[1] is Ellipsis:
        return tuple(_read(parts[0], item) for item in value)
    return tuple(_read(part, item) for part, item in zip(parts, value, strict=True))


def _read_mapping(part: Any, value: Any) -> dict[str, Any]:
    """Return an object of JSON whose keys are names, with values of one type."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{value!r} is not an object")
    return {str(key): _read(part, item) for key, item in value.items()}


def _read_dataclass(kind: type, value: Any) -> Any:
    """Return an object of JSON as the dataclass ``kind``; a missing key takes the default of its field.

    Unknown keys are ignored. TypeError if it is no object, KeyError if a key without a default is missing.
    """
    if not isinstance(value, Mapping):
        raise TypeError(f"{value!r} is not an object")
    values = {}
    for name, (part, has_default) in _fields_of(kind).items():
        if name in value or not has_default:
            values[name] = _read(part, value[name])
    return kind(**values)


def _read_plain(kind: type, value: Any) -> Any:
    """Return a text, word of an enumeration, number or flag of the type ``kind``; NaN for null in place of a number.

    A whole number of JSON may stand for any number. TypeError for a value of another type, ValueError for an unknown
    word.
    """
    if kind is float and value is None:
        return math.nan
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if issubclass(kind, Enum):
        return kind(value)
    if not isinstance(value, kind):
        raise TypeError(f"{value!r} is not of type {kind.__name__}")
    return value


@cache
def _fields_of(kind: type) -> dict[str, tuple[Any, bool]]:
    """Return by name of the fields of a dataclass the type, and whether there is a default."""
    hints = get_type_hints(kind)
    return {
        field.name: (hints[field.name], field.default is not MISSING or field.default_factory is not MISSING)
        for field in fields(kind)
    }
