"""TOML files written by people, read strictly by the declarations of keys in the TOML files beside this module."""

import math
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any, TypeVar
from urllib.parse import urlsplit

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from drivers.specs import Key
from estimator.strict_toml import StrictTable, not_one_of, typed
from station.errors import UsageError
from station.schema.quantities import UNITS, parse

T = TypeVar("T")

_LINKS = ("twin", "serial", "tcp", "rfc2217", "socket", "can")
_WRONG = {"above_zero": "must be above zero", "not_negative": "must not be negative"}


@cache
def keys_of(section: str) -> tuple[Key, ...]:
    """Return the keys of a section: "bench.site" is that of the name in bench.toml."""
    kind, name = section.split(".")
    return tuple(Key(key, **facts) for key, facts in packaged_toml("station.schema", f"{kind}.toml")[name].items())


class Table(StrictTable):
    """One table of a file written by a person."""

    def fail_at(self, message: str) -> Exception:
        """Return, not raise, the error for a message that begins with its place in the file: "tone.1.size: ..."."""
        where, _, problem = message.partition(": ")
        *way, key = (int(part) if part.isdigit() else part for part in where.split("."))
        place = type(self)({}, tuple(way), self._text, self._file, self._error)
        return place.fail(str(key), problem)

    def read(
        self, section: str, folder: Path = Path(), *, list_length: int = 1, **made: Callable[[str, Path], Any]
    ) -> dict[str, Any]:
        """Take the keys of a section and return their values by field.

        A key that is left out has its default, else None, or [] for tables. Paths count from ``folder``;
        ``list_length`` is the length of lists with one value for each. ``made`` has converters (text, folder) by key,
        the message of whose ValueError is shown. The table's error for a value that is invalid, or left out and
        required; unknown keys remain.
        """
        keys = (replace(key, read=made.get(key.name)) for key in keys_of(section))
        return {key.field or key.name: self.option(key, folder, list_length) for key in keys}

    def read_all(self, section: str, folder: Path = Path(), **more: Any) -> dict[str, Any]:
        """Take a section as ``read`` does with its keywords ``more``, and raise the table's error for unknown keys."""
        found = self.read(section, folder, **more)
        self.done()
        return found

    def check(self, *sections: str) -> None:
        """Check the table and all tables in it against the declarations of ``sections``, and take all their keys.

        The key "*" of a section declares all keys that have no declaration of their own. The table's error for a value
        that is invalid, and for a key that is not declared.
        """
        keys = {key.name: key for section in sections for key in keys_of(section)}
        for name in {**keys, **dict.fromkeys(self.remaining())}:
            if name != "*" and (key := keys.get(name) or keys.get("*")):
                found = self.option(replace(key, name=name))
                for table in found if isinstance(found, list) else [found]:
                    if isinstance(table, Table):
                        table.check(*key.of)
        self.done()

    def options(self, keys: Iterable[Key], folder: Path) -> dict[str, Any]:
        """Take the keys that the record of a device declares, by their names."""
        return {key.name: self.option(key, folder) for key in keys}

    def option(self, key: Key, folder: Path = Path(), list_length: int = 1) -> Any:
        """Take one key and return its value as declared; if it is left out its default, else None, or [] for tables.

        The table's error if it is invalid, or left out and required. ``list_length`` as for ``read``.
        """
        if not self.has(key.name) and key.default is None and not key.required:
            return [] if key.kind == "tables" else None
        if key.kind == "table":
            return self.table(key.name, optional=not key.required)
        if key.kind == "tables":
            return self.tables(key.name)

        def convert(value: object) -> Any:
            try:
                return _value(key, value, folder, list_length)
            except UsageError as error:  # of another file that it names
                raise ValueError(str(error)) from None

        default = convert(key.default) if isinstance(key.default, str | list) else key.default
        return self.take(key.name, default, convert)


def known_in(known: Registry[T]) -> Callable[[str, Path], T]:
    """Return a converter from the name of a record, and a folder that it ignores, to the record.

    Its ValueError lists the known names and the nearest.
    """

    def record(name: str, _: Path) -> T:
        try:
            return known[name]
        except KeyError:
            raise ValueError(not_one_of(name, known)) from None

    return record


