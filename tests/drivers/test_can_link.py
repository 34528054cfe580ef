"""CAN links over real wires: slcan on a pty, socketcand on loopback TCP, python-can's own buses; and their ends."""

from __future__ import annotations

import asyncio
import os
import socket
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from typing import Any

import can
import numpy as np
import pytest
from can_support import gyros

from drivers.errors import LinkLost
from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel, CanImu, CanSource
from drivers.links.can_link import CanLink
from drivers.links.can_memory import MemoryBus
from drivers.specs import ImuSetup
from drivers.types import Frame
from sims.imus.can_nodes import CanNodes
from sims.wires.frames import ImuTwinSetup
from sims.wires.slcan_adapter import SlcanAdapter
from sims.wires.socketcand_server import SocketcandServer

SENT = (
    can.Message(arbitration_id=0x123, is_extended_id=False, data=b"\x01\x02"),
    can.Message(arbitration_id=0x123, is_extended_id=True, data=b""),
    can.Message(arbitration_id=0x0CF02A80, is_extended_id=True, data=bytes(range(8))),
)


def values(frames: list[Frame]) -> list[tuple[int, bool, bytes]]:
    return [(frame.identifier, frame.extended, frame.data) for frame in frames]


def values_of(messages: Any) -> list[tuple[int, bool, bytes]]:
    return [(m.arbitration_id, m.is_extended_id, bytes(m.data)) for m in messages]


class Pty:
    """An slcan adapter at the far end of a pty, served by the test's loop."""

    def __init__(self) -> None:
        self.heard: list[can.Message] = []
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._ours)
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.port = os.ttyname(self._theirs)
        self.adapter = SlcanAdapter(self.write, self.heard.append)
        asyncio.get_running_loop().add_reader(self._ours, self._read)

    def write(self, data: bytes) -> None:
        with suppress(BlockingIOError):
            os.write(self._ours, data)

    def unplug(self) -> None:
        if self._ours < 0:
            return
        asyncio.get_running_loop().remove_reader(self._ours)
        os.close(self._ours)
        os.close(self._theirs)
        self._ours = -1

    def _read(self) -> None:
        self.adapter.received(os.read(self._ours, 4096))


@asynccontextmanager
async def slcan_link() -> AsyncIterator[tuple[CanLink, Pty]]:
    pty = Pty()
    link = CanLink("imu", "slcan", pty.port, {"bitrate": 500_000, "sleep_after_open": 0})
    await link.open()
    try:
        # The channel is opened twice (the bit rate first): an answer on its way would fall into what a test writes.
        link.send(Frame(0, 1, False, b""))
        await until(lambda: bool(pty.heard))
        pty.heard.clear()
        yield link, pty
    finally:
        link.close()
        pty.unplug()


@asynccontextmanager
async def socketcand_link() -> AsyncIterator[tuple[CanLink, SocketcandServer, list[can.Message]]]:
    heard: list[can.Message] = []
    server = SocketcandServer("can0", heard.append)
    host, port = await server.start("127.0.0.1")
    link = CanLink("imu", "socketcand", "can0", {"host": host, "port": port})
    await link.open()
    try:
        yield link, server, heard
    finally:
        link.close()
        await server.close()


async def until(condition: Callable[[], bool]) -> None:
    """Wait for what the other end of a wire is about to do."""
    async with asyncio.timeout(5):
        while not condition():
            await asyncio.sleep(0.002)


async def receive(link: CanLink, count: int) -> list[Frame]:
    frames: list[Frame] = []
    async with asyncio.timeout(5):
        while len(frames) < count:
            frames += await link.receive()
    return frames


def run(main: Callable[[], Awaitable[None]]) -> None:
    async def whole() -> None:
        await main()

    asyncio.run(whole())


def test_frames_go_both_ways_over_slcan() -> None:
    async def main() -> None:
        async with slcan_link() as (link, pty):
            before_ns = asyncio.get_running_loop().time() * 1e9
            for message in SENT:
                pty.adapter.send(message)
            frames = await receive(link, 3)
            assert values(frames) == values_of(SENT)
            assert all(before_ns <= f.t_ns <= asyncio.get_running_loop().time() * 1e9 for f in frames)
            for frame in frames:
                link.send(frame)
            await until(lambda: len(pty.heard) == 3)
            assert values_of(pty.heard) == values_of(SENT)

    run(main)


def test_damaged_lines_are_counted_and_do_not_end_the_link() -> None:
    async def main() -> None:
        async with slcan_link() as (link, pty):
            pty.write(b"tXYZ2AABB\rt123\rT0CF0\rt1238AABB\xff\r" + b"9" * 5000 + b"\r\a\a\r\rz\r")
            pty.adapter.send(SENT[0])
            frames = await receive(link, 1)
            assert values(frames[-1:]) == values_of(SENT[:1])
            assert link.malformed == 4

    run(main)


