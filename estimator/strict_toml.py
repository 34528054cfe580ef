"""Tables of a TOML file, read strictly: every key is taken once, with its type, and what is left is refused."""

from __future__ import annotations

import math
import re
from typing import Any

from estimator.errors import RecordingError


class Section:
    """One table of the mapping file: every key is taken once, and what is left over is refused."""

    def __init__(self, file: str, text: str, path: str, values: Any) -> None:
        if not isinstance(values, dict):
            raise RecordingError(f"{file}: {path} must be a table, [{path}], not {values!r}")
        self._file, self._text, self._path = file, text, path
        self._values: dict[str, Any] = dict(values)
        self._known: list[str] = []

    def wrong(self, key: str, problem: str) -> RecordingError:
        """Return the error that names file, line, table and key."""
        line = _line_of(self._text, self._path, key)
        at = f", line {line}" if line else ""
        where = f" in [{self._path}]" if self._path else ""
        return RecordingError(f"{self._file}{at}: {key}{where} {problem}")

    def has(self, key: str) -> bool:
        return key in self._values

    def table(self, key: str) -> Section:
        self._known.append(key)
        return Section(self._file, self._text, f"{self._path}.{key}" if self._path else key, self._values.pop(key, {}))

    def text(self, key: str, default: str | None = None, *, one_of: tuple[str, ...] = ()) -> str:
        value = self._take(key, default)
        choices = f"one of {', '.join(one_of)}" if one_of else "a text in quotes"
        if not isinstance(value, str) or (one_of and value not in one_of):
            raise self.wrong(key, f"is {value!r}: write {choices}")
        return value

    def flag(self, key: str, default: bool | None = None) -> bool:
        value = self._take(key, default)
        if not isinstance(value, bool):
            raise self.wrong(key, f"is {value!r}: write true or false")
        return value

    def number(self, key: str, default: float | None = None, *, positive: bool = False, least: float = -1e18) -> float:
        value = self._take(key, default)
        good = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
        if not good or value < least or (positive and value <= 0):
            bound = " above 0" if positive else f" of {least:g} or more" if least > -1e18 else ""
            raise self.wrong(key, f"is {value!r}: write a number{bound}")
        return float(value)

    def texts(self, key: str, default: tuple[str, ...] | None = None) -> tuple[str, ...]:
        value = self._take(key, default)
        if isinstance(value, str):
            value = [value]
        if not isinstance(value, (list, tuple)) or not value or not all(isinstance(v, str) for v in value):
            raise self.wrong(key, f'is {value!r}: write names, ["a", "b", "c"]')
        return tuple(value)

    def any(self, key: str, default: Any = None) -> Any:
        return self._take(key, default if default is not None else "")

    def remaining(self) -> tuple[str, ...]:
        return tuple(self._values)

    def done(self, also: tuple[str, ...] = ()) -> None:
        """Refuse what was not taken; ``also`` are keys that other mappings may have here."""
        for key in self._values:
            known = sorted({*self._known, *also})
            raise self.wrong(key, f"is not known here, or not beside the other keys: known are {', '.join(known)}")

    def _take(self, key: str, default: Any) -> Any:
        self._known.append(key)
        if key in self._values:
            return self._values.pop(key)
        if default is None:
            raise RecordingError(f"{self._file}: [{self._path}] lacks {key}: add it")
        return default


def _line_of(text: str, table: str, key: str) -> int | None:
    """Return the line on which a key of a table, or a table of this name, is written."""
    inside = ""
    for number, line in enumerate(text.splitlines(), 1):
        header = re.match(r"\s*\[+\s*([^\]]+?)\s*\]", line)
        if header:
            inside = header[1]
            if inside in (key, f"{table}.{key}") and table != inside:
                return number
        elif inside in (table, table.rsplit(".", 1)[0]) and re.match(rf"\s*[\"']?{re.escape(key)}[\"']?\s*=", line):
            return number
    return None
