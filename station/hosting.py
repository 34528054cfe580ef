"""The session's side of its socket: whoever connects sees the run, and may stop it, pause it, and add notes.

JSON, a line each. To a client: "hello", the events so far, then every new event and ten snapshots a second of the
wall's clock, "result" at the end. From a client: ``{"do": "stop"}``, "pause" (after the step under way), "resume",
``{"do": "note", "text": ...}``; what is not understood or cannot be done is answered "refused" with its reason.

Nothing a client does, or leaves undone, delays the session: what a slow one does not take is not kept for it, beside
the events, and the next snapshot that it gets is the newest.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol, cast

from station.attaching import VERSION
from station.bench import Bench
from station.errors import UsageError
from station.script import Script
from station.session_folder import socket_folder
from station.snapshot import Snapshot, json_object, snapshot_object

_log = logging.getLogger(__name__)

_EVERY_S = 0.1  # of the wall's clock, like all times here
_LAST_WORDS_S = 1.0
_MOST_CLIENTS = 20
_LONGEST_LINE = 4096
_LINES_AT_ONCE = 16  # then others have their turn
_BREATH_S = 0.05
_SEND_BYTES = 32768  # in the system's hands: what is there cannot be made newer any more
_EVENT_BYTES = 16384


class Watched(Protocol):
    """A run that can be looked at and told what to do; UsageError for what cannot be done now."""

    def snapshot(self) -> Snapshot:
        """Return the state now."""

    def stop(self) -> None:
        """Bring the table to rest and end."""

    def pause(self) -> None:
        """Hold after the step under way."""

    def resume(self) -> None:
        """Go on."""

    def note(self, text: str) -> None:
        """Keep a note in the record."""


class Host:
    """A socket for one run. Entered before anything is opened, so that a socket that cannot be is known by then."""

    def __init__(self, time_scale: float = 1.0) -> None:
        """``time_scale`` is how fast the loop's clock runs."""
        self.scale = time_scale
        self.events: list[bytes] = []
        """Lines of all events so far."""
        self._clients: set[_Client] = set()
        self._hello: bytes = b""
        self._run: Watched | None = None
        self._server: asyncio.Server | None = None
        self._path = self._hidden = Path()
        self._showing: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Host:
        """Make the socket, which nobody sees yet; UsageError if that cannot be."""
        if not hasattr(socket, "AF_UNIX"):
            raise UsageError("--host: this system has no Unix sockets")
        self._path = socket_folder() / f"{os.getpid()}.sock"
        self._hidden = self._path.with_name(f"{self._path.name}.new")
        try:
            self._server = await asyncio.get_running_loop().create_unix_server(
                lambda: _Client(self), str(self._hidden), start_serving=False
            )
        except OSError as error:
            raise UsageError(f"--host: cannot make the socket {self._path}: {error}") from None
        return self

    async def begin(self, run: Watched, hello: Mapping[str, Any]) -> None:
        """Let clients in; ``hello`` is what they are told first, beside version and pid."""
        assert self._server is not None
        self._run = run
        self._hello = _line("hello", {"version": VERSION, "pid": os.getpid(), **hello})
        await self._server.start_serving()
        self._hidden.rename(self._path)  # a socket that is seen is listened to: whoever finds one deaf removes it
        self._showing = asyncio.get_running_loop().create_task(self._show())

    def tell(self, t_s: float, text: str) -> None:
        """Tell an event, at ``t_s`` of the loop's clock."""
        self.events.append(_line("event", {"t_s": t_s, "text": text}))
        for client in self._clients:
            client.send_events()

    async def end(self, result: Mapping[str, Any]) -> None:
        """Tell how the run ended, and hang up; who does not take it within a second misses it."""
        self._snapshots()
        last = _line("result", json_object(result))
        for client in tuple(self._clients):
            client.end(last)
        deadline_s = self._now() + _LAST_WORDS_S * self.scale
        while self._clients and self._now() < deadline_s:
            await asyncio.sleep(0.01 * self.scale)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._showing is not None:
            self._showing.cancel()
            with suppress(asyncio.CancelledError):
                await self._showing
        if self._server is not None:
            self._server.close()
        for client in tuple(self._clients):
            client.drop()
        for path in (self._path, self._hidden):
            with suppress(OSError):
                path.unlink()

    def welcome(self, client: _Client) -> None:
        """Take in a client: hello, events, and where the run is."""
        if len(self._clients) >= _MOST_CLIENTS:
            client.turn_away(_line("refused", {"reason": f"{_MOST_CLIENTS} others look at this session already"}))
            return
        self._clients.add(client)
        client.send(self._hello)
        client.send_events()
        if self._run is not None:
            client.send(_line("snapshot", snapshot_object(self._run.snapshot())))

    def forget(self, client: _Client) -> None:
        """Let a client go."""
        self._clients.discard(client)

    def do(self, line: bytes) -> None:
        """Do what a line asks; UsageError if it is not understood or cannot be done."""
        try:
            request = json.loads(line)
            action = request["do"]
        except (ValueError, TypeError, KeyError, RecursionError):
            raise UsageError('not understood: say {"do": "stop"}, "pause", "resume" or "note" with a "text"') from None
        assert self._run is not None
        actions: dict[str, Callable[[], None]] = {
            "stop": self._run.stop,
            "pause": self._run.pause,
            "resume": self._run.resume,
        }
        if action == "note" and isinstance(text := request.get("text"), str):
            self._run.note(text)
        elif isinstance(action, str) and action in actions:
            actions[action]()
        else:
            raise UsageError(f"not understood: {str(action)[:40]!r}")

    async def _show(self) -> None:
        while True:
            await asyncio.sleep(_EVERY_S * self.scale)
            try:
                self._snapshots()
            except Exception:  # who looks on must not end the run
                _log.exception("no snapshot could be made; the run goes on")
                return

    def _snapshots(self) -> None:
        """Send what is new to whoever has taken all that came before."""
        for client in self._clients:
            client.send_events()
        ready = [client for client in self._clients if client.idle]
        if ready and self._run is not None:
            line = _line("snapshot", snapshot_object(self._run.snapshot()))
            for client in ready:
                client.send(line)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


