"""Tables of a TOML file, read strictly: every key known, every value of its type, every complaint with its line."""

import difflib
import re
import tomllib
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import reduce
from math import inf, isfinite, radians
from operator import getitem
from pathlib import Path
from typing import Any, Self, TypeVar, cast

from estimator.untrusted import harmless, read_text

T = TypeVar("T")

_DEEPEST = 100
_LONGEST = 1000  # characters of a complaint
_KEY_ENDS, _STEP = re.compile(r"[=\n,{]"), re.compile(r"""[\w"'-]\.(?=[\w"'-])""")
_STRINGS = r"""\"{3}(?:[^\\]|\\.)*?\"{3,5}|'{3}.*?'{3,5}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'"""
_TOKEN = re.compile(_STRINGS + r"|#[^\n]*|[][{}\n]", re.DOTALL)
_DEPTH = {"[": 1, "{": 1, "]": -1, "}": -1}


class StrictTable:
    """One table of a TOML file. Values are taken by key; ``done`` raises an error for keys that nobody took.

    All errors are of the given class, and name file, line, table and key. A key without a default is required.
    """

    def __init__(
        self, data: dict[str, Any], path: tuple[str | int, ...], text: str, file: str, error: type[Exception]
    ) -> None:
        """``path`` leads to this table from the top of the file: keys, and indices in arrays of tables."""
        self._data, self._path, self._text, self._file, self._error = dict(data), path, text, file, error
        self._known: list[str] = []

    @classmethod
    def parse(cls, text: str, file: str, error: type[Exception]) -> Self:
        """Return the top table of a TOML text; ``file`` names it in errors.

        ``error`` if the text is invalid or nested too deeply, or a value has control characters. Keys of many parts
        are refused before the slow parser.
        """
        try:
            if any(len(_STEP.findall(key)) > _DEEPEST for key in _KEY_ENDS.split("".join(text.split(" ")))):
                raise RecursionError  # the parser would take hours over such a key
            _check_depth(data := tomllib.loads(text))
        except ValueError as reason:  # an integer of 5000 digits is no TOMLDecodeError
            raise error(f"{file}: not valid TOML: {harmless(str(reason))}") from None
        except RecursionError:
            raise error(f"{file}: tables and lists are nested more than {_DEEPEST} deep: write them flat") from None
        return cls(data, (), text, file, error)

    @classmethod
    def load(cls, path: Path, error: type[Exception], wanted: str = "a TOML file") -> Self:
        """Read a file; ``error`` if it cannot be read or is no TOML.

        ``wanted`` names the expected file in the error for a recording.
        """
        return cls.parse(read_text(path, error, wanted), str(path), error)

    def again(self) -> Self:
        """Return a copy of this table for another reader, with the keys that are not taken yet."""
        return type(self)(self._data, self._path, self._text, self._file, self._error)

    def fail(self, key: str | None, message: str) -> Exception:
        """Return an error that names file, line, table and ``key``, for the caller to raise.

        It names only the table if the key is None, no line if neither is found. A long message is cut.
        """
        line = self._line(key)
        where = f"{self._file}, line {line}" if line else self._file
        message = message if len(message) <= _LONGEST else f"{message[:_LONGEST]} ..."
        name = ".".join(str(p) for p in (*self._path, *([key] if key else [])))
        return self._error(f"{where}: {name}: {message}" if name else f"{where}: {message}")

    def has(self, key: str) -> bool:
        """Return whether the key is present and not taken yet; for ``done`` it counts as known from now on."""
        self._known.append(key)
        return key in self._data

    def text_of(self, key: str) -> str:
        """Return the text of a key that is not taken yet, without taking it; "" if it is missing or no text.

        White space within it becomes single spaces.
        """
        value = self._data.get(key)
        return " ".join(value.split()) if isinstance(value, str) else ""

    def remaining(self) -> tuple[str, ...]:
        """Return the keys that are not taken yet."""
        return tuple(self._data)

    def number(
        self, key: str, default: float | None = None, *, positive: bool = False, least: float = -inf, most: float = inf
    ) -> float:
        """Take the finite number of ``key``, ``default`` if it is left out.

        The table's error if it is no number, not between ``least`` and ``most`` (included), not above zero while
        ``positive``, or left out without a default, which is not checked.
        """

        def convert(value: object) -> float:
            number = float(typed(value, (int, float), "a number"))
            if not isfinite(number) or not least <= number <= most or (positive and number <= 0):
                bound = " above 0" if positive else f" of {least:g} or more" if least > -inf else ""
                raise ValueError(f"{value!r}: write {f'{least:g} to {most:g}' if most < inf else f'a number{bound}'}")
            return number

        return self.take(key, default, convert)

    def integer(self, key: str, default: int | None = None) -> int:
        """Take the whole number of ``key``, ``default`` if it is left out; errors as for ``number``."""
        return self.take(key, default, lambda value: int(typed(value, (int,), "a whole number")))

    def flag(self, key: str, default: bool | None = None) -> bool:
        """Take true or false of ``key``, ``default`` if it is left out; errors as for ``number``."""
        return self.take(key, default, lambda value: bool(typed(value, (bool,), "true or false")))

    def string(self, key: str, default: str | None = None, *, one_of: Iterable[str] | None = None) -> str:
        """Take the text of ``key``, ``default`` if it is left out; one of ``one_of`` if that is given.

        The table's error for anything else, or if it is left out without a default.
        """

        def convert(value: object) -> str:
            text = str(typed(value, (str,), "a text"))
            if one_of is not None and text not in (choices := list(one_of)):
                raise ValueError(not_one_of(text, choices))
            return text

        return self.take(key, default, convert)

    def strings(self, key: str, default: tuple[str, ...] | None = None) -> tuple[str, ...]:
        """Take a list of texts of ``key``, or a single text, as a tuple; ``default`` if it is left out.

        The table's error for an empty list or anything else, or if it is left out without a default.
        """

        def convert(value: object) -> tuple[str, ...]:
            listed = [value] if isinstance(value, str) else value
            if not isinstance(listed, list) or not listed or not all(isinstance(v, str) for v in listed):
                raise ValueError(f'{value!r}: write names, ["a", "b", "c"]')
            return tuple(listed)

        return self.take(key, default, convert)

    def value(self, key: str, default: Any = None) -> Any:
        """Take any value of the key, unchecked, or the default; the key is never required."""
        return self._data.pop(key, default) if self.has(key) else default

    def table(self, key: str, *, optional: bool = False) -> Self:
        """Take the table ``key``, an empty one if it is missing and ``optional``.

        The table's error if it is missing otherwise, or no table.
        """
        if not self.has(key) and not optional:
            raise self.fail(None, f"table [{'.'.join(str(p) for p in (*self._path, key))}] is missing")
        data = self._data.pop(key, {})
        if not isinstance(data, dict):
            raise self.fail(key, "must be a table")
        return self._within(data, key)

    def tables(self, key: str) -> list[Self]:
        """Take the array of tables ``key``, empty if it is missing; the table's error if it is no such array."""
        data = self._data.pop(key, []) if self.has(key) else []
        if not isinstance(data, list) or not all(isinstance(d, dict) for d in data):
            raise self.fail(key, f"must be an array of tables, [[{key}]]")
        return [self._within(d, key, i) for i, d in enumerate(data)]

    def done(self, also: Iterable[str] = ()) -> None:
        """Raise the table's error for the first key that nobody took; ``also`` are keys that are known in other cases.

        The message says whether the key is unknown, or cannot be combined with the others.
        """
        for key in self._data:
            known = sorted({*self._known, *also})
            if key in known:
                raise self.fail(key, "cannot be combined with the other keys. Leave it out")
            close = difflib.get_close_matches(key, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"known here: {', '.join(known)}"
            raise self.fail(key, f"unknown key; {hint}")

    def _within(self, data: dict[str, Any], *path: str | int) -> Self:
        return type(self)(data, (*self._path, *path), self._text, self._file, self._error)

    def stated(self, keys: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """Take the plain keys declared in ``keys``; return the values by field. Degrees become radians, choices their
        values.

        A declaration has ``field`` and ``kind`` (flag, text, choice, degrees; any other is a number), and may have
        ``default``, ``one_of``, ``positive``, ``least`` and ``most``. The table's error if a value is invalid, or
        missing without a default.
        """
        found = {}
        for key, says in keys.items():
            kind, bounds = says["kind"], {name: says[name] for name in ("positive", "least", "most") if name in says}
            if kind == "flag":
                value: Any = self.flag(key, says.get("default"))
            elif kind in ("text", "choice"):
                text = self.string(key, says.get("default"), one_of=says.get("one_of"))
                value = text if kind == "text" else says["one_of"][text]
            else:
                number = self.number(key, says.get("default"), **bounds)
                value = radians(number) if kind == "degrees" else number
            found[says["field"]] = value
        return found

    def whole(self, read: Callable[[Self], T]) -> T:
        """Return the result of ``read`` for this table; the table's error if a key was not taken."""
        found = read(self)
        self.done()
        return found

    def take(self, key: str, default: T | None, convert: Callable[[object], T]) -> T:
        """Take a key and return ``convert(value)``, or ``default`` as it is if it is missing; None: it is required.

        The message of a ValueError or ArithmeticError of ``convert`` becomes the table's error, as does a missing key.
        """
        self._known.append(key)
        if key not in self._data:
            if default is None:
                close = difflib.get_close_matches(key, self._data, 1, 0.7)
                hint = f"; is it misspelled as {close[0]}?" if close else ""
                raise self.fail(None, f"{key} is missing{hint}")
            return default
        try:
            return convert(self._data.pop(key))
        except (ValueError, ArithmeticError) as error:  # a float of 400 digits is no ValueError
            raise self.fail(key, str(error)) from None

    def _line(self, key: str | None) -> int | None:
        """Return the line in the file of the key, or else of this table, from 1; None if neither is found."""
        path = (*self._path, *([key] if key else []))
        name = next((part for part in reversed(path) if isinstance(part, str)), None)
        if name is None or not _leads(path, self._text):
            return self._line(None) if key else None
        ends = _statement_ends(self._text)
        at = bisect_left(ends, True, key=lambda end: _leads(path, self._text[:end]))
        start = ends[at - 1] if at else 0
        return self._text.count("\n", 0, max(start, self._text.find(name, start, ends[at]))) + 1


def _check_depth(value: object, levels: int = _DEEPEST) -> None:
    """Raise RecursionError if tables and lists are nested too deeply, ValueError for a text with control characters."""
    if not levels:
        raise RecursionError
    if isinstance(value, str) and "\N{REPLACEMENT CHARACTER}" in harmless(value.replace("\r", "")):
        raise ValueError(f"{value[:60]!r} has control characters; write bytes of a device in hex")
    for inner in (*value, *value.values()) if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_depth(inner, levels - 1)


def _leads(path: tuple[str | int, ...], text: str) -> bool:
    """Return whether a path leads to something in a text."""
    with suppress(LookupError, TypeError, tomllib.TOMLDecodeError):
        return reduce(getitem, path, cast(Any, tomllib.loads(text))) is not None
    return False


def _statement_ends(text: str) -> list[int]:
    """Return the ends of the statements of a TOML text: line ends outside brackets and long strings, and its end."""
    depth, ends = 0, list[int]()
    for token in _TOKEN.finditer(text):
        depth += _DEPTH.get(token[0], 0)
        if token[0] == "\n" and not depth:
            ends.append(token.end())
    return [*ends, len(text)]


def not_one_of(text: str, choices: Iterable[str]) -> str:
    """Return the text of an error for an unknown name: the possible names, and the nearest."""
    names = list(choices)
    close = difflib.get_close_matches(text, names, 1)
    return f"{text!r} is not one of {', '.join(names)}" + (f"; did you mean {close[0]}?" if close else "")


def typed(value: object, types: tuple[type, ...], expected: str) -> Any:
    """Return a value of one of these types; ValueError if it is of none. True and false are no numbers."""
    if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
        raise ValueError(f"{value!r} is not {expected}")
    return value
