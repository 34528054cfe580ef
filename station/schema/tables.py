"""TOML files read strictly, with numbers that carry their units."""

import tomllib
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from drivers.packaged import packaged_toml
from estimator.strict_toml import StrictTable, typed
from station.errors import UsageError
from station.schema.quantities import QuantityError, parse


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

        return self.take(key, parse(default, kind) if isinstance(default, str) else default, convert)

    def link(self, key: str, default: str) -> str:
        """Take a link whose parts can be told."""
        return self.take(key, default, link_of)

    def declared(self, section: str) -> dict[str, Any]:
        """Take the quantities that keys.toml declares for a section, by the fields that they become."""
        keys = packaged_toml("station.schema", "keys.toml")[section]
        return {
            key["field"]: self.quantity(name, key["kind"], key.get("default"), key.get("bound", ""))
            for name, key in keys.items()
        }

    def quantities(self, key: str, kind: str, count: int, default: float | None = None) -> list[float]:
        """Take one quantity for all, or a list of ``count`` of them."""

        def convert(value: object) -> list[float]:
            if not isinstance(value, list):
                return [parse(value, kind)] * count
            if len(value) != count:
                raise QuantityError(f"{len(value)} values where {count} belong: give one for all, or one each")
            return [parse(v, kind) for v in value]

        return self.take(key, None if default is None else [default] * count, convert)


def link_of(value: object) -> str:
    """Return a link; ValueError if it is no text, or its host or port cannot be told."""
    link = str(typed(value, (str,), "a text"))
    try:
        _ = urlsplit(link).port
    except ValueError as error:
        raise ValueError(f"{link!r} is no link it can use ({error}): write tcp://host:port, or twin:") from None
    return link
