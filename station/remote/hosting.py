"""The session's side of its socket: clients see the run, and may stop it, pause it, and add notes.

JSON, a line each. To a client: "hello", the events so far, then every new event and ten snapshots a second of the
wall's clock, "result" at the end. From a client: ``{"do": "stop"}``, "pause" (after the step under way), "resume",
``{"do": "note", "text": ...}``; "course", which is answered by the estimates so far, thinned; in manual mode the words
that drive (``station.run.manual``). What is not understood or cannot be done is answered "refused" with its reason.

Nothing a client does, or leaves undone, delays the session: what a slow one does not take is not kept for it, beside
the events, and the next snapshot that it gets is the newest.
"""

import asyncio
import itertools
import json
import logging
import math
import os
import socket
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self, cast

from station.bench.bench import Bench
from station.errors import UsageError, sentence
from station.remote.attaching import VERSION, of_this_user, socket_folder
from station.run.session import Session
from station.run.snapshot import EventKind, Snapshot
from station.scripts.script import Script, Timed
from station.views.json_values import json_object

_log = logging.getLogger(__name__)

_EVERY_S = 0.1  # of the wall's clock, like all times here
_LAST_WORDS_S = 1.0
_MOST_CLIENTS = 20
_LONGEST_LINE = 4096
_LINES_AT_ONCE = 16  # then others have their turn
_BREATH_S = 0.05
_SEND_BYTES = 32768  # in the system's buffer, where data cannot be replaced by newer ones
_EVENT_BYTES = 16384
_COURSE_EVERY = 10  # snapshots: a point a second
_MOST_POINTS = 300
_DIGITS = 6


