"""Actions on a recording in the command palette: copy its path, report, PDF, exports."""

import asyncio
import os
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from textual.app import SystemCommand

from station.atomic_write import free_path
from station.screen.sessions.programs import done

_PAPER = {"html": "Report, written and opened", "pdf": "Report as PDF", "xml": "Digital certificate with its PDF"}
_EXPORTS = {"csv": "Export as CSV", "json": "Export as JSON", "yaml": "Export as YAML", "h": "Export as C header"}


def offered(app: Any, recording: Path) -> Iterator[SystemCommand]:
    """Yield the actions on a recording; files are written beside it under an unused name."""
    yield SystemCommand("Copy path", str(recording), partial(app.copy_to_clipboard, str(recording.absolute())))
    for suffix, words in (_PAPER | _EXPORTS).items():
        make = partial(app.work, partial(_make, app, recording, suffix), "give out")
        yield SystemCommand(words, f"of {recording.name}", make)


async def _make(app: Any, recording: Path, suffix: str) -> None:
    """Write a report or export beside a recording, under a free name; tell the operator the file or why it failed.

    ``suffix`` is that of the file: "html" or "pdf" for a report, "xml" for a DCC with the report as PDF, "h" for source
    code in C, others for the export of that name. On a desktop HTML is then opened in a browser; elsewhere a browser
    would run in this terminal and hide STOP.
    """
    named = recording.with_suffix(".pdf" if suffix == "xml" else f".{suffix}")
    file = await asyncio.to_thread(free_path, named, further_suffixes=[".html", ".xml"] if suffix in _PAPER else [])
    how = ["report"] if suffix in _PAPER else ["export", "--format", "c" if suffix == "h" else suffix]
    answer = await done([*how, str(recording), "--output", str(file), *["--dcc"] * (suffix == "xml")])
    title, severity = ("NOT written", "error") if answer.code else ("Written", "information")
    app.notify(answer.reason if answer.code else str(file), title=title, severity=severity, markup=False)
    # Without a desktop a browser would run in this terminal, and STOP would be out of reach.
    if suffix == "html" and not answer.code and (os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}):
        app.open_url(file.absolute().as_uri())
