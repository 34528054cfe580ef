"""Commands of the station as forks of a process that has imported it, for tests that ask nothing of the start.

One server is there for a whole session of pytest and all of its workers: ``offered`` names its folder in the
environment, the first process that wants it starts it, and it ends with the process that offered it.
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_HERE = Path(__file__).parent
_FOLDER = "STATION_TESTS_FORKS"
HOSTS_TOO = {"STATION_TESTS_FORKS_HOSTS": "yes"}
"""Set for a command with ``--host`` that may be forked: nobody looks for its session by the number of the process."""
_START_LIMIT_S = 60.0
PYTHON = sys.executable


@contextmanager
def offered() -> Iterator[None]:
    """Offer a server to this process and those that it starts, until the end of the context."""
    if sys.platform != "linux" or _FOLDER in os.environ:
        yield
        return
    folder = tempfile.mkdtemp(prefix="forks-")  # a short path: a socket's address has little room
    os.mkfifo(f"{folder}/alive")
    alive = os.open(f"{folder}/alive", os.O_RDWR)
    os.environ[_FOLDER] = folder
    try:
        yield
    finally:
        del os.environ[_FOLDER]
        os.close(alive)
        shutil.rmtree(folder)


def interpreter() -> str:
    """Return what to start in the place of Python, so that ``-m station.cli`` is a fork and all else a new process.

    Without a server it is Python itself.
    """
    if _FOLDER not in os.environ:
        return PYTHON
    folder = Path(os.environ[_FOLDER])
    program = folder / "python"
    if not program.exists():
        _start(folder, program)
    return str(program)


def _start(folder: Path, program: Path) -> None:
    """Start the server if no other process does, and wait for it."""
    import fcntl

    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if program.exists():
            return
        address = folder / "socket"
        words = [PYTHON, "-P", str(_HERE / "server.py"), str(address), str(folder / "alive")]
        no_input = (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)
        # Not by subprocess, which holds that a process must not outlive its parent.
        server = os.posix_spawn(PYTHON, words, os.environ, file_actions=[no_input], setsid=True)
        limit_s = time.monotonic() + _START_LIMIT_S
        while not address.exists():
            if os.waitpid(server, os.WNOHANG)[0] or time.monotonic() > limit_s:
                raise RuntimeError("the server of forks did not start")
            time.sleep(0.02)
        line = shlex.join([PYTHON, "-I", "-S", str(_HERE / "start.py"), str(address)])
        draft = folder / "draft"
        draft.write_text(f'#!/bin/sh\nexec {line} "$@"\n', encoding="utf-8")
        draft.chmod(0o700)
        draft.rename(program)
