"""Links of bytes: serial ports and pyserial's URLs, TCP streams, wires in memory; and opening them again."""

from __future__ import annotations

import asyncio
import os
import socket
import struct
import sys
import threading
import time
import tty
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import ExitStack, asynccontextmanager, closing, contextmanager, suppress
from itertools import pairwise

import pytest
from wire_pair import pair

from drivers.errors import DeviceFault, LinkLost
from drivers.links.reopen import BackOff, reopen
from drivers.links.serial_link import SerialLink
from drivers.links.tcp_link import TcpLink
from drivers.protocols import ByteLink
from station.run.event_loop.loops import VirtualLoop


def really(main: Callable[[], Awaitable[None]]) -> None:
    """Run in real time, for ten seconds at the most, and leave no thread of a link behind."""

    async def limited() -> None:
        async with asyncio.timeout(10):
            await main()

    asyncio.run(limited())
    deadline = time.monotonic() + 3.0
    while [t for t in threading.enumerate() if t.name.startswith(("serial ", "pySerial"))]:
        assert time.monotonic() < deadline, threading.enumerate()
        time.sleep(0.01)


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(main())  # type: ignore[arg-type]


@contextmanager
def terminal() -> Iterator[tuple[int, str]]:
    """Give the far end of a raw pseudo-terminal, and the name of the near end."""
    with ExitStack() as stack:
        far, near = os.openpty()
        tty.setraw(far)
        tty.setraw(near)
        stack.callback(os.close, near)
        yield far, os.ttyname(near)
        with suppress(OSError):  # a test may have closed it
            os.close(far)


@asynccontextmanager
async def converter(
    answer: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
) -> AsyncIterator[int]:
    """Serve a port on this machine; give its number."""
    serving: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        serving.add(asyncio.current_task())  # type: ignore[arg-type]
        with suppress(OSError):
            await answer(reader, writer)
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        if serving:
            await asyncio.wait(serving)


async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    while data := await reader.read(4096):
        writer.write(data)


async def received(link: ByteLink, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += (await link.receive()).data
    return data


def test_a_serial_port_gives_and_takes_bytes_as_they_are() -> None:
    every = bytes(range(256)) * 20

    async def main() -> None:
        with terminal() as (far, name):
            link = SerialLink("imu", name, 115200, parity="E", stop_bits=2)
            await link.open()
            os.write(far, every[:1000])
            assert await received(link, 1000) == every[:1000]
            link.write(every[:256])
            assert os.read(far, 4096) == every[:256]
            link.close()
            link.close()

    really(main)


def test_bytes_are_stamped_when_they_arrive() -> None:
    async def main() -> None:
        with terminal() as (far, name):
            link = SerialLink("imu", name, 115200)
            await link.open()
            before = asyncio.get_running_loop().time()
            os.write(far, b"x")
            chunk = await link.receive()
            assert before <= chunk.t_ns * 1e-9 <= asyncio.get_running_loop().time()
            link.close()

    really(main)


def test_a_host_that_stalls_after_all_bytes_are_written_has_no_stuck_cable() -> None:
    async def main() -> None:
        with terminal() as (far, name):
            link = SerialLink("table", name, 115200)
            await link.open()

            def stall(_frame: object, event: str, what: object) -> None:
                if event == "c_return" and getattr(what, "__name__", "") == "write":
                    sys.setprofile(None)
                    time.sleep(0.3)

            sys.setprofile(stall)
            try:
                link.write(b"TPA\r")
            finally:
                sys.setprofile(None)
            assert os.read(far, 100) == b"TPA\r"
            link.close()

    really(main)


def test_a_line_that_takes_nothing_is_said_to_be_stuck() -> None:
    async def main() -> None:
        with terminal() as (_, name):
            link = SerialLink("table", name, 115200)
            await link.open()

            def fill() -> None:
                for _ in range(100):
                    link.write(bytes(4096))

            with pytest.raises(LinkLost, match="accepts no more bytes"):
                fill()
            link.close()

    really(main)


def test_a_port_that_another_program_has_is_not_shared() -> None:
    async def main() -> None:
        with terminal() as (_, name):
            first, second = SerialLink("a", name, 115200), SerialLink("b", name, 115200)
            await first.open()
            with pytest.raises(LinkLost, match="b: cannot open serial port .*another program uses it"):
                await second.open()
            first.close()
            await second.open()
            second.close()

    really(main)


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/ttyNONE", "is it plugged in"),
        ("socket://127.0.0.1:1", "Is the converter switched on"),
        ("bluetooth://x", "write a device such as /dev/ttyUSB0"),
    ],
)
def test_a_port_that_cannot_be_opened_says_what_to_do(url: str, words: str) -> None:
    async def main() -> None:
        link = SerialLink("imu", url, 115200)
        with pytest.raises(LinkLost, match=words):
            await link.open()
        with pytest.raises(LinkLost):
            link.write(b"x")
        link.close()

    really(main)


