"""Twin of a socketcand server: a bus over TCP, in raw mode.

Source: the protocol description of the socketcand project.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress

import can

_LONGEST = 256
_MOST_UNSENT = 1 << 20


class SocketcandSession:
    """The session of one client: bytes come in by ``received`` and go out by ``write``."""

    def __init__(
        self, write: Callable[[bytes], None], channel: str, on_message: Callable[[can.Message], None] | None = None
    ) -> None:
        """Greet the client, which may open the bus ``channel`` only; ``on_message`` gets its frames."""
        self._write, self._channel, self._on_message = write, channel, on_message
        self._rest = b""
        self._opened = False
        self.listens = False
        """Whether the client has asked for all frames (raw mode)."""
        self.malformed = 0
        """Elements that were no command, or not at this time."""
        write(b"< hi >")

    def received(self, data: bytes) -> None:
        """Take bytes from the client, cut anywhere."""
        *whole, rest = (self._rest + data).split(b">")
        self._rest = rest[-_LONGEST:]
        for part in whole:
            words = part[part.rfind(b"<") + 1 :].decode("ascii", "replace").split() if b"<" in part else []
            self._obey(words)

    def _obey(self, words: list[str]) -> None:
        """Carry out a command and answer it, except the sending of a frame, which is not answered.

        An unknown or untimely one, or another channel's, is counted and answered with an error.
        """
        name = words[0] if words else ""
        if name == "echo":
            self._write(b"< echo >")
        elif name == "open" and words[1:] == [self._channel]:
            self._opened = True
            self._write(b"< ok >")
        elif name == "rawmode" and self._opened:
            self.listens = True
            self._write(b"< ok >")
        elif name == "send" and self.listens and (message := _decoded(words[1:])) is not None:
            if self._on_message is not None:
                self._on_message(message)
        else:
            self.malformed += 1
            self._write(b"< error unknown command >")


class SocketcandServer:
    """Serves one bus to any number of clients.

    Frames from the bus come in by ``send``; those of clients go to ``on_message``.
    """

    def __init__(self, channel: str, on_message: Callable[[can.Message], None] | None = None) -> None:
        """``channel`` is the name that clients open, for instance can0."""
        self._channel, self._on_message = channel, on_message
        self._sessions: dict[asyncio.StreamWriter, SocketcandSession] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None
        self._unsent: list[bytes] = []

    async def start(self, host: str, port: int = 0) -> tuple[str, int]:
        """Listen; return host and port."""
        self._server = await asyncio.start_server(self._welcome, host, port)
        name = self._server.sockets[0].getsockname()
        return str(name[0]), int(name[1])

    def send(self, msg: can.Message) -> None:
        """Queue a data frame for all listening clients; frames of the same instant are sent together.

        Remote and error frames are ignored.
        """
        if msg.is_remote_frame or msg.is_error_frame:
            return
        loop = asyncio.get_running_loop()
        if not self._unsent:
            loop.call_soon(self._flush)
        identifier = f"{msg.arbitration_id:08X}" if msg.is_extended_id else f"{msg.arbitration_id:03X}"
        self._unsent.append(f"< frame {identifier} {loop.time():.6f} {bytes(msg.data).hex().upper()} >".encode())

    def hang_up(self) -> None:
        """End the connections of all clients; they may come again."""
        for writer in list(self._sessions):
            writer.close()

    async def close(self) -> None:
        """Stop listening, abort all connections and wait for their end; unsent data are lost."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        for writer in self._sessions:
            writer.transport.abort()
        await asyncio.gather(*self._tasks)
        if server is not None:
            await server.wait_closed()

    def _flush(self) -> None:
        data, self._unsent = b"".join(self._unsent), []
        for writer, session in list(self._sessions.items()):
            # A client that does not read loses frames, as on a real server; it must not fill our memory.
            if session.listens and writer.transport.get_write_buffer_size() < _MOST_UNSENT:
                writer.write(data)

    def _welcome(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # The task is ours: asyncio's own would be reported with a traceback if it were cancelled at the end.
        self._sessions[writer] = SocketcandSession(writer.write, self._channel, self._on_message)
        task = asyncio.get_running_loop().create_task(self._serve(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Pass the bytes of one client to its session until it leaves or its connection breaks; then forget it."""
        try:
            with suppress(OSError):
                while data := await reader.read(4096):
                    self._sessions[writer].received(data)
        finally:
            del self._sessions[writer]
            writer.close()


def _decoded(words: list[str]) -> can.Message | None:
    """Return the frame of ``id length byte ...`` in hex, extended if the id has 8 digits; None if it is invalid."""
    try:
        identifier, length, *data = (int(word, 16) for word in words)
        extended = len(words[0]) == 8
        if len(data) != length or length > 8 or not 0 <= identifier < 1 << (29 if extended else 11):
            return None
        return can.Message(arbitration_id=identifier, is_extended_id=extended, data=bytes(data))
    except ValueError:
        return None
