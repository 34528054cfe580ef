"""The program of a bench file that gets the result of each run, for instance for a factory's system."""

import json
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import IO, Any

from estimator.untrusted import harmless

LIMIT_S = 60.0
"""How long the program may take; then it is ended."""
_LAST_BYTES = 4096


def tell_program(command: Sequence[str], result: Mapping[str, Any], limit_s: float = LIMIT_S) -> str:
    """Run a program with ``result`` as one JSON object on its standard input; return what went wrong, "" for exit code
    0.

    ``command`` is the program and its arguments. What goes wrong is that it could not be started, took more than
    ``limit_s``, was ended by Ctrl-C, or another exit code, with the last line that it printed. Processes that it leaves
    running are not waited for, but are ended with it at the time limit or Ctrl-C. Nothing else that it prints is shown.
    """
    with tempfile.TemporaryFile() as printed:
        try:
            program = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=printed, stderr=subprocess.STDOUT, start_new_session=True
            )
        except (OSError, ValueError) as error:
            return f"{command[0]} could not be started: {getattr(error, 'strerror', None) or error}"
        try:
            program.communicate(json.dumps(result).encode(), timeout=limit_s)
        except subprocess.TimeoutExpired:
            _end(program)
            return f"{command[0]} did not end within {limit_s:g} s and was stopped"
        except KeyboardInterrupt:
            _end(program)
            return f"{command[0]} was ended by Ctrl-C"
        if program.returncode == 0:
            return ""
        last_line = _last_line(printed)
    return harmless(f"{command[0]} ended with exit code {program.returncode}{': ' if last_line else ''}{last_line}")


def _end(program: subprocess.Popen[bytes]) -> None:
    """Kill a program and all that it has started in its session."""
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(program.pid, signal.SIGKILL)
    program.wait()


def _last_line(printed: IO[bytes]) -> str:
    size = printed.seek(0, os.SEEK_END)
    printed.seek(max(size - _LAST_BYTES, 0))
    return printed.read().decode(errors="replace").strip().rpartition("\n")[2]