class _Client(asyncio.Protocol):
    """One connection. Lines are acted on as they come, without a detour over tasks."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._received = b""
        self._told = 0  # events
        self._transport: asyncio.Transport

    @property
    def idle(self) -> bool:
        """Whether it has taken all that was sent."""
        return not self._transport.get_write_buffer_size() and not self._transport.is_closing()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        connection = transport.get_extra_info("socket")
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
        self._host.welcome(self)

    def data_received(self, data: bytes) -> None:
        self._received += data
        self._heed()

    def connection_lost(self, error: Exception | None) -> None:
        self._host.forget(self)

    def send(self, line: bytes) -> None:
        self._transport.write(line)

    def send_events(self) -> None:
        """Send the events that it has not been told, as many as it takes."""
        events = self._host.events
        while self._told < len(events) and self._transport.get_write_buffer_size() < _EVENT_BYTES:
            self._transport.write(events[self._told])
            self._told += 1

    def end(self, last: bytes) -> None:
        """Send what it has not been told and the last line, and hang up when that is taken."""
        self._transport.write(b"".join((*self._host.events[self._told :], last)))
        self._transport.close()

    def turn_away(self, reason: bytes) -> None:
        self._transport.write(reason)
        self._transport.close()

    def drop(self) -> None:
        self._transport.abort()

    def _heed(self) -> None:
        """Act on some of the lines that are there; on the rest, of a client that sends without end, a little later."""
        if self._transport.is_closing():
            return
        *lines, self._received = self._received.split(b"\n", _LINES_AT_ONCE)
        for line in lines:
            try:
                self._host.do(line)
            except UsageError as error:
                self._refuse(str(error))
        if b"\n" not in self._received[: _LONGEST_LINE + 1] and len(self._received) > _LONGEST_LINE:
            self._refuse(f"a line of more than {_LONGEST_LINE} bytes")
            self._transport.close()
        elif b"\n" in self._received:
            self._transport.pause_reading()
            asyncio.get_running_loop().call_later(_BREATH_S * self._host.scale, self._go_on)

    def _go_on(self) -> None:
        if not self._transport.is_closing():
            self._transport.resume_reading()
            self._heed()

    def _refuse(self, reason: str) -> None:
        if self.idle:
            self.send(_line("refused", {"reason": reason}))


def introduction(
    bench: Bench,
    bench_file: str | None,
    script: Script,
    recording: Path,
    gyros: tuple[str, ...],
) -> dict[str, Any]:
    """Return what a client is told of a bench and its run; times in s, limits in SI, null for none."""
    steps, end_s = [], 0.0
    for step, duration_s in zip(script.steps, script.durations_s(), strict=True):
        steps.append({"label": step.label, "start_s": end_s, "end_s": end_s + duration_s})
        end_s += duration_s
    found: dict[str, Any] = json_object(
        {
            "bench": bench.name,
            "bench_file": None if bench_file is None else str(Path(bench_file).resolve()),
            "script": {"name": script.name, "duration_s": end_s, "steps": steps},
            "recording": str(recording.resolve()),
            "gyros": gyros,
            "axes": bench.table.gimbals,
            "limits": bench.limits,
        }
    )
    return found


def _line(kind: str, fields: Mapping[str, Any]) -> bytes:
    return json.dumps({"kind": kind, **fields}, allow_nan=False, separators=(",", ":")).encode() + b"\n"
