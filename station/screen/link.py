"""The screen's connection to a session: found, followed, found again after a break, told to stop at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from station.attaching import RemoteSession, running_sessions
from station.errors import UsageError
from station.screen.live_run import LiveRun, Stage
from station.screen.programs import SessionProcess

_LOOK_S = 0.1
_AGAIN_S = 1.0


class SessionLink:
    """Follows one session: one that this screen started, or one that runs already."""

    def __init__(self, run: LiveRun, *, process: SessionProcess | None = None, socket: Path | None = None) -> None:
        """Give the process that was started, or the socket of a session."""
        self.run = run
        self._process, self._socket = process, socket
        self._remote: RemoteSession | None = None

    async def follow(self, changed: Callable[[], None]) -> None:
        """Take in what the session says until it has ended; ``changed`` is called when its stage changes."""
        try:
            while self.run.stage is not Stage.ENDED:
                socket = await self._find()
                if socket is None:
                    self.run.end(self._why_gone())
                else:
                    await self._listen(socket, changed)
                changed()
        finally:
            self.close()

    def stop(self) -> bool:
        """Stop the run, at once; return whether there was a way to tell it."""
        if self._remote is not None:
            self._remote.stop()
        elif self._process is not None and self._process.running:
            self._process.stop()
        else:
            return False
        self.run.stop_sent = True
        return True

    def pause(self) -> None:
        """Hold after the step under way, or go on."""
        if self._remote is not None:
            holds = self.run.snapshot is not None and self.run.snapshot.paused
            self._remote.resume() if holds else self._remote.pause()

    def note(self, text: str) -> None:
        """Have a note kept in the recording."""
        if self._remote is not None:
            self._remote.note(text)

    def close(self) -> None:
        """Hang up; the session goes on."""
        self._hang_up()
        if self._process is not None:
            self._process.close()

    def _hang_up(self) -> None:
        if self._remote is not None:
            self._remote.close()
            self._remote = None

    async def _find(self) -> Path | None:
        """Return the session's socket, None if the session is gone."""
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
        with suppress(UsageError):
            self._remote = await RemoteSession.connect(socket)
            self.run.greet(self._remote.hello)
            changed()
            async for message in self._remote.messages():
                self.run.take(message)
        self._hang_up()
        if self.run.stage is not Stage.ENDED:
            self.run.lose("the connection to the session broke")
            changed()
            await asyncio.sleep(_AGAIN_S)

    def _why_gone(self) -> str:
        if self._process is not None and not self.run.hello:
            return self._process.reason()
        return "the session is gone without a word: it was killed, and the table's own watchdog has to stop the table"


async def sessions_on(bench: str, bench_file: str) -> list[object]:
    """Return the numbers of the processes that run sessions on a bench, known by its name or its file."""
    file = str(Path(bench_file).resolve()) if bench_file else None
    return [
        hello["pid"]
        for _, hello in await sessions_there()
        if hello["bench"] == bench or (file is not None and hello["bench_file"] == file)
    ]


async def sessions_there() -> list[tuple[Path, dict[str, object]]]:
    """Return the running sessions and what each says of itself, the newest first."""
    found = []
    for path in await asyncio.to_thread(running_sessions):
        with suppress(UsageError):
            remote = await RemoteSession.connect(path)
            remote.close()
            found.append((path, remote.hello))
    return found