def test_lines_cut_anywhere_are_the_same_frames() -> None:
    async def main() -> None:
        async with slcan_link() as (link, pty):
            for byte in b"t1232AABB\rT0CF02A808C981EB7C79790006\r":
                pty.write(bytes([byte]))
                await asyncio.sleep(0.001)
            assert values(await receive(link, 2)) == [
                (0x123, False, b"\xaa\xbb"),
                (0x0CF02A80, True, bytes.fromhex("c981eb7c79790006")),
            ]

    run(main)


def test_remote_frames_carry_no_data_and_are_left_out() -> None:
    async def main() -> None:
        async with slcan_link() as (link, pty):
            pty.adapter.send(can.Message(arbitration_id=1, is_remote_frame=True, dlc=8))
            pty.adapter.send(SENT[0])
            assert values(await receive(link, 1)) == values_of(SENT[:1])

    run(main)


def test_error_frames_of_a_bus_are_counted_and_left_out() -> None:
    warning, bus_off = (can.Message(arbitration_id=code, is_error_frame=True, data=bytes(8)) for code in (0x04, 0x40))

    async def main() -> None:
        link = CanLink("imu", "virtual", "errors", {})
        await link.open()
        with can.Bus(interface="virtual", channel="errors") as other:
            for message in (SENT[0], warning, bus_off, SENT[1]):
                other.send(message)
            assert values(await receive(link, 2)) == values_of(SENT[:2])
            assert (link.counts.error_frames, link.counts.bus_off) == (2, 1)
        link.close()

    run(main)


def test_an_adapter_that_is_unplugged_is_a_lost_link_in_plain_words() -> None:
    async def main() -> None:
        async with slcan_link() as (link, pty):
            pty.adapter.send(SENT[0])
            await receive(link, 1)
            pty.unplug()
            with pytest.raises(LinkLost, match=r"^imu: CAN bus slcan:/dev/pts/\d+ failed \([^\n]+\)$"):
                await receive(link, 1)
            with pytest.raises(LinkLost, match="does not accept frames"):
                link.send(Frame(0, 1, False, b""))

    run(main)


def test_frames_go_both_ways_over_socketcand() -> None:
    async def main() -> None:
        async with socketcand_link() as (link, server, heard):
            for message in SENT:
                server.send(message)
            frames = await receive(link, 3)
            assert values(frames) == values_of(SENT)
            for frame in frames:
                link.send(frame)
            await until(lambda: len(heard) == 3)
            assert values_of(heard) == values_of(SENT)

    run(main)


def test_a_server_that_hangs_up_is_a_lost_link() -> None:
    async def main() -> None:
        async with socketcand_link() as (link, server, _):
            await server.close()
            with pytest.raises(
                LinkLost, match=r"imu: CAN bus socketcand:can0 failed \(the server closed the connection\)"
            ):
                await receive(link, 1)

    run(main)


def test_a_link_that_was_lost_can_be_opened_again() -> None:
    async def main() -> None:
        async with socketcand_link() as (link, server, _):
            server.hang_up()
            with pytest.raises(LinkLost):
                await receive(link, 1)
            link.close()
            await link.open()
            server.send(SENT[0])
            assert values(await receive(link, 1)) == values_of(SENT[:1])

    run(main)


def test_a_server_that_refuses_the_bus_says_so() -> None:
    async def main() -> None:
        server = SocketcandServer("can0")
        host, port = await server.start("127.0.0.1")
        link = CanLink("imu", "socketcand", "can7", {"host": host, "port": port})
        with pytest.raises(LinkLost, match="cannot open CAN bus socketcand:can7 .*error unknown command"):
            await link.open()
        await server.close()

    run(main)


def test_a_connection_that_is_refused_is_known_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    async def main() -> None:
        link = CanLink("imu", "socketcand", "can0", {"host": "127.0.0.1", "port": port})
        async with asyncio.timeout(1.0):
            with pytest.raises(LinkLost, match="cannot open CAN bus socketcand:can0 .*refused"):
                await link.open()

    run(main)


@pytest.mark.parametrize(
    ("interface", "channel", "options"),
    [
        ("slcan", "/dev/nothing", {"sleep_after_open": 0}),
        ("slcan", "", {}),
        ("socketcand", "can0", {"colour": "red"}),
        ("nosuch", "can0", {}),
    ],
)
def test_a_bus_that_cannot_be_opened_is_a_lost_link_in_one_line(
    interface: str, channel: str, options: dict[str, Any]
) -> None:
    async def main() -> None:
        with pytest.raises(LinkLost, match=rf"^imu: cannot open CAN bus {interface}:{channel} \([^\n]+\)\. Is it"):
            await CanLink("imu", interface, channel, options).open()

    run(main)


