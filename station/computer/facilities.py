"""System facilities that the station is built on. No import here may need any of them."""

import importlib
import socket
import sys

_REQUIRED = {
    "fcntl": "locks on files",
    "resource": "limits on memory",
    "termios": "serial ports and terminals",
}
"""Modules of Python that only Unix has, and what they are for."""


def missing_facility() -> str:
    """Return one line about the first module that this system lacks, and what to do; empty if none is missing."""
    for module, purpose in _REQUIRED.items():
        try:
            importlib.import_module(module)
        except ImportError:
            where = "on Windows, use WSL2" if sys.platform == "win32" else "use a Python that was built with it"
            return f"this system lacks {module} ({purpose}): the station runs on Linux; {where}"
    return ""


def peer_note() -> str:
    """Return one line saying that this system does not identify users of a local socket; empty if it does.

    Systems with ``SO_PEERCRED``, such as Linux, do.
    """
    if hasattr(socket, "SO_PEERCRED"):
        return ""
    return (
        "this system does not identify the user who connects to a local socket, so only the permissions of its "
        "folder protect a session"
    )
