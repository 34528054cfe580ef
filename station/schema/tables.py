"""TOML files read strictly, with numbers that carry their units."""

import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self, TypeVar
from urllib.parse import urlsplit

from drivers.packaged import packaged_toml
from drivers.plugins import Registry
from drivers.specs import Key
from estimator.strict_toml import StrictTable, not_one_of, typed
from station.errors import UsageError
from station.schema.quantities import QuantityError, parse

T = TypeVar("T")


class Table(StrictTable):
    """One table of a bench file or a script. Values are taken out by key; ``done`` complains of what nobody took."""

    @classmethod
    def load(cls, path: Path, error: type[UsageError]) -> Self:
        """Read a file; the given error if it cannot be read or is no TOML."""
        try:
            return cls.parse(path.read_text(encoding="utf-8"), str(path), error)
        except (OSError, UnicodeDecodeError) as reason:
            raise error(f"cannot read {path}: {reason}") from None

    @classmethod
    def parse(cls, text: str, file: str, error: type[UsageError]) -> Self:
        """Read a text; ``file`` names it in complaints."""
        try:
            return cls(tomllib.loads(text), (), text, file, error)
        except tomllib.TOMLDecodeError as reason:
            raise error(f"{file}: not valid TOML: {reason}") from None

    def quantity(self, key: str, kind: str, default: float | str | None = None, bound: str = "") -> float:
        """Take a number with a unit, in SI; ``bound`` is "above_zero", "not_negative" or none."""

        def convert(value: object) -> float:
            number = parse(value, kind)
            if bound and (number < 0 or (number == 0 and bound == "above_zero")):
                raise QuantityError("must be above zero" if bound == "above_zero" else "must not be negative")
            return number

        return self._take(key, parse(default, kind) if isinstance(default, str) else default, convert)

    def link(self, key: str, default: str) -> str:
        """Take a link whose parts can be told."""
        return self._take(key, default, link_of)

    def declared(self, section: str) -> dict[str, Any]:
        """Take the quantities that keys.toml declares for a section, by the fields that they become."""
        keys = packaged_toml("station.schema", "keys.toml")[section]
        return {
            key["field"]: self.quantity(name, key["kind"], key.get("default"), key.get("bound", ""))
            for name, key in keys.items()
        }

    def record(self, key: str, known: Registry[T], default: str | None = None) -> T:
        """Take the name of a record, and return the record."""

        def convert(value: object) -> T:
            name = str(typed(value, (str,), "a text"))
            try:
                return known[name]
            except KeyError:
                raise ValueError(not_one_of(name, known)) from None

        return self._take(key, None if default is None or self.has(key) else known[default], convert)

    def options(self, keys: Iterable[Key], folder: Path) -> dict[str, Any]:
        """Take the keys that the record of a device declares; None for one that is left out and has no default."""
        return {key.name: self.option(key, folder) for key in keys}

    def option(self, key: Key, folder: Path = Path()) -> Any:
        """Take one of them; what a text names is read from a folder."""
        name, read = key.name, key.read
        if key.default is None and not key.required and not self.has(name):
            return None
        if key.kind == "flag":
            return self.flag(name, key.default)
        if key.kind == "integer":
            number = self.integer(name, key.default)
            if (key.one_of and number not in key.one_of) or (key.bound and number < (key.bound == "above_zero")):
                raise self.fail(name, key.told.format(number))
            return number
        if key.kind == "number":
            return self.number(name, key.default)
        if key.kind != "text":
            return self.quantity(name, key.kind, key.default, key.bound)
        text = self.string(name, key.default, one_of=key.one_of or None)
        try:
            return text if read is None else read(text, folder)
        except ValueError as error:
            raise self.fail(name, str(error)) from None

    def quantities(self, key: str, kind: str, count: int, default: float | None = None) -> list[float]:
        """Take one quantity for all, or a list of ``count`` of them."""

        def convert(value: object) -> list[float]:
            if not isinstance(value, list):
                return [parse(value, kind)] * count
            if len(value) != count:
                raise QuantityError(f"{len(value)} values where {count} belong: give one for all, or one each")
            return [parse(v, kind) for v in value]

        return self._take(key, None if default is None else [default] * count, convert)


def link_of(value: object) -> str:
    """Return a link; ValueError if it is no text, or its host or port cannot be told."""
    link = str(typed(value, (str,), "a text"))
    try:
        _ = urlsplit(link).port
    except ValueError as error:
        raise ValueError(f"{link!r} is no link it can use ({error}): write tcp://host:port, or twin:") from None
    return link
