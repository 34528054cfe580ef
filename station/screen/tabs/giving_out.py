"""What can be made of a recording: report, PDF, exports, by the station's commands; or its path."""

from __future__ import annotations

import asyncio
import os
from functools import partial
from pathlib import Path
from typing import Any

from station.atomic_write import free_path
from station.screen.dialogs import ChooseDialog
from station.screen.sessions.programs import ask

_OFFERED = (
    ("copy", "Copy its path"),
    ("html", "Write the report and open it"),
    ("pdf", "Write the report as PDF, too"),
    ("csv", "Export as CSV"),
    ("json", "Export as JSON"),
    ("yaml", "Export as YAML"),
    ("c", "Export as C header"),
)
_SUFFIXES = {"c": ".h"}


def give_out(app: Any, recording: Path) -> None:
    """Ask what is to be made of a recording, and make it beside the recording, under a name that is free."""

    def chosen(form: str | None) -> None:
        if form == "copy":
            app.copy_to_clipboard(str(recording.absolute()))
            app.notify(str(recording.absolute()), title="Copied", markup=False)
        elif form is not None:
            app.work(partial(_make, app, recording, form), "give out")

    app.push_screen(ChooseDialog(f"What is to be made of {recording.name}?", _OFFERED), chosen)


async def _make(app: Any, recording: Path, form: str) -> None:
    file = await asyncio.to_thread(free_path, recording.with_suffix(_SUFFIXES.get(form, f".{form}")))
    paper = form in ("html", "pdf")
    arguments = ["report", str(recording)] if paper else ["export", str(recording), "--format", form]
    answer = await ask([*arguments, "--output", str(file)])
    title, severity = ("NOT written", "error") if answer.code else ("Written", "information")
    said = answer.reason if answer.code else str(file)
    app.notify(said, title=title, severity=severity, markup=False)
    # Without a desktop a browser would run in this terminal, and nobody could press STOP.
    if form == "html" and not answer.code and (os.environ.keys() & {"DISPLAY", "WAYLAND_DISPLAY"}):
        app.open_url(file.absolute().as_uri())
