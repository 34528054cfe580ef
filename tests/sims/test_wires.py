"""Wires at whose far end a twin sits: in memory, on a pseudo-terminal, on a TCP port."""

from __future__ import annotations

import asyncio
import fcntl
import os
import struct
import termios
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest

from drivers.errors import LinkLost
from drivers.links.memory_link import MemoryLink
from drivers.links.reopen import reopen
from drivers.links.serial_link import SerialLink
from drivers.links.tcp_link import TcpLink
from drivers.protocols import ByteLink
from sims.physics.table import AxisData, TableModel
from sims.tables.galil_controller import GalilController
from sims.tables.registry import TableTwinSetup
from sims.wires.wires import ByteDevice, Plug, Write, in_memory, on_pty, on_tcp


class Parrot:
    """Says what it hears, and counts."""

    def __init__(self, write: Write) -> None:
        self.write = write
        self.heard = b""

    def received(self, data: bytes) -> None:
        self.heard += data
        self.write(data)


def really(main: Callable[[], Awaitable[None]]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(20):
            await main()

    asyncio.run(limited())


@asynccontextmanager
async def wired(
    kind: str, make: Callable[[Write], ByteDevice], plug: Plug | None = None
) -> AsyncIterator[Callable[[], ByteLink]]:
    """Put a device on a wire; give what makes links to it."""
    if kind == "memory":
        with in_memory("imu", make, plug) as link:
            yield lambda: link
    elif kind == "pty":
        async with on_pty(make, plug) as name:
            yield lambda: SerialLink("imu", name, 921600)
    else:
        async with on_tcp(make, "127.0.0.1", 0, plug) as (host, port):
            yield lambda: TcpLink("imu", host, port, 1.0)


async def received(link: ByteLink, count: int) -> bytes:
    data = b""
    while len(data) < count:
        data += (await link.receive()).data
    return data


@pytest.mark.parametrize("kind", ["memory", "pty", "tcp"])
def test_bytes_go_both_ways_as_they_are(kind: str) -> None:
    every = bytes(range(256)) * 4

    async def main() -> None:
        async with wired(kind, Parrot) as link_to:
            link = link_to()
            await link.open()
            link.write(every)
            assert await received(link, len(every)) == every
            link.close()

    really(main)


@pytest.mark.parametrize("kind", ["memory", "pty", "tcp"])
def test_a_station_may_leave_and_come_back(kind: str) -> None:
    async def main() -> None:
        async with wired(kind, Parrot) as link_to:
            for _ in range(3):
                link = link_to()
                await link.open()
                link.write(b"?")
                assert await received(link, 1) == b"?"
                link.close()

    really(main)


@pytest.mark.parametrize("kind", ["memory", "pty", "tcp"])
def test_what_is_unplugged_is_lost_and_can_be_opened_again_when_it_is_back(kind: str) -> None:
    async def main() -> None:
        plug = Plug()
        async with wired(kind, Parrot, plug) as link_to:
            link = link_to()
            await link.open()
            link.write(b"?")
            await received(link, 1)
            plug.pull()
            plug.pull()
            with pytest.raises(LinkLost):
                await received(link, 1)
            asyncio.get_running_loop().call_later(0.5, plug.push)
            assert await reopen(link) >= 2
            link.write(b"!")
            assert await received(link, 1) == b"!"
            link.close()

    really(main)


@pytest.mark.parametrize("kind", ["pty", "tcp"])
def test_what_nobody_reads_is_dropped_and_a_device_never_waits(kind: str) -> None:
    async def main() -> None:
        parrots: list[Parrot] = []

        def make(write: Write) -> Parrot:
            parrots.append(Parrot(write))
            return parrots[0]

        async with wired(kind, make) as link_to:
            for _ in range(2000):
                parrots[0].write(bytes(1000))
            await asyncio.sleep(0.05)
            link = link_to()
            await link.open()
            await asyncio.sleep(0.1)
            data = b""
            async with asyncio.timeout(5):
                while not data.count(b"."):
                    parrots[0].write(b".")
                    data += (await link.receive()).data
            assert len(data) < 400_000
            link.close()

    really(main)


def unread(port: int) -> int:
    return int(struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))[0])


