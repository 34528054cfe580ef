"""TOML files read strictly: every key known, every value of its type and unit, every complaint with its line."""

from __future__ import annotations

import difflib
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

from station.errors import UsageError
from station.quantities import QuantityError, parse

T = TypeVar("T")

_HEADER = re.compile(r"^\s*\[(\[?)\s*([^\[\]]+?)\s*\]")


class Table:
    """One table of a TOML file. Values are taken out by key; ``done`` complains of what nobody took."""

    def __init__(
        self, data: dict[str, Any], path: tuple[str | int, ...], text: str, file: str, error: type[UsageError]
    ) -> None:
        """``path`` leads to this table from the top of the file: keys, and indices in arrays of tables."""
        self._data, self._path, self._text, self._file, self._error = dict(data), path, text, file, error
        self._known: list[str] = []

    def again(self) -> Table:
        """Return this table as it is now, for somebody else to take from."""
        return Table(self._data, self._path, self._text, self._file, self._error)

    @classmethod
    def load(cls, path: Path, error: type[UsageError]) -> Table:
        """Read a file; the given error if it cannot be read or is no TOML."""
        try:
            return cls.parse(path.read_text(encoding="utf-8"), str(path), error)
        except (OSError, UnicodeDecodeError) as reason:
            raise error(f"cannot read {path}: {reason}") from None

    @classmethod
    def parse(cls, text: str, file: str, error: type[UsageError]) -> Table:
        """Read a text; ``file`` names it in complaints."""
        try:
            return cls(tomllib.loads(text), (), text, file, error)
        except tomllib.TOMLDecodeError as reason:
            raise error(f"{file}: not valid TOML: {reason}") from None

    def fail(self, key: str | None, message: str) -> UsageError:
        """Return an error that names file, line and key."""
        line = self._line(key)
        where = f"{self._file}, line {line}" if line else self._file
        name = ".".join(str(p) for p in (*self._path, *([key] if key else [])))
        return self._error(f"{where}: {name}: {message}" if name else f"{where}: {message}")

    def has(self, key: str) -> bool:
        """Return whether the key is there and not taken yet."""
        self._known.append(key)
        return key in self._data

    def quantity(self, key: str, kind: str, default: float | None = None) -> float:
        """Take a number with a unit, in SI."""
        return self._take(key, default, lambda value: parse(value, kind))

    def quantities(self, key: str, kind: str, count: int, default: float | None = None) -> list[float]:
        """Take one quantity for all, or a list of ``count`` of them."""

        def convert(value: object) -> list[float]:
            if not isinstance(value, list):
                return [parse(value, kind)] * count
            if len(value) != count:
                raise QuantityError(f"{len(value)} values for {count} gyros: give one for all, or one each")
            return [parse(v, kind) for v in value]

        return self._take(key, None if default is None else [default] * count, convert)

    def number(self, key: str, default: float | None = None) -> float:
        """Take a plain number."""
        return self._take(key, default, lambda value: float(_typed(value, (int, float), "a number")))

    def integer(self, key: str, default: int | None = None) -> int:
        """Take a whole number."""
        return self._take(key, default, lambda value: int(_typed(value, (int,), "a whole number")))

    def flag(self, key: str, default: bool) -> bool:
        """Take true or false."""
        return self._take(key, default, lambda value: bool(_typed(value, (bool,), "true or false")))

    def string(self, key: str, default: str | None = None, *, one_of: Iterable[str] | None = None) -> str:
        """Take a text, one of a few if so given."""

        def convert(value: object) -> str:
            text = str(_typed(value, (str,), "a text"))
            if one_of is not None and text not in (choices := list(one_of)):
                raise QuantityError(f"{text!r} is not one of {', '.join(choices)}")
            return text

        return self._take(key, default, convert)

    def value(self, key: str, default: Any = None) -> Any:
        """Take whatever is there."""
        return self._data.pop(key, default) if self.has(key) else default

    def table(self, key: str, *, optional: bool = False) -> Table:
        """Take a table within this one."""
        if not self.has(key):
            if not optional:
                raise self.fail(None, f"table [{'.'.join(str(p) for p in (*self._path, key))}] is missing")
            return Table({}, (*self._path, key), self._text, self._file, self._error)
        data = self._data.pop(key)
        if not isinstance(data, dict):
            raise self.fail(key, "must be a table")
        return Table(data, (*self._path, key), self._text, self._file, self._error)

    def tables(self, key: str) -> list[Table]:
        """Take an array of tables."""
        data = self._data.pop(key, []) if self.has(key) else []
        if not isinstance(data, list) or not all(isinstance(d, dict) for d in data):
            raise self.fail(key, f"must be an array of tables, [[{key}]]")
        return [Table(d, (*self._path, key, i), self._text, self._file, self._error) for i, d in enumerate(data)]

    def done(self) -> None:
        """Complain of the first key that nobody took."""
        for key in self._data:
            close = difflib.get_close_matches(key, self._known, 1)
            hint = f"did you mean {close[0]}?" if close else f"known here: {', '.join(sorted(set(self._known)))}"
            raise self.fail(key, f"unknown key; {hint}")

    def _take(self, key: str, default: T | None, convert: Callable[[object], T]) -> T:
        self._known.append(key)
        if key not in self._data:
            if default is None:
                raise self.fail(None, f"{key} is missing")
            return default
        try:
            return convert(self._data.pop(key))
        except QuantityError as error:
            raise self.fail(key, str(error)) from None

    def _line(self, key: str | None) -> int | None:
        """Return the line where the key, or else the table's header, stands."""
        names = [str(p) for p in self._path if isinstance(p, str)]
        indices = [p for p in self._path if isinstance(p, int)]
        wanted, seen, current, found = ".".join(names), 0, "", None
        inside = not names
        for number, line in enumerate(self._text.splitlines(), 1):
            header = _HEADER.match(line)
            if header:
                current = header.group(2).replace(" ", "")
                if header.group(1) and wanted.startswith(current):
                    seen += 1
                here = not indices or seen == indices[0] + 1
                inside = current == wanted and here
                if inside:
                    found = found or number
            elif inside and key and re.match(rf"^\s*\"?{re.escape(key)}\"?\s*[.=]", line):
                return number
        if key and not found:  # an inline table: look for the key anywhere
            for number, line in enumerate(self._text.splitlines(), 1):
                if re.search(rf"\b{re.escape(key)}\s*=", line):
                    return number
        return found


def _typed(value: object, types: tuple[type, ...], what: str) -> Any:
    if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
        raise QuantityError(f"{value!r} is not {what}")
    return value