def _value(key: Key, value: object, folder: Path, list_length: int) -> Any:
    """Return the value of a key, converted by its kind; ValueError if it is invalid.

    Numbers with units are returned in SI, dates as dates, paths with ``folder`` before them, lists of texts as tuples.
    Of a key for each of several things it is a tuple of ``list_length`` numbers, one number standing for all. A file
    that has a schema is checked by it if it exists; UsageError if it is invalid. A key with a converter ``read`` has
    what that makes of the text.
    """
    if key.each:
        values = value if isinstance(value, list) else [value] * list_length
        if len(values) != list_length:
            raise ValueError(f"{len(values)} values instead of {list_length}: give one for all, or one each")
        return tuple(_number(key, one) for one in values)
    if key.bound == "not_blank" and "" in (str(one).strip() for one in (value if isinstance(value, list) else [value])):
        raise ValueError(f"{value!r} is blank. Fill it in, or leave it out")
    if key.kind == "texts":
        return _texts(key, value)
    if key.kind == "any":
        return value
    if key.kind == "flag":
        return typed(value, (bool,), "true or false")
    if key.kind in ("integer", "number", *UNITS):
        return _number(key, value)
    if key.kind == "date":
        with suppress(ValueError):
            return date.fromisoformat(str(value))  # that of TOML, too
        raise ValueError(f"{str(value)!r} is not a date. Write it as 2026-11-23")
    text = str(typed(value, (str,), "a text"))
    if key.one_of and text not in key.one_of:
        raise ValueError(key.told.format(text) or not_one_of(text, key.one_of))
    if key.file and (file := folder / text).is_file():
        Table.load(file, UsageError).check(key.file)
    if key.read is not None:
        return key.read(text, folder)
    if key.kind == "pattern":
        try:
            re.compile(text)
        except re.error as error:
            raise ValueError(f"not a regular expression: {error}") from None
    return folder / text if key.kind == "path" else link_of(text) if key.kind == "link" else text


def _texts(key: Key, value: object) -> tuple[str, ...]:
    """Return a list of texts, or a single text, as a tuple.

    ValueError for an empty list, anything but texts, and, of a fixed choice, other or repeated texts.
    """
    listed = value if isinstance(value, list) else [value]
    if not listed or not all(isinstance(one, str) for one in listed):
        raise ValueError(key.told.format(value) or f'{value!r}: write names, ["a", "b", "c"]')
    if key.one_of and (len({*listed}) < len(listed) or not {*listed} <= {*key.one_of}):
        raise ValueError(key.told.format(value))
    return tuple(listed)


def _number(key: Key, value: object) -> float:
    """Return a number within the key's bounds, in SI if it has a unit, integers included.

    ValueError if it is of another type, not finite or beyond the bounds.
    """
    number: float
    if key.kind == "integer":
        number = int(typed(value, (int,), "a whole number"))
    elif key.kind == "number":
        number = float(typed(value, (int, float), "a number"))
    else:
        number = parse(value, key.kind)
    if not math.isfinite(number):
        raise ValueError(f"{value!r}: write a number")
    if not _within(key, number):
        raise ValueError(key.told.format(value) or _WRONG.get(key.bound) or f"{value}: give {key.bound}")
    return number


def _within(key: Key, number: float) -> bool:
    if key.one_of:
        return number in key.one_of
    if key.bound in _WRONG:
        return number > 0 or (number == 0 and key.bound == "not_negative")
    ends = [parse(end, key.kind) if key.kind in UNITS else float(end) for end in key.bound.split(" to ") if end]
    return not ends or ends[0] <= number <= ends[1]


def link_of(value: object) -> str:
    """Return a link; ValueError if it is not a text, or its scheme or port is invalid. An empty one is valid."""
    link = str(typed(value, (str,), "a text"))
    try:
        url = urlsplit(link)
        if link and url.scheme not in _LINKS:
            raise ValueError(not_one_of(url.scheme, _LINKS))
        _ = url.port
    except ValueError as error:
        raise ValueError(f"{link!r} is not a link it supports ({error}). Write tcp://host:port, or twin:") from None
    return link