def test_a_virtual_bus_of_python_can_exchanges_frames() -> None:
    async def main() -> None:
        link = CanLink("imu", "virtual", "test_can_link", {})
        other = can.Bus(interface="virtual", channel="test_can_link")
        await link.open()
        for message in SENT:
            other.send(message)
        assert values(await receive(link, 3)) == values_of(SENT)
        link.send(Frame(0, 0x55, False, b"\x07"))
        found = other.recv(1.0)
        assert found is not None
        assert values_of([found]) == [(0x55, False, b"\x07")]
        link.close()
        link.close()
        other.shutdown()

    run(main)


def node(interface: str, channel: str) -> can.BusABC:
    return MemoryBus(channel) if interface == "memory" else can.Bus(interface=interface, channel=channel)


@pytest.mark.parametrize("interface", ["memory", "virtual"])
def test_closing_wakes_up_who_waits_for_frames(interface: str) -> None:
    async def main() -> None:
        link = CanLink("imu", interface, "closed", {})
        await link.open()
        waiting = asyncio.ensure_future(link.receive())
        await asyncio.sleep(0)
        link.close()
        with pytest.raises(LinkLost, match="imu: the link was closed"):
            async with asyncio.timeout(1.0):
                await waiting

    run(main)


@pytest.mark.parametrize("interface", ["memory", "virtual"])
def test_opening_again_leaves_the_bus_and_drops_the_frames_of_before(interface: str) -> None:
    async def main() -> None:
        link = CanLink("imu", interface, "reopened", {})
        other = node(interface, "reopened")
        await link.open()
        for message in SENT[:1] * 1000:
            other.send(message)
        await receive(link, 1)
        await link.open()
        for message in SENT[1:]:
            other.send(message)
        assert values(await receive(link, 2)) == values_of(SENT[1:])
        link.close()
        other.shutdown()

    run(main)


def test_a_multicast_bus_is_stamped_by_the_kernel() -> None:
    async def main() -> None:
        options = {"port": 45_113 + os.getpid() % 1000, "hop_limit": 0}
        link = CanLink("imu", "udp_multicast", "239.74.163.2", options)
        try:
            await link.open()
            other = can.Bus(interface="udp_multicast", channel="239.74.163.2", **options)  # type: ignore[arg-type]
        except (LinkLost, OSError, can.CanError) as error:
            pytest.skip(f"no multicast here: {error}")
        before_ns = asyncio.get_running_loop().time() * 1e9
        other.send(SENT[0])
        (frame,) = await receive(link, 1)
        assert values([frame]) == values_of(SENT[:1])
        assert before_ns - 1e6 <= frame.t_ns <= asyncio.get_running_loop().time() * 1e9
        link.close()
        other.shutdown()

    run(main)


def test_python_cans_own_socketcand_reads_the_twin() -> None:
    async def main() -> None:
        heard: list[can.Message] = []
        server = SocketcandServer("can0", heard.append)
        host, port = await server.start("127.0.0.1")
        bus = await asyncio.to_thread(can.Bus, "can0", interface="socketcand", host=host, port=port)
        for message in SENT:
            server.send(message)
        found = [await asyncio.to_thread(bus.recv, 1.0) for _ in SENT]
        assert values_of(found) == values_of(SENT)
        bus.send(SENT[2])
        await until(lambda: len(heard) == 1)
        assert values_of(heard) == values_of(SENT[2:])
        bus.shutdown()
        await server.close()

    run(main)


def test_the_can_twin_is_measured_over_slcan_and_over_socketcand() -> None:
    channels = tuple(CanChannel(f"g{i}", f"GYRO{i}_RATE.Rate") for i in (1, 2, 3))
    signals = CanSource(BUILT_IN_DBC, channels)

    async def measure(link: CanLink, bus: Any) -> None:
        imu = CanImu(ImuSetup("imu", 200.0, 0.5, signals=CanSource(BUILT_IN_DBC, channels)), link)
        twin = asyncio.create_task(
            CanNodes(ImuTwinSetup(gyros=gyros(200.0), rate_hz=200.0, signals=signals), bus).serve()
        )
        seen: dict[str, list[float]] = {name: [] for name in imu.names}
        async with asyncio.timeout(5):
            async for name, block in imu.blocks():
                seen[name] += np.degrees(block.rate_rps[:, 0]).tolist()
                if min(map(len, seen.values())) >= 40:
                    break
        twin.cancel()
        for name, rate in zip(imu.names, (10.0, -20.0, 30.0), strict=True):
            np.testing.assert_allclose(seen[name], rate, atol=0.003)
            assert imu.counts(name).corrupt == 0

    async def main() -> None:
        async with slcan_link() as (link, pty):
            await measure(link, pty.adapter)
        async with socketcand_link() as (link, server, _):
            await measure(link, server)

    run(main)