def test_a_port_that_is_unplugged_is_a_lost_link_after_its_last_bytes() -> None:
    async def main() -> None:
        with terminal() as (far, name):
            link = SerialLink("imu", name, 115200)
            await link.open()
            os.write(far, b"last")
            await asyncio.sleep(0.05)
            os.close(far)
            assert await received(link, 4) == b"last"
            with pytest.raises(LinkLost, match="imu: serial port .* is gone: unplugged or without power"):
                await link.receive()
            with pytest.raises(LinkLost):
                link.write(b"x")
            link.close()

    really(main)


@pytest.mark.parametrize("scheme", ["socket", "tcp"])
def test_a_converter_that_resets_the_connection_is_a_lost_link(scheme: str) -> None:
    async def reset(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read(1)  # what comes before, pyserial throws away as it opens
        writer.write(b"last")
        await asyncio.sleep(0.1)
        sock = writer.get_extra_info("socket")
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        writer.transport.abort()

    async def main() -> None:
        async with converter(reset) as port:
            link: ByteLink
            if scheme == "tcp":
                link = TcpLink("imu", "127.0.0.1", port, 1.0)
            else:
                link = SerialLink("imu", f"socket://127.0.0.1:{port}", 115200)
            await link.open()
            link.write(b"?")
            assert await received(link, 4) == b"last"
            with pytest.raises(LinkLost, match=f"127.0.0.1:{port}.* the connection"):
                await link.receive()
            with pytest.raises(LinkLost):
                link.write(b"x")
            link.close()
            link.close()

    really(main)


def test_a_socket_is_read_in_large_pieces_not_byte_by_byte() -> None:
    async def main() -> None:
        async with converter(echo) as port:
            link = SerialLink("imu", f"socket://127.0.0.1:{port}", 115200)
            await link.open()
            for _ in range(50):
                link.write(bytes(1000))
            chunks = [await link.receive()]
            while sum(len(c.data) for c in chunks) < 50_000:
                chunks.append(await link.receive())
            assert len(chunks) <= 100
            link.close()

    really(main)


def test_a_gathered_stream_comes_in_few_pieces_and_an_answer_at_once() -> None:
    async def main() -> None:
        with terminal() as (far, name):
            link = SerialLink("imu", name, 921600, gather_s=0.02)
            await link.open()
            chunks = []
            for _ in range(100):
                os.write(far, bytes(38))
                await asyncio.sleep(0.001)
            while sum(map(len, chunks)) < 3800:
                chunks.append((await link.receive()).data)
            assert len(chunks) < 20
            await asyncio.sleep(0.05)
            began = time.monotonic()
            os.write(far, b"answer")
            await link.receive()
            assert time.monotonic() - began < 0.015
            link.close()

    really(main)


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")  # pyserial's own thread
def test_rfc2217_tells_a_converter_the_settings_of_the_line() -> None:
    import serial
    from serial.rfc2217 import PortManager

    class Line(serial.Serial):
        """What the converter's port is set to."""

        def __init__(self) -> None:
            super().__init__(None)

        @property
        def cts(self) -> bool:
            return True

        dsr = cd = ri = cts

        def reset_input_buffer(self) -> None:
            """Nothing is there."""

        reset_output_buffer = reset_input_buffer

    class Wire:
        def __init__(self, sock: socket.socket) -> None:
            self.write = sock.sendall

    line = Line()

    def serve(listening: socket.socket) -> None:
        with closing(listening.accept()[0]) as sock:
            manager = PortManager(line, Wire(sock))
            with suppress(OSError):
                while data := sock.recv(1024):
                    answer = b"".join(manager.filter(data))
                    if answer:
                        sock.sendall(b"".join(manager.escape(answer)))

    async def main() -> None:
        with closing(socket.create_server(("127.0.0.1", 0))) as listening:
            server = threading.Thread(target=serve, args=(listening,), daemon=True)
            server.start()
            link = SerialLink(
                "imu", f"rfc2217://127.0.0.1:{listening.getsockname()[1]}", 57600, parity="O", stop_bits=2
            )
            await link.open()
            assert (line.baudrate, line.parity, line.stopbits) == (57600, "O", 2)
            link.write(b"\xffhello")
            assert await received(link, 6) == b"\xffhello"
            link.close()
            server.join(2)

    really(main)


def test_tcp_goes_without_delay_and_asks_a_silent_peer() -> None:
    async def main() -> None:
        async with converter(echo) as port:
            link = TcpLink("table", "127.0.0.1", port, 1.0)
            await link.open()
            assert link._writer is not None
            sock = link._writer.get_extra_info("socket")
            assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
            link.write(b"?")
            assert await received(link, 1) == b"?"
            link.close()
            with pytest.raises(LinkLost, match="closed"):
                link.write(b"?")

    really(main)


def test_nobody_listening_says_so() -> None:
    async def main() -> None:
        with pytest.raises(
            LinkLost, match=r"no connection to 127.0.0.1:1 .*Is it switched on\? Is " r"the address correct"
        ):
            await TcpLink("table", "127.0.0.1", 1, 1.0).open()

    really(main)


def test_what_nobody_takes_is_bounded() -> None:
    async def main() -> None:
        near, far = pair("imu")
        for _ in range(100):
            far.write(bytes(100_000))
        assert 4_100_000 <= len(await received(near, 4_100_000)) <= 1 << 22

    virtually(main)


def test_the_two_ends_of_a_wire_in_memory_part_together() -> None:
    async def main() -> None:
        near, far = pair("imu")
        near.write(b"a")
        assert (await far.receive()).data == b"a"
        near.close()
        near.close()
        far.write(b"b")
        with pytest.raises(LinkLost, match="unplugged"):
            await far.receive()
        with pytest.raises(LinkLost):
            await near.receive()

    virtually(main)


class Comes:
    """What can be opened from a certain time on."""

    def __init__(self, at_s: float, error: Exception) -> None:
        self.at_s, self.error = at_s, error
        self.tried_at: list[float] = []

    async def open(self) -> None:
        now = asyncio.get_running_loop().time()
        self.tried_at.append(round(now, 6))
        if now < self.at_s:
            raise self.error

    def close(self) -> None:
        """Nothing is open."""


def test_a_lost_link_is_opened_again_with_more_and_more_patience() -> None:
    async def main() -> None:
        lost = Comes(20.0, LinkLost("imu", "gone"))
        assert await reopen(lost) == 9
        assert lost.tried_at[:5] == [0.1, 0.3, 0.7, 1.5, 3.1]
        assert max(after - before for before, after in pairwise(lost.tried_at)) == pytest.approx(5.0)

    virtually(main)


def test_a_link_that_stays_away_is_given_up_with_its_own_reason() -> None:
    async def main() -> None:
        lost = Comes(1e9, LinkLost("imu", "serial port X is gone"))
        with pytest.raises(LinkLost, match=r"imu: serial port X is gone \(tried \d+ times within 12 s\)"):
            await reopen(lost, BackOff(limit_s=12.0))
        assert asyncio.get_running_loop().time() <= 12.0

    virtually(main)


def test_a_device_that_is_back_with_a_fault_is_not_asked_again() -> None:
    async def main() -> None:
        lost = Comes(1e9, DeviceFault("table", "axis x is in fault"))
        with pytest.raises(DeviceFault):
            await reopen(lost)
        assert len(lost.tried_at) == 1

    virtually(main)
