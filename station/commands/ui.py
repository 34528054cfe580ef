"""station ui: the operator's screen. Its arguments, and whether this terminal can show it."""

import argparse
import codecs
import gc
import io
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from station.errors import UsageError, sentence

if TYPE_CHECKING:
    from station.screen.choices import Choices

_NO_TERMINALS = ("", "dumb", "unknown")
_DEFECT = 1


def command_ui(arguments: argparse.Namespace) -> int:
    """Show the screen until the operator leaves it, or serve it with --web; return 0, or the code of the server.

    UsageError if no terminal can show it.
    """
    if "TEXTUAL_DRIVER" not in os.environ:  # otherwise another program draws: the server of --web
        if getattr(arguments, "web", None) is not None:
            from station.screen.web import serve

            return serve(arguments.web, arguments.typed[1:])
        _check_terminal()
    return _show(arguments)


def _check_terminal() -> None:
    """Check that stdin, stdout and stderr are a terminal that can show the screen, in UTF-8.

    UsageError with a remedy if not.
    """
    if not all(stream.isatty() for stream in (sys.stdin, sys.stdout, sys.stderr)):
        raise UsageError("station ui needs a terminal. Without one use station run, or station ui --web")
    terminal = os.environ.get("TERM", "")
    if terminal in _NO_TERMINALS:
        raise UsageError(sentence("screen.no_screen", terminal=terminal))
    encoding = sys.stderr.encoding or "ascii"
    if codecs.lookup(encoding).name != "utf-8":
        raise UsageError(sentence("screen.encoding", encoding=encoding))


def _show(arguments: argparse.Namespace) -> int:
    """Run the screen; return 0. UsageError, naming a file with the details, if it ended because of a defect."""
    gc.disable()  # until the app runs: no loaded object is garbage, and examining them costs a fifth of the start
    from rich.console import Console

    from station.screen.app import StationApp

    app = StationApp(choices_of(arguments), attach=getattr(arguments, "attach", False))
    kept = io.StringIO()
    app.error_console = Console(file=kept, width=120)
    app.run()
    if app.return_code == _DEFECT:
        raise UsageError(f"the screen ended because of a defect; please report it{_keep(kept.getvalue())}")
    return 0


def _keep(text: str) -> str:
    """Store the text of a defect in a file; return the end of a sentence, on where it is, and what to do.

    It begins with ", with PATH", left out if the file cannot be written.
    """
    from station.atomic_write import write_whole
    from station.screen.memory import state_folder

    path = state_folder() / "screen-defect.txt"
    try:
        write_whole(path, text, replace=True)
        where = f", with {path}"
    except UsageError:
        where = ""
    return f"{where}. A running session continues: station ui --attach"


def choices_of(arguments: argparse.Namespace) -> "Choices":
    """Return what the options of `station ui` or `station run --ui` choose beforehand; empty where none is given.

    UsageError for --json or --output.
    """
    from station.screen.choices import Choices

    given = vars(arguments)
    if given.get("output") or given.get("json"):
        raise UsageError(
            "--ui cannot be combined with --json and --output. Use `station ui --folder` to choose a folder"
        )
    run_options = [word for name in ("reset_fault", "end_early") if given.get(name) for word in (_option(name),)]
    for name in ("model", "seed"):
        if given.get(name) is not None:
            run_options += [_option(name), str(given[name])]
    return Choices(
        bench=given.get("bench") or "",
        script=given.get("script") or "",
        folder=Path(given.get("folder") or "recordings"),
        operator=given.get("operator") or "",
        serial=given.get("serial_number") or "",
        serial_reason=given.get("serial_reason") or "",
        scale=given.get("scale"),
        link_options=_repeated("--link", given.get("link")),
        device_options=_repeated("--device", given.get("device")),
        run_options=tuple(run_options),
    )


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _repeated(option: str, values: list[str] | None) -> tuple[str, ...]:
    return tuple(word for value in values or () for word in (option, value))
