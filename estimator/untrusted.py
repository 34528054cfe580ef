"""What strangers made: files read up to a size, texts made harmless."""

import json
import os
import stat
from pathlib import Path
from typing import Any

MOST_TEXT_BYTES = 1 << 20
"""Of a file that people write."""
MOST_DATA_BYTES = 1 << 29
"""Of a file of foreign data, of which several copies are held while it is read."""
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"

_HARMFUL = dict.fromkeys(
    {*range(32), *range(0x7F, 0xA0), 0x61C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A)}.union(
        range(0xD800, 0xE000)
    )
    - {9, 10},
    "\N{REPLACEMENT CHARACTER}",
)


def harmless(text: str) -> str:
    """Return a text with control characters of terminals (C0, C1), direction marks and unencodable characters replaced.

    In their place comes U+FFFD each. Line feeds and tabs are kept; CR LF becomes a line feed.
    """
    return text.replace("\r\n", "\n").translate(_HARMFUL)


def read_json(text: str) -> Any:
    """Return the value of a JSON text, its texts made harmless, as JSON escapes can hold any character.

    ValueError or RecursionError if it is not JSON.
    """
    return _cleaned(json.loads(text))


def _cleaned(value: Any) -> Any:
    """Return a JSON value with all texts and keys made harmless."""
    if isinstance(value, str):
        return harmless(value)
    if isinstance(value, list):
        return [_cleaned(item) for item in value]
    if isinstance(value, dict):
        return {harmless(key): _cleaned(item) for key, item in value.items()}
    return value


def read_bytes(
    path: Path, error: type[Exception], most_bytes: int = MOST_DATA_BYTES, name: str = "", wanted: str = ""
) -> bytes:
    """Return a file's content; ``error`` if it is not a regular file, cannot be read, or has more than ``most_bytes``.

    ``name`` stands for the path in messages. ``wanted`` names the expected file, for instance "a bench file (.toml)": a
    recording (HDF5) is then refused.
    """
    name = name or str(path)
    try:
        with open(path, "rb", opener=_at_once) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise error(f"{name} is a pipe or a device, not a file: save what it gives in a file")
            content = file.read(most_bytes + 1)
    except (OSError, ValueError) as reason:  # a name with a null character is a ValueError
        raise error(f"{name} cannot be read: {getattr(reason, 'strerror', None) or reason}") from None
    if wanted and content.startswith(_HDF5_SIGNATURE):
        raise error(f"{name} is a recording, not {wanted}")
    if len(content) > most_bytes:
        raise error(f"{name} is larger than {most_bytes >> 20} MB: check that it is the right file, or split it")
    return content


def read_text(path: Path, error: type[Exception], wanted: str = "a text file") -> str:
    """Return a UTF-8 text file, with or without byte order mark; line ends become line feeds.

    ``error`` for other encodings and as ``read_bytes``; ``wanted`` names the expected file there.
    """
    content = read_bytes(path, error, MOST_TEXT_BYTES, wanted=wanted)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as reason:
        line = content.count(b"\n", 0, reason.start) + 1
        raise error(f"{path} cannot be read: line {line} is no text in UTF-8: save it in that encoding") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _at_once(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))  # a pipe without a writer does not block
