"""The program of a bench file that is given the result of each run, for instance to tell a factory's system."""

import json
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

from estimator.untrusted import harmless

LIMIT_S = 60.0
"""How long the program may take; then it is ended."""


def tell_program(command: Sequence[str], result: Mapping[str, Any], limit_s: float = LIMIT_S) -> str:
    """Start a program with the result as one JSON object on its standard input, and wait until it ends.

    Return what went wrong in words, empty if its exit code was 0. What it prints is shown only if it failed.
    """
    try:
        done = subprocess.run(
            command, input=json.dumps(result), capture_output=True, text=True, errors="replace", timeout=limit_s
        )
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {limit_s:g} s, and was ended"
    except (OSError, ValueError) as error:
        return f"{command[0]} could not be started: {getattr(error, 'strerror', None) or error}"
    if done.returncode == 0:
        return ""
    last_line = (done.stderr.strip() or done.stdout.strip()).rpartition("\n")[2]
    return harmless(f"{command[0]} ended with exit code {done.returncode}{': ' if last_line else ''}{last_line}")
