"""The style sheet of a report: for paper first, readable on a screen."""

import re

from drivers.packaged import packaged_text


def sheet(head: str, number: str, foot: str) -> str:
    """Return the style sheet with what stands at the head and the foot of every printed page."""
    shown = {"HEAD": head, "NUMBER": number, "FOOT": foot}
    text = "\n" + packaged_text("station.report", "report.css")
    return re.sub(r"\b(HEAD|NUMBER|FOOT)\b", lambda found: _quoted(shown[found.group()]), text)


def _quoted(text: str) -> str:
    """Return a text as CSS has it: whatever is in it, it ends neither the string nor the sheet."""
    return '"' + "".join(c if c.isalnum() or c in " .,:-" else f"\\{ord(c):x} " for c in text) + '"'
