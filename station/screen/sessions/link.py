"""The screen's connection to a session: found, followed, found again after a break, and its STOP."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from station.errors import UsageError
from station.remote.attaching import RemoteSession, running_sessions
from station.screen.sessions.greeting import Greeting
from station.screen.sessions.live_run import LiveRun, Stage
from station.screen.sessions.programs import SessionProcess, interrupt

_LOOK_S = 0.1
_AGAIN_S = 1.0


class SessionLink:
    """Follows one session, started by this screen or running already."""

    def __init__(self, run: LiveRun, *, process: SessionProcess | None = None, socket: Path | None = None) -> None:
        """Take the process that was started, or the socket of a session."""
        self.run = run
        self._process, self._socket = process, socket
        self._remote: RemoteSession | None = None

    @property
    def socket(self) -> Path | None:
        """The session's socket, None as long as a process that was started has none."""
        return self._socket

    async def follow(self, changed: Callable[[], None]) -> None:
        """Receive the session's messages until it has ended, reconnecting if necessary; then close the connection.

        ``changed`` is called at each new stage of ``run``. If the session is gone without a result, it ends with a
        reason.
        """
        try:
            while self.run.stage is not Stage.ENDED:
                socket = await self._find()
                if socket is None:
                    self.run.leave(Stage.ENDED, self._why_gone())
                else:
                    await self._listen(socket, changed)
                changed()
        finally:
            self.close()

    def stop(self) -> bool:
        """Stop the run at once; may be called from any thread. Return whether the request could be sent.

        Without a connection that takes it the process is interrupted. The request is repeated on every new connection,
        so that a lost one takes effect.
        """
        self.run.ask_to_stop()
        remote = self._remote
        return (remote is not None and remote.stop()) or self._interrupt()

    def pause(self) -> None:
        """Pause after the current step, or resume."""
        if self._remote is not None:
            holds = self.run.snapshot is not None and self.run.snapshot.paused
            self._remote.resume() if holds else self._remote.pause()

    def drive(self, action: str, **given: str | float) -> None:
        """Send a command of manual mode; it is not repeated if the link breaks."""
        if self._remote is not None:
            self._remote.drive(action, **given)

    def note(self, text: str) -> bool:
        """Store a note in the recording; return whether it could be sent."""
        if self._remote is None:
            return False
        self._remote.note(text)
        return True

    def close(self) -> None:
        """Close the connection; the session continues."""
        self._hang_up()
        if self._process is not None:
            self._process.close()

    def _interrupt(self) -> bool:
        """Send the signal that means Ctrl-C: the way without a connection."""
        if self._process is not None:
            return self._process.stop()
        return self._socket is not None and _interrupt(self._socket)

    def _hang_up(self) -> None:
        if self._remote is not None:
            self._remote.close()
            self._remote = None

    async def _find(self) -> Path | None:
        """Return the session's socket, waiting for that of a new process as long as that runs.

        None if the session is gone, or its process ended before it had a socket.
        """
        while True:
            sockets = await asyncio.to_thread(running_sessions)
            if self._socket is not None:
                return self._socket if self._socket in sockets else None
            assert self._process is not None
            self._socket = next((path for path in sockets if path.stem == str(self._process.pid)), None)
            if self._socket is None and not self._process.running:
                return None
            if self._socket is None:
                await asyncio.sleep(_LOOK_S)

    async def _listen(self, socket: Path, changed: Callable[[], None]) -> None:
        """Connect to the session, and receive its messages until the connection ends or cannot be made.

        A STOP that was asked for is sent again, or the process is interrupted if the session does not answer. Unless
        the run has ended, its stage becomes LOST, with the reason, and the next attempt has to wait a second. A
        greeting that is none raises KeyError, TypeError or ValueError.
        """
        why = "the connection to the session broke"
        try:
            remote = self._remote = await RemoteSession.connect(socket)
        except UsageError as error:
            why = str(error)
            if self.run.stop_asked:
                self._interrupt()
        else:
            if self.run.stop_asked:
                remote.stop()
            self.run.greet(remote.hello)
            changed()
            await self._take(remote)
        self._hang_up()
        if self.run.stage is not Stage.ENDED:
            self.run.leave(Stage.LOST, why)
            changed()
            await asyncio.sleep(_AGAIN_S)

    async def _take(self, remote: RemoteSession) -> None:
        """Pass on the session's messages; after the first snapshot ask for the earlier course of its estimates.

        Not asked again on a later connection, when there are trends already.
        """
        asked = bool(self.run.trends)
        async for message in remote.messages():
            self.run.take(message)
            if not asked and message.get("kind") == "snapshot":
                asked = True
                remote.ask_course()

    def _why_gone(self) -> str:
        if self._process is not None and self.run.hello is None:
            return "stopped while it was starting" if self.run.stop_asked else self._process.reason()
        last = f" ({self._process.reason()})" if self._process is not None else ""
        return f"the session ended without a result{last}. If it was killed, check the table: it may still turn"


async def sessions_on(bench: str, bench_file: str) -> list[str]:
    """Return the process numbers, as texts, of the sessions on a bench, known by its name or file.

    ``bench_file`` is empty for the built-in bench. A session that does not say its bench is included, as it may hold
    the same devices.
    """
    file = await asyncio.to_thread(lambda: str(Path(bench_file).resolve())) if bench_file else None
    return [
        path.stem
        for path, hello in await sessions_there()
        if hello is None or hello.bench == bench or (file is not None and hello.bench_file == file)
    ]


async def sessions_beside(link: SessionLink | None) -> list[Path]:
    """Return the sockets of the running sessions, newest first, without that of ``link``."""
    sockets = await asyncio.to_thread(running_sessions)
    return [path for path in sockets if link is None or path != link.socket]


async def sessions_there() -> list[tuple[Path, Greeting | None]]:
    """Return the running sessions, newest first, with the greeting of each, None if it does not answer."""
    paths = await asyncio.to_thread(running_sessions)
    return list(zip(paths, await asyncio.gather(*map(_hello, paths)), strict=True))


async def session_lines() -> list[tuple[Path, str]]:
    """Return the running sessions, newest first, with a line on each: bench, process and recording."""
    return [(path, _words(path, hello)) for path, hello in await sessions_there()]


def _words(path: Path, hello: Greeting | None) -> str:
    if hello is None:
        return f"process {path.stem}, which does not identify itself"
    return f"{hello.bench}, process {path.stem}, {hello.recording}"


async def _hello(path: Path) -> Greeting | None:
    """Return the greeting of a session by its socket; None if it does not answer within five seconds, or otherwise."""
    try:
        remote = await RemoteSession.connect(path)
    except UsageError:
        return None
    remote.close()
    with suppress(KeyError, TypeError, ValueError):
        return Greeting.read(remote.hello)
    return None


async def stop_session(path: Path) -> None:
    """Stop a session by its socket ``path``, or interrupt its process if it does not answer.

    Whether either took effect is not seen.
    """
    try:
        remote = await RemoteSession.connect(path)
    except UsageError:
        _interrupt(path)
    else:
        remote.stop()
        remote.close()


def _interrupt(socket: Path) -> bool:
    """Interrupt the process of a session's socket; return whether there is one."""
    return socket.stem.isdigit() and interrupt(int(socket.stem))
