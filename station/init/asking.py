"""Questions about keys of a bench file: the readers of the file check each answer."""

import json
import re
from collections.abc import Callable, Mapping
from typing import Any

from drivers.specs import Key
from station.errors import BenchError, UsageError
from station.init.dialogue import Dialogue
from station.schema.tables import Table

Data = dict[str, Any]
"""A table of a bench file, values as TOML has them."""

_WHERE = re.compile(r"^bench: (\S+: )?")


def read_data(data: Mapping[str, Any], read: Callable[[Table], object]) -> None:
    """Read a part of a bench file; UsageError with the fault but not its place, as the user has not seen the file."""
    try:
        read(Table(dict(data), (), "", "bench", BenchError))
    except BenchError as error:
        raise UsageError(_WHERE.sub("", str(error))) from None


def ask_key(
    dialogue: Dialogue,
    data: Data,
    key: Key,
    question: str = "",
    proposed: str | None = None,
    checked: Callable[[Data], object] = lambda data: None,
) -> Data:
    """Return a copy of the table ``data`` with the answer for one key, without the key if the answer is empty.

    The question defaults to the key's description. The present value is proposed unless ``proposed`` is given.
    ``checked`` gets the new table and raises UsageError if it is invalid; the question is then repeated, as for a value
    that the key does not allow. If nobody is asked, the proposal must be right; see ``Dialogue.ask``.
    """

    def made(text: str) -> Data:
        return {**data, key.name: _value(key, text)} if text else {k: v for k, v in data.items() if k != key.name}

    def check(text: str) -> None:
        value = made(text)
        count = len(value[key.name]) if key.each and text else 1  # whether that is right the reader of the table knows
        read_data(value, lambda table: table.option(key, list_length=count))
        checked(value)

    value = data.get(key.name, "")
    usual = ", ".join(value) if isinstance(value, list) else str(value)
    return made(dialogue.ask(question or key.doc, usual if proposed is None else proposed, check))


def _value(key: Key, text: str) -> Any:
    """Return an answer as a TOML value: a list of texts for several, a number where the key asks for one, or the text.

    Parts of a list are separated by blanks or commas, those of a list with a value for each by commas only. A text that
    should be a number and is none stays a text, which the check of the key refuses.
    """
    if key.kind == "texts" or key.each:
        return [part for part in re.split(r"\s*,\s*" if key.each else r"[\s,]+", text.strip()) if part]
    if key.kind in ("integer", "number"):
        try:
            return json.loads(text)
        except ValueError:
            return text
    return text
