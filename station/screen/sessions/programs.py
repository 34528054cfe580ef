"""The station's commands in processes of their own: questions that answer in JSON, and the session."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import IO, Any

from station.screen.sessions.answers import Reply, Value

_MOST_BYTES = 64 * 1024 * 1024  # of one line of JSON
_SETTLE_S = 3.0


def command_line(arguments: Sequence[str]) -> list[str]:
    """Return the start of a command line for this station, which imports nothing from the working folder."""
    return [sys.executable, "-P", "-m", "station.cli", *arguments]


async def done(arguments: Sequence[str]) -> Reply[None]:
    """Run a command of the station to its end, whose output does not matter; see ``ask``."""
    return await ask(arguments, lambda found: None)


async def ask(
    arguments: Sequence[str],
    read: Callable[[Mapping[str, Any]], Value],
    on_line: Callable[[str], None] = lambda line: None,
) -> Reply[Value]:
    """Run a command of the station to its end; return its answer, which ``read`` makes of the JSON object on stdout.

    ``read`` may raise KeyError, TypeError or ValueError for an object that is no answer; there is none then. The object
    is empty if stdout holds none; an exit code other than 0 raises nothing. The reason, one line, is the object's own,
    else the last line on stderr, else the exit code: it is never empty, also after success. ``on_line`` gets each line
    on stderr that is not blank. Cancelling terminates the command, and kills its process group if that takes too long.
    """
    process = await asyncio.create_subprocess_exec(
        *command_line(arguments),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        limit=_MOST_BYTES,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stderr is not None
    try:
        messages, out = await asyncio.gather(_listen(process.stderr, on_line), process.stdout.read())
        code = await process.wait()
    finally:
        await _end(process)
    found = _object(out)
    value: Value | None = None
    with suppress(KeyError, TypeError, ValueError):
        value = read(found)
    reason = str(found.get("reason") or messages or f"the command ended with code {code}")
    # HDF5's further lines are for its developers.
    return Reply(code=code, value=value, reason=reason.splitlines()[0].removeprefix("station: "))


async def _listen(stream: asyncio.StreamReader, on_line: Callable[[str], None]) -> str:
    """Pass each line of a stream that is not blank, stripped, to ``on_line``; return the last one, "" if none."""
    last = ""
    async for raw in stream:
        line = raw.decode(errors="replace").strip()
        if line:
            last = line
            on_line(line)
    return last


async def _end(process: asyncio.subprocess.Process) -> None:
    """Terminate a process, and kill its group if it has not ended after a while; nothing if it has ended already."""
    if process.returncode is not None:
        return
    with suppress(ProcessLookupError):
        process.terminate()
    try:
        await asyncio.wait_for(process.wait(), _SETTLE_S)
    except TimeoutError:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def _object(out: bytes) -> dict[str, Any]:
    try:
        found = json.loads(out)
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def interrupt(pid: int) -> bool:
    """Send a process the signal that means Ctrl-C; return whether there is one."""
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGINT)
        return True
    return False


class SessionProcess:
    """A run in a process that outlives the screen: its own session, output in a file without a name."""

    def __init__(self, arguments: Sequence[str]) -> None:
        """Start the station with these arguments in a session of its own; OSError if that fails.

        The process outlives this one. What it prints on stdout and stderr is stored, for ``reason``.
        """
        self._output: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  read when the process has ended
        self._code: int | None = None
        words = command_line(arguments)
        # Not by subprocess, which holds that a process must not outlive its parent.
        self.pid = os.posix_spawn(
            words[0],
            words,
            os.environ,
            file_actions=[
                (os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0),
                (os.POSIX_SPAWN_DUP2, self._output.fileno(), 1),
                (os.POSIX_SPAWN_DUP2, self._output.fileno(), 2),
            ],
            setsid=True,
            setsigdef=(signal.SIGINT, signal.SIGTERM),  # even if this screen's parent made it ignore them
        )
        """Number of the process, and of its socket."""

    @property
    def running(self) -> bool:
        """Whether it has not ended."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code is None

    def stop(self) -> bool:
        """Stop it by the signal that means Ctrl-C, from any thread; return whether it had not ended."""
        return self._code is None and interrupt(self.pid)  # else its number may be another's by now

    def reason(self) -> str:
        """Return why a run ended before it began: the last reason in its JSON, else its last line, else its exit code.

        Without output it is "it runs" while it does.
        """
        self._output.seek(0)
        lines = [line for line in self._output.read().decode(errors="replace").splitlines() if line.strip()]
        given = [str(reason) for line in lines if (reason := _object(line.encode()).get("reason"))]
        plain = [line.removeprefix("station: ") for line in lines if not line.startswith("{")]
        ended = "it runs" if self.running else f"it ended with code {self._code}"
        return [ended, *plain[-1:], *given[-1:]][-1]

    def close(self) -> None:
        """Stop reading its output; the process continues."""
        self._output.close()