class Host:
    """A socket for one run. Enter it before opening devices: it fails early if the socket cannot be created."""

    def __init__(self, time_scale: float = 1.0) -> None:
        """Prepare without a socket or a run; ``time_scale``: seconds of the loop's clock in one of real time."""
        self.scale = time_scale
        self.events: list[bytes] = []
        """Lines of all events so far."""
        self.clients: set[_Client] = set()
        """Those that look on."""
        self._hello: bytes = b""
        self._run: Session | None = None
        self._server: asyncio.Server | None = None
        self._path = self._hidden = Path()
        self._showing: asyncio.Task[None] | None = None
        self._course: list[bytes] = []
        self._blind = False

    async def __aenter__(self) -> Self:
        """Create the socket under a hidden name, not yet serving; UsageError if that fails or the system has no Unix
        sockets.
        """
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

    async def begin(self, run: Session, hello: Mapping[str, Any]) -> None:
        """Admit clients, who may watch and control ``run`` from now on; needs the socket of ``__aenter__``.

        The socket gets its visible name, and snapshots are sent ten times a second. ``hello`` is the first message to a
        client, along with version and pid.
        """
        assert self._server is not None
        self._run = run
        self._hello = _line("hello", {"version": VERSION, "pid": os.getpid(), **hello})
        await self._server.start_serving()
        self._hidden.rename(self._path)  # a visible socket has a listener: clients remove one that does not answer
        self._showing = asyncio.get_running_loop().create_task(self._show())

    def tell(self, t_s: float, kind: EventKind, text: str) -> None:
        """Send an event, at ``t_s`` of the loop's clock, to all clients, and keep it for later ones."""
        self.events.append(_line("event", {"t_s": t_s, "event": kind, "text": text}))
        for client in self.clients:
            client.send_events()

    async def end(self, result: Mapping[str, Any]) -> None:
        """Send the last events, a snapshot and the result to all clients and hang up.

        Clients that do not take the result within a second of real time miss it. Those that have not taken all before
        get no snapshot.
        """
        self._snapshots()
        last = _line("result", json_object(result))
        for client in tuple(self.clients):
            client.end(last)
        with suppress(TimeoutError):
            async with asyncio.timeout(_LAST_WORDS_S * self.scale):
                while self.clients:
                    await asyncio.sleep(0.01 * self.scale)

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the updates, stop listening, abort all connections and remove the socket, also the hidden one."""
        if self._showing is not None:
            self._showing.cancel()
            with suppress(asyncio.CancelledError):
                await self._showing
        if self._server is not None:
            self._server.close()
        for client in tuple(self.clients):
            client.transport.abort()
        for path in (self._path, self._hidden):
            with suppress(OSError):
                path.unlink()

    def welcome(self, client: "_Client") -> None:
        """Admit a client and send it the greeting, past events and a snapshot if there is one.

        Beyond 20 clients it is refused, and its connection closed.
        """
        if len(self.clients) >= _MOST_CLIENTS:
            client.transport.write(_refused(f"{_MOST_CLIENTS} clients watch this session already"))
            client.transport.close()
            return
        self.clients.add(client)
        client.transport.write(self._hello)
        client.send_events()
        snapshot = self._look()
        if snapshot is not None:
            client.transport.write(_line("snapshot", json_object(snapshot)))

    def do(self, line: bytes, *, late: bool = False) -> bytes:
        """Carry out a client's request, a line of JSON, and return the answer, a line with its end; empty if none.

        Requests are course, the only one with an answer, note, stop, pause, resume, and to move by hand jog, go, home,
        hold and end. With ``late`` jog, go and home are refused. UsageError if it is invalid or refused. Call it only
        after ``begin``.
        """
        assert self._run is not None
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            request = None
        match request:
            case {"do": "course"}:
                return b'{"kind":"course","points":[' + b",".join(self._course) + b"]}\n"
            case {"do": "note", "text": str(text)}:
                self._run.note(text)
            case {"do": "stop" | "pause" | "resume" as action}:
                getattr(self._run, action)()
            case {"do": "jog" | "go" | "home"} if late:
                raise UsageError("the request came too late to move the table: send fewer requests at once")
            case {"do": "jog" | "go" | "home" | "hold" | "end" as action, **given}:
                self._run.drive(action, cast(Mapping[str, Any], given))
            case {"do": action}:
                raise UsageError(f"unknown request: {str(action)[:40]!r}")
            case _:
                raise UsageError(sentence("session.not_understood"))
        return b""

    async def _show(self) -> None:
        for looks in itertools.count():
            await asyncio.sleep(_EVERY_S * self.scale)
            self._snapshots(keep=looks % _COURSE_EVERY == 0)

    def _snapshots(self, *, keep: bool = False) -> None:
        """Send new events to all clients, and a snapshot to those that have taken all that was sent before.

        ``keep`` also stores it as a point of the course. No snapshot is made if nobody takes it, and none is sent while
        there is nothing to show.
        """
        for client in self.clients:
            client.send_events()
        ready = [client for client in self.clients if client.idle]
        snapshot = self._look() if ready or keep else None
        if snapshot is None:
            return
        if keep:
            self._keep(snapshot)
        if ready:
            line = _line("snapshot", json_object(snapshot))
            for client in ready:
                client.transport.write(line)

    def _look(self) -> Snapshot | None:
        """Return a snapshot of the run, None before it begins.

        None as well from the first exception on, which is logged: watching must not end a run.
        """
        if self._run is None or self._blind:
            return None
        try:
            return self._run.snapshot()
        except Exception:
            self._blind = True
            _log.exception("no snapshot could be made; the run continues")
            return None

    def _keep(self, snapshot: Snapshot) -> None:
        """Store the estimates of a snapshot, rounded to six digits, for clients that come later.

        Nothing without estimates, or before time goes on. Beyond ``_MOST_POINTS`` every other point is dropped.
        """
        sensors = {one.full_name: (_rounded(one.values), _rounded(one.sds)) for one in snapshot.sensors}
        if sensors and snapshot.elapsed_s > 0:
            point = {"t_s": snapshot.elapsed_s, "sensors": sensors}
            self._course.append(json.dumps(point, allow_nan=False, separators=(",", ":")).encode())
        if len(self._course) > _MOST_POINTS:
            del self._course[1::2]


class _Client(asyncio.Protocol):
    """One connection. Lines are handled as they arrive, without tasks."""

    def __init__(self, host: Host) -> None:
        self._host = host
        self._received = b""
        self._told = 0  # events
        self.transport: asyncio.Transport

    @property
    def idle(self) -> bool:
        """Whether it has taken all that was sent."""
        return not self.transport.get_write_buffer_size() and not self.transport.is_closing()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Welcome the client, or abort the connection of another user."""
        self.transport = cast(asyncio.Transport, transport)
        connection = transport.get_extra_info("socket")
        if not of_this_user(connection):
            self.transport.abort()
            return
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BYTES)
        self._host.welcome(self)

    def data_received(self, data: bytes) -> None:
        self._received += data
        self._heed()

    def connection_lost(self, error: Exception | None) -> None:
        """Forget the client, and handle the lines that are still unread: a STOP counts even if its sender has hung up.

        At most 16 lines and 4096 bytes more are read. Requests that move the table are not carried out; nothing is
        answered.
        """
        self._host.clients.discard(self)
        with suppress(OSError), self.transport.get_extra_info("socket").dup() as rest:
            self._received += rest.recv(_LONGEST_LINE)
        for line in self._received.split(b"\n", _LINES_AT_ONCE)[:-1]:
            with suppress(UsageError):
                self._host.do(line, late=True)

    def send_events(self) -> None:
        """Send the events that the client has not had yet, until its buffer is full."""
        events = self._host.events
        while self._told < len(events) and self.transport.get_write_buffer_size() < _EVENT_BYTES:
            self.transport.write(events[self._told])
            self._told += 1

    def end(self, last: bytes) -> None:
        """Send the remaining events and the last line, and close the connection after that."""
        self.transport.write(b"".join((*self._host.events[self._told :], last)))
        self.transport.close()

    def _heed(self, *, late: bool = False) -> None:
        """Handle up to ``_LINES_AT_ONCE`` of the lines received, and the rest a little later, as ``late`` ones.

        So no client takes all time; meanwhile it is not read. Nothing on a connection that closes; a line that is too
        long closes it. Answers are dropped while the client does not read. ``late`` as for ``Host.do``.
        """
        if self.transport.is_closing():
            return
        *lines, self._received = self._received.split(b"\n", _LINES_AT_ONCE)
        for line in lines:
            try:
                answer = self._host.do(line, late=late)
            except UsageError as error:
                answer = _refused(str(error))
            self._answer(answer)
        if b"\n" not in self._received[: _LONGEST_LINE + 1] and len(self._received) > _LONGEST_LINE:
            self._answer(_refused(f"a line of more than {_LONGEST_LINE} bytes"))
            self.transport.close()
        elif b"\n" in self._received:
            self.transport.pause_reading()
            asyncio.get_running_loop().call_later(_BREATH_S * self._host.scale, self._go_on)

    def _go_on(self) -> None:
        if not self.transport.is_closing():
            self.transport.resume_reading()
            self._heed(late=True)

    def _answer(self, answer: bytes) -> None:
        if answer and self.idle:
            self.transport.write(answer)


