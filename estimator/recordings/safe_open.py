"""Files are read through by another process before this one opens them: a damaged one can hang or kill its reader."""

import atexit
import json
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

from estimator.errors import RecordingError

PROBE_LIMIT_S = 60.0


def probe(path: Path, kind: str = "HDF5", limit_s: float = PROBE_LIMIT_S) -> None:
    """Read a whole file in another process first, to be safe from crashes.

    ``kind`` is "HDF5" or "MATLAB". RecordingError if it is no file or of another kind, if the process fails, crashes or
    takes more than ``limit_s`` on it, or if the file refers to other files or claims far more data than it has.
    """
    if not path.is_file():
        raise RecordingError(f"{path} is not a file: give the path of a recording (.h5)")
    reason = _prober.ask(path, kind, limit_s)
    if reason is not None:
        raise RecordingError(f"{path} {reason}")


class _Prober:
    """A process that reads one file after another; it is replaced if it gave no answer."""

    def __init__(self) -> None:
        self._child: subprocess.Popen[str] | None = None
        self._one_at_a_time = threading.Lock()
        atexit.register(self._end)

    def ask(self, path: Path, kind: str, limit_s: float) -> str | None:
        """Return what is wrong with a file in words, None if it can be read.

        The process is killed after ``limit_s``. One file is read at a time.
        """
        with self._one_at_a_time:
            child = self._ready()
            late = threading.Event()

            def give_up() -> None:
                late.set()
                _kill(child)

            timer = threading.Timer(limit_s, give_up)
            timer.start()
            wrong: str | None = f"cannot be read: it is damaged: the {kind} library failed on it"
            answered = False
            try:
                assert child.stdin is not None
                assert child.stdout is not None
                print(json.dumps([kind, str(path.absolute())]), file=child.stdin, flush=True)
                if answer := child.stdout.readline():
                    reason, answered = json.loads(answer), True
                    wrong = None if reason is None else f"cannot be read: {reason}"
                elif late.is_set():
                    wrong = f"is damaged: reading it did not end within {limit_s:.0f} s, so its content is unusable"
            except OSError:
                pass  # it died before the request
            finally:
                timer.cancel()
                if not answered:  # or was interrupted: its next answer would be taken for that of the next file
                    self._end()
            return wrong

    def _ready(self) -> subprocess.Popen[str]:
        """Return the running process that probes files; start one if there is none, or if it has ended."""
        if self._child is None or self._child.poll() is not None:
            self._end()
            self._child = subprocess.Popen(
                [sys.executable, "-P", str(Path(__file__).with_name("probe.py"))],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                start_new_session=True,  # Ctrl-C is for this process
            )
        return self._child

    def _end(self) -> None:
        child, self._child = self._child, None
        if child is not None:
            _kill(child)
            with suppress(OSError):
                child.communicate()


def _kill(child: subprocess.Popen[str]) -> None:
    """Kill a process that probes files, with the fork of it that reads."""
    if os.name == "posix" and child.poll() is None:  # later its number may be that of another group
        with suppress(ProcessLookupError, PermissionError):  # it has just ended
            os.killpg(child.pid, signal.SIGKILL)
    child.kill()


_prober = _Prober()
