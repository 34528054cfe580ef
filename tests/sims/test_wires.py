"""Wires at whose far end a twin sits: in memory, on a pseudo-terminal, on a TCP port."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

import pytest

from drivers.byte_links import MemoryLink, SerialLink, TcpLink
from drivers.errors import LinkLost
from drivers.reopen import reopen
from drivers.seams import ByteLink
from sims.wires import ByteDevice, Plug, Write, in_memory, on_pty, on_tcp, pty_joint


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
            for _ in range(30):
                parrots[0].write(b"." * 1000)
            data = b""
            async with asyncio.timeout(5):
                while data.count(b".") < 30_000:
                    data += (await link.receive()).data
            assert len(data) < 400_000
            link.close()

    really(main)


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


def test_two_ports_joined_by_a_cable() -> None:
    async def main() -> None:
        async with pty_joint() as (one, other):
            a, b = SerialLink("a", one, 19200), SerialLink("b", other, 19200)
            await a.open()
            await b.open()
            a.write(b"ping")
            assert await received(b, 4) == b"ping"
            b.write(b"pong")
            assert await received(a, 4) == b"pong"
            a.close()
            b.close()

    really(main)


def test_a_device_on_a_wire_in_memory_ends_with_it() -> None:
    async def main() -> None:
        with in_memory("imu", Parrot) as link:
            assert isinstance(link, MemoryLink)
        with pytest.raises(LinkLost, match="imu: the wire was unplugged"):
            await link.open()

    really(main)
