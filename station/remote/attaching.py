"""The client side of a session's socket: where it is, which sessions run, messages and commands.

Plain asyncio. What a session says is JSON, a line each (``station.remote.hosting`` has the other end).
"""

import asyncio
import json
import os
import socket
import stat
import struct
import tempfile
from collections import deque
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from station.errors import UsageError, sentence

VERSION = 2
"""Of the language on the socket."""
_CONNECT_S = 5.0
_STOP = b'{"do":"stop"}\n'
_PROBE_S = 0.5
_LONGEST_PATH = 107  # bytes that a Unix socket's address can hold
_LONGEST_NAME = len("4194304.sock.new")


def socket_folder() -> Path:
    """Return this user's folder for sockets, created if missing, in ``XDG_RUNTIME_DIR`` or that for temporary files.

    The first suitable place is taken; UsageError, with the reasons against each, if there is none.
    """
    refused = []
    for folder in _places():
        try:
            with suppress(FileExistsError):
                folder.mkdir(mode=0o700)
            reason = _objection(folder)
        except OSError as error:
            reason = f"{folder}: {error.strerror}"
        if not reason:
            return folder
        refused.append(reason)
    why = "; ".join(refused) or "there is no folder for temporary files"
    raise UsageError(sentence("session.no_socket", why=why))


def _places() -> list[Path]:
    tops = [os.environ.get("XDG_RUNTIME_DIR", "")]
    with suppress(FileNotFoundError):
        tops.append(tempfile.gettempdir())
    return [Path(top) / f"station-{os.getuid()}" for top in dict.fromkeys(tops) if top]


def _objection(folder: Path) -> str:
    """Return why a folder must not be used for sockets, "" if it may.

    In one of another user, or accessible to others, a stranger could pose as a session. Nor may it be a link, without
    the right to write, or too long for the address of a socket. OSError if it is missing.
    """
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode):
        return f"{folder} is no folder"
    if found.st_uid != os.getuid():
        return f"{folder} belongs to somebody else"
    if found.st_mode & 0o077:
        return f"{folder} is accessible to others (chmod 700 {folder})"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"{folder} cannot be written to"
    if len(os.fsencode(folder)) + 1 + _LONGEST_NAME > _LONGEST_PATH:
        return f"{folder} is too long for the name of a socket"
    return ""


def of_this_user(connection: socket.socket) -> bool:
    """Return whether this user or root is at the other end of a Unix socket; True where the system does not tell."""
    if not hasattr(socket, "SO_PEERCRED"):
        return True
    _, user, _ = struct.unpack(
        "3i", connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    )
    return user in (0, os.getuid())


def running_sessions() -> list[Path]:
    """Return the sockets of this user's running sessions, newest first; sockets of ended ones are removed.

    One that does not answer in time counts as running. Folders that are not this user's alone are skipped.
    """
    found = []
    for folder in _places():
        if not os.path.isdir(folder) or _objection(folder):
            continue
        for path in folder.glob("*.sock"):
            with suppress(FileNotFoundError):
                if _answers(path):
                    found.append((path.stat().st_mtime, path))
                else:
                    path.unlink()
    return [path for _, path in sorted(found, reverse=True)]


def _answers(path: Path) -> bool:
    """Return whether a process listens at a socket; one that does not answer in time counts.

    FileNotFoundError if there is no socket, another OSError if it may not be used.
    """
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(_PROBE_S)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return False
        except (TimeoutError, BlockingIOError):
            return True
    return True


class RemoteSession:
    """A session in another process. Requests take effect there; refusals come as messages."""

    def __init__(self, transport: asyncio.Transport, inbox: "_Inbox", hello: Mapping[str, Any]) -> None:
        """``connect`` makes one."""
        self._transport, self._inbox = transport, inbox
        self.hello = dict(hello)
        """What the session says of itself: version, pid, bench, script, recording, gyros, axes, limits, ..."""

    @classmethod
    async def connect(cls, path: Path) -> Self:
        """Connect to a session's socket and read its greeting.

        UsageError if nothing answers within five seconds, or the session is another user's or of another version.
        """
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_CONNECT_S):
                transport, inbox = await loop.create_unix_connection(_Inbox, str(path))
                try:
                    if not of_this_user(transport.get_extra_info("socket")):
                        raise OSError("it belongs to another user")
                    hello = await inbox.next()
                except BaseException:
                    transport.abort()
                    raise
        except (OSError, TimeoutError) as error:
            raise UsageError(f"no session answers at {path}: it has ended ({error or 'it does not answer'})") from None
        if hello is None or hello.get("kind") != "hello" or hello.get("version") != VERSION:
            transport.abort()
            why = (hello or {}).get("reason") or "open it with the version that started it"
            raise UsageError(sentence("session.other_version", path=path, why=why))
        return cls(transport, inbox, hello)

    async def messages(self) -> AsyncIterator[dict[str, Any]]:
        """Yield the session's messages, by "kind": "event", "snapshot", "course", "refused", "result".

        Of unread snapshots in a row only the newest is kept. It ends when the session is gone; one that ends without
        "result" was killed.
        """
        while (message := await self._inbox.next()) is not None:
            yield message

    def stop(self) -> bool:
        """Bring the table to rest and end the run; return whether the request was sent, False if the session is gone.

        May be called from any thread: it bypasses the event loop, which may be busy.
        """
        try:
            with self._transport.get_extra_info("socket").dup() as line:
                return bool(line.send(_STOP) == len(_STOP))
        except OSError:  # the session is gone, or reads no more
            return False

    def pause(self) -> None:
        """Ask the session to pause after the current step."""
        self._say({"do": "pause"})

    def resume(self) -> None:
        self._say({"do": "resume"})

    def note(self, text: str) -> None:
        """Ask the session to store a note in the recording."""
        self._say({"do": "note", "text": text})

    def drive(self, action: str, **given: str | float) -> None:
        """Send a command of manual mode: "jog", "go", "home", "hold" or "end", with axis and numbers in SI."""
        self._say({"do": action, **given})

    def ask_course(self) -> None:
        """Ask for a message of kind "course", with the history of the estimates."""
        self._say({"do": "course"})

    def close(self) -> None:
        """Close the connection; the session continues."""
        self._transport.close()

    def _say(self, request: Mapping[str, str | float]) -> None:
        self._transport.write(json.dumps(request).encode() + b"\n")


class _Inbox(asyncio.Protocol):
    """Received messages in order; an outdated snapshot is dropped when a newer one comes."""

    def __init__(self) -> None:
        self._messages: deque[dict[str, Any]] = deque()
        self._part = b""
        self._new = asyncio.Event()
        self._ended = False

    async def next(self) -> dict[str, Any] | None:
        """Return the next message, waiting for it; None once the connection has ended and none is left."""
        while not self._messages:
            if self._ended:
                return None
            self._new.clear()
            await self._new.wait()
        return self._messages.popleft()

    def data_received(self, data: bytes) -> None:
        *lines, self._part = (self._part + data).split(b"\n")
        for line in lines:
            with suppress(ValueError, RecursionError):  # texts that are not JSON are not from a session
                self._take(json.loads(line))
        self._new.set()

    def connection_lost(self, error: Exception | None) -> None:
        self._ended = True
        self._new.set()

    def _take(self, message: Any) -> None:
        if not isinstance(message, dict):
            return
        kind = message.get("kind")
        if kind == "snapshot" and self._messages and self._messages[-1].get("kind") == kind:
            self._messages.pop()
        self._messages.append(message)
