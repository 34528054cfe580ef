"""Blocks of a page that show what a command prints, beside what it prints now."""

from __future__ import annotations

import re
from pathlib import Path

LEFT_OUT = "..."
_NUMBER = re.compile(r"\d+(?:\.\d+)?")


def blocks_of(page: Path) -> list[list[str]]:
    """Return the lines of each fenced block of a page that has no language: what a terminal shows."""
    blocks = re.findall(r"^```([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    return [block.splitlines() for language, block in blocks if not language]


def not_printed(block: list[str], printed: list[str]) -> str:
    """Return the first line of a block that is not printed in its place, with what is; empty if all are.

    Lines stand in their order, and directly below each other but for where ``...`` leaves some out. A figure may be
    another in its last digit: it differs by processors.
    """
    at, anywhere = 0, False
    for line in block:
        if line.strip(" │").startswith(LEFT_OUT):
            anywhere = True
            continue
        until = len(printed) if anywhere else at + 1
        place = next((n for n in range(at, min(until, len(printed))) if _alike(line, printed[n])), None)
        if place is None:
            return f"{line!r}, in its place {printed[at : at + 1]}"
        at, anywhere = place + 1, False
    return ""


def _alike(shown: str, printed: str) -> bool:
    if _NUMBER.split(shown.rstrip()) != _NUMBER.split(printed.rstrip()):
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    return all(abs(float(one) - float(other)) <= 1.1 * 10.0 ** -len(one.partition(".")[2]) for one, other in pairs)
