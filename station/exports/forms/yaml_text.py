"""Plain values as YAML: mappings in blocks, rows of numbers in one line, texts always quoted."""

import json
import re
from collections.abc import Mapping, Sequence

from station.exports.written import number

Plain = Mapping[str, "Plain"] | Sequence["Plain"] | str | float | int | bool | None
"""What JSON and YAML hold."""

_UNPRINTABLE = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ud800-\udfff]")
_WORD = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
_NOT_TEXT = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}


def yaml_lines(value: Mapping[str, Plain], indent: int = 0) -> list[str]:
    """Return a mapping as lines of YAML 1.1 and 1.2."""
    lines = []
    for key, held in value.items():
        start = " " * indent + _key(key) + ":"
        if isinstance(held, Mapping) and held:
            lines += [start, *yaml_lines(held, indent + 2)]
        elif isinstance(held, Sequence) and not isinstance(held, str) and any(isinstance(h, Mapping) for h in held):
            lines.append(start)
            for entry in held:
                assert isinstance(entry, Mapping)
                first, *rest = yaml_lines(entry, indent + 4)
                lines += [" " * (indent + 2) + "- " + first.lstrip(), *rest]
        else:
            lines.append(f"{start} {_inline(held)}")
    return lines


def _key(key: str) -> str:
    return key if _WORD.match(key) and key.lower() not in _NOT_TEXT else _quoted(key)


def _inline(value: Plain) -> str:
    if value is None:
        return "null"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return number(value)
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, Mapping):
        return "{}"
    return f"[{', '.join(_inline(held) for held in value)}]"


def _quoted(text: str) -> str:
    """Return a text in double quotes: what JSON escapes, and what YAML does not take as it is."""
    return _UNPRINTABLE.sub(lambda found: f"\\u{ord(found.group()):04x}", json.dumps(text, ensure_ascii=False))