def introduction(
    bench: Bench, bench_file: str | None, script: Script, recording: Path, gyros: tuple[str, ...]
) -> dict[str, Any]:
    """Return the greeting's description of a bench and its run as JSON values; times in s, limits in SI, null for none.

    That is bench, script with durations and steps, recording, gyros, axes, and the limits of the bench and of the
    "table". ``bench_file`` is the path of the bench, None without one; ``gyros`` are the names of all gyros. Paths
    become absolute.
    """
    steps = [_step_object(timed) for timed in script.timeline()]
    found: dict[str, Any] = json_object(
        {
            "bench": bench.name,
            "bench_file": None if bench_file is None else str(Path(bench_file).resolve()),
            "script": {
                "name": script.name,
                "duration_s": script.least_s,
                "longest_s": script.span.most_s,
                "steps": steps,
            },
            "recording": str(recording.resolve()),
            "gyros": gyros,
            "axes": bench.table.gimbals,
            "limits": bench.limits,
            "table": bench.table.limits,
        }
    )
    return found


def _step_object(timed: Timed) -> dict[str, Any]:
    """Return the greeting's description of a step: label, earliest times in s, axis and end in rad of its last turn.

    Without a turn these are null and 0.
    """
    turn = timed.last_turn
    return {
        "label": timed.step.label,
        "start_s": timed.start_s,
        "end_s": timed.start_s + timed.span.least_s,
        "axis": None if turn is None else turn.axis,
        "to_rad": 0.0 if turn is None else turn.to_rad,
    }


def _rounded(values: tuple[float, ...]) -> list[float | None]:
    return [float(f"{value:.{_DIGITS}g}") if math.isfinite(value) else None for value in values]


def _line(kind: str, fields: Mapping[str, Any]) -> bytes:
    return json.dumps({"kind": kind, **fields}, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def _refused(reason: str) -> bytes:
    return _line("refused", {"reason": reason})