def what_is_there(port: int) -> bytes:
    """Return all that a port holds."""
    data = b""
    try:
        while more := os.read(port, 100_000):
            data += more
    except BlockingIOError:
        pass
    return data


async def on_a_port(act: Callable[[Parrot, Callable[[], int]], Awaitable[None]]) -> None:
    """Hand over a device and what opens its port, as the operating system does it: without a flush."""
    parrots: list[Parrot] = []

    def make(write: Write) -> Parrot:
        parrots.append(Parrot(write))
        return parrots[0]

    async with on_pty(make) as name:
        await act(parrots[0], lambda: os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))


def test_a_port_that_is_opened_hands_out_nothing_from_before() -> None:
    async def act(device: Parrot, open_port: Callable[[], int]) -> None:
        for _ in range(100):
            device.write(bytes(680))  # five seconds of a gyro
            await asyncio.sleep(0)
        for new in (b"first", b"second"):
            port = open_port()
            assert what_is_there(port) == b""
            device.write(new)
            await asyncio.sleep(0.02)
            assert what_is_there(port) == new
            device.write(bytes(2000))  # is left unread
            await asyncio.sleep(0.02)
            os.close(port)
            await asyncio.sleep(0.02)

    really(lambda: on_a_port(act))


def test_an_open_port_that_nobody_reads_keeps_4_kb_and_loses_what_comes_thereafter() -> None:
    async def act(device: Parrot, open_port: Callable[[], int]) -> None:
        port = open_port()
        for i in range(100):
            device.write(bytes([i]) * 680)
            await asyncio.sleep(0.001)
            while unread(port) < min(680 * (i + 1), 4080):  # a busy kernel counts bytes some time after it took them
                await asyncio.sleep(0.001)
        kept = what_is_there(port)
        assert 3900 <= len(kept) <= 4096
        assert kept == b"".join(bytes([i]) * 680 for i in range(100))[: len(kept)]
        device.write(b"now")
        await asyncio.sleep(0.02)
        assert what_is_there(port) == b"now"
        os.close(port)

    really(lambda: on_a_port(act))


def test_what_a_host_says_right_after_opening_is_heard_each_time() -> None:
    async def act(device: Parrot, open_port: Callable[[], int]) -> None:
        for said in (b"one", b"two", b"three"):
            port = open_port()
            os.write(port, said)
            async with asyncio.timeout(1):
                while what_is_there(port) != said:
                    await asyncio.sleep(0.005)
            os.close(port)
        assert device.heard == b"onetwothree"

    really(lambda: on_a_port(act))


def test_a_line_cut_by_a_lost_connection_is_not_completed_by_the_next() -> None:
    said: list[bytes] = []

    async def main() -> None:
        table = TableModel({"x": AxisData(1.0, 1.0, 1000)}, asyncio.get_running_loop().time)
        async with on_tcp(
            lambda write: GalilController(TableTwinSetup(table, {"x": "A"}, {"velocity_window": 0.25}, 0.0), write),
            "127.0.0.1",
        ) as (host, port):
            for line in (b"SHA\rMG _M", b"OA\r", b"MG _MOA\r"):
                link = TcpLink("table", host, port, 1.0)
                await link.open()
                link.write(line)
                said.append((await link.receive()).data)
                link.close()
                await asyncio.sleep(0.02)

    really(main)
    assert said == [b":", b"?", b" 0.0000\r\n:"]


def test_the_last_station_at_a_port_is_served() -> None:
    async def main() -> None:
        async with on_tcp(Parrot, "127.0.0.1") as (host, port):
            first, second = TcpLink("a", host, port, 1.0), TcpLink("b", host, port, 1.0)
            await first.open()
            first.write(b"1")
            await received(first, 1)
            await second.open()
            second.write(b"2")
            assert await received(second, 1) == b"2"
            with pytest.raises(LinkLost):
                await received(first, 1)
            first.close()
            second.close()

    really(main)


def test_a_device_on_a_wire_in_memory_ends_with_it() -> None:
    async def main() -> None:
        with in_memory("imu", Parrot) as link:
            assert isinstance(link, MemoryLink)
        with pytest.raises(LinkLost, match="imu: the wire was unplugged"):
            await link.open()

    really(main)
