"""Files for people to edit, written with the declarations of their keys as comments."""

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from drivers.specs import Key
from station.schema.tables import keys_of

_COMMENTS = 40  # the column behind which they begin


def lines_of(
    data: Mapping[str, Any],
    sections: Iterable[str],
    docs: Mapping[str, str],
    path: str = "",
    name: str = "",
    *,
    more: Iterable[Key] = (),
) -> Iterator[str]:
    """Yield the lines of a TOML table with these sections and the keys ``more``; values in ``data`` are TOML values.

    Values come first, then the tables in it; ``name`` is the prefix of their headings ("table."), and ``path`` that of
    the keys of ``docs``, both empty for a file. A key that is left out is written as a comment if it has an example,
    and so is a table that is left out, unless it has a default. A list of tables has headings in a file, and is one
    value within a table. ``docs`` are comments that replace the declared ones, by path: "table.link", or
    "imu.array.rate" for the device "array".
    """
    keys = {key.name: key for key in (*(key for section in sections for key in keys_of(section)), *more)}
    inner = {own: value for own, value in data.items() if isinstance(value, dict) or (not path and _tables(value))}
    for own, value in data.items():
        if own not in inner:
            yield _line(f"{own} = {_text(value)}", docs.get(f"{path}{own}", keys[own].doc if own in keys else ""))
    for key in keys.values():
        if key.name not in data and key.example is not None:
            yield _line(f"#{key.name} = {_text(key.example)}", key.doc)
    for own, value in inner.items():
        key = keys.get(own) or keys["*"]
        for table in [value] if isinstance(value, dict) else value:
            several = key.kind == "tables"
            yield from ("", _line(f"[[{name}{own}]]" if several else f"[{name}{own}]", key.doc))
            within = f"{path}{own}.{table['name']}." if several else f"{path}{own}."
            yield from lines_of(table, key.of, docs, within, f"{name}{own}.")
    for key in keys.values():
        if key.kind == "table" and key.default is None and key.name not in (*data, "*"):
            yield from ("", _line(f"#[{name}{key.name}]", key.doc))
            for left in (left for section in key.of for left in keys_of(section)):
                yield _line(f"#{left.name} = {_text(left.example or left.default)}", left.doc)


def _tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) for one in value)


def _line(text: str, comment: str) -> str:
    first, end, rest = text.partition("\n")
    return f"{first:<{_COMMENTS - 1}} # {comment}{end}{rest}" if comment else text


def _text(value: Any) -> str:
    """Return a value as TOML has it, tables one a line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_text(own)}" for key, own in value.items()) + " }"
    if isinstance(value, list) and _tables(value):
        return "[\n" + "".join(f"    {_text(one)},\n" for one in value) + "]"
    return json.dumps(value, ensure_ascii=False)
