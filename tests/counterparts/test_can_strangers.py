"""CAN without a kernel: python-can and cantools with a DBC, and can-j1939, in processes of their own."""

from __future__ import annotations

import asyncio
import importlib.util
import json
import os
import random
import socket
import subprocess
import sys
import tty
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import can_stranger as stranger
import numpy as np
import pytest
from can_support import collect, joined
from setups import imu_setup
from support import TwinProcess

from drivers.imus.aceinna.codec import DBC as ACEINNA_DBC
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel, CanImu, CanSource
from drivers.links.can_link import CanLink
from drivers.specs import ImuSetup
from drivers.types import ImuBlock
from station.run.event_loop.loops import ScaledLoop

T = TypeVar("T")
pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")
needs_j1939 = pytest.mark.skipif(importlib.util.find_spec("j1939") is None, reason="needs can-j1939 (pip)")
GROUP = "239.74.163.9"
COUNT = 150
GYROS = tuple(CanChannel(f"gyro{i}", f"GYRO{i}_RATE.Rate") for i in range(1, 5))
BENCHES = Path(__file__).parents[1] / "data" / "benches"


def in_real_time(main: Callable[[], Awaitable[T]]) -> T:
    async def run() -> T:
        return await main()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        return runner.run(run())


def called(role: str, channel: str, interface: str, options: dict[str, Any], *arguments: str | Path | int) -> list[str]:
    words = [role, channel, interface, json.dumps(options), *map(str, arguments)]
    return [sys.executable, stranger.__file__, *words]


def answered(*called_as: Any) -> Any:
    done = subprocess.run(called(*called_as), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def multicast() -> dict[str, Any]:
    """Return the options of a bus on UDP that nobody else is on."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.bind(("", 0))
        return {"port": asked.getsockname()[1], "hop_limit": 0}


@contextmanager
def twins(tmp_path: Path, bench: str, *changes: tuple[str, str]) -> Iterator[dict[str, str]]:
    """Serve the twins of a bench in a process of their own."""
    text = (BENCHES / bench).read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = tmp_path / bench
    path.write_text(text)
    with TwinProcess("--bench", path) as twin:
        yield twin.links


def address(link: str) -> tuple[str, str, dict[str, Any]]:
    """Return channel, interface and options of a link, as python-can has them."""
    _, interface, rest = link.split(":", 2)
    channel, _, query = rest.partition("?")
    return (
        channel,
        interface,
        {key: int(value) for key, value in (pair.split("=") for pair in query.split("&") if pair)},
    )


@pytest.mark.parametrize("wire", ["slcan", "udp_multicast"])
def test_python_can_and_cantools_read_our_twins_as_the_dbc_says(tmp_path: Path, wire: str) -> None:
    """The table rests, so each gyro shows its bias: 20, -35 and 10 deg/h, within noise and resolution."""
    channels = "channels = [" + ", ".join(f'{{ rate = "GYRO{i}_RATE.Rate" }}' for i in (1, 2, 3)) + "]"
    changes = (
        ('protocol = "j1939"', 'protocol = "can"'),
        ('array = "triad"', f'array = "triad"\n{channels}'),
        ('openimu = "slcan"', f'openimu = "{wire}"'),
    )
    with twins(tmp_path, "galil_j1939.toml", *changes) as links:
        channel, interface, options = address(links["openimu"])
        seen = answered(
            "listen", channel, interface, options | ({"sleep_after_open": 0.1} if wire == "slcan" else {}), BUILT_IN_DBC
        )
    assert sorted(seen) == [f"{name}.Rate" for name in ("GYRO1_RATE", "GYRO2_RATE", "GYRO3_RATE")]
    for found in seen.values():
        assert 50 < found["count"] < 120 * stranger.SECONDS
        assert found["sum"] / found["count"] == pytest.approx(0, abs=0.03)


async def heard_of(link: CanLink, *called_as: Any) -> tuple[CanImu, dict[str, ImuBlock]]:
    """Return a driver of the built-in nodes, and what it has made of all that a stranger sends."""
    imu = CanImu(ImuSetup("array", 100.0, 0.5, {}, CanSource(BUILT_IN_DBC, GYROS)), link)
    found: dict[str, list[ImuBlock]] = {name: [] for name in imu.names}

    async def read() -> None:
        async for name, block in imu.blocks():
            found[name].append(block)

    await imu.open()
    reader = asyncio.create_task(read())
    process = subprocess.Popen(called("send", *called_as, BUILT_IN_DBC, COUNT), stdout=subprocess.DEVNULL)
    assert await asyncio.to_thread(process.wait, 60) == 0
    await asyncio.sleep(0.5)  # what is still on its way
    reader.cancel()
    await asyncio.gather(reader, return_exceptions=True)
    for name, block in imu.flush():
        found[name].append(block)
    imu.close()
    return imu, {name: joined(blocks) for name, blocks in found.items()}


def test_our_driver_reads_a_stranger_on_udp_with_nothing_but_the_dbc() -> None:
    options = multicast()

    async def main() -> tuple[CanImu, dict[str, ImuBlock]]:
        return await heard_of(CanLink("array", "udp_multicast", GROUP, options), GROUP, "udp_multicast", options)

    imu, blocks = in_real_time(main)
    for gyro, rate in zip(GYROS, stranger.RATES_DPS, strict=True):
        counts = imu.counts(gyro.name)
        assert (counts.corrupt, counts.lost) == (0, 0)
        assert len(blocks[gyro.name].t_ns) == COUNT
        assert np.degrees(blocks[gyro.name].rate_rps) == pytest.approx(rate, abs=1e-9)


@asynccontextmanager
async def serial_wire(spoil: Callable[[bytes], list[bytes]]) -> AsyncIterator[tuple[str, str]]:
    """Join two pseudo-terminals by a proxy that hands on what comes at the first as ``spoil`` makes it."""
    loop, ours, names = asyncio.get_running_loop(), [], []
    for _ in range(2):
        near, far = os.openpty()
        tty.setraw(far)
        os.set_blocking(near, False)
        ours.append(near)
        names.append((os.ttyname(far), far))

    def carry() -> None:
        for piece in spoil(os.read(ours[0], 4096)):
            os.write(ours[1], piece)

    loop.add_reader(ours[0], carry)
    try:
        yield names[0][0], names[1][0]
    finally:
        loop.remove_reader(ours[0])
        for near, (_, far) in zip(ours, names, strict=True):
            os.close(near)
            os.close(far)


RANDOM = random.Random(1)


def broken(data: bytes) -> list[bytes]:
    """Lose one byte in five hundred."""
    return [bytes(byte for byte in data if RANDOM.random() > 0.002)]


WIRES: dict[str, Callable[[bytes], list[bytes]]] = {
    "whole": lambda data: [data],
    "byte by byte": lambda data: [data[i : i + 1] for i in range(len(data))],
    "in threes": lambda data: [data[i : i + 3] for i in range(0, len(data), 3)],
    "answers between": lambda data: [data.replace(b"\r", b"\r\r\az\rF00\rV1013\r")],
    "noise between": lambda data: [
        data.replace(b"\r", b"\r" + bytes(RANDOM.randbytes(5)).translate(None, b"tT\r") + b"\r")
    ],
    "lines doubled": lambda data: [data.replace(b"\rt", b"\r\rt")],
    "bytes lost": broken,
    "line feeds": lambda data: [data.replace(b"\r", b"\r\n")],
}


@pytest.mark.parametrize("wire", WIRES)
def test_our_driver_reads_the_lines_of_python_cans_slcan(wire: str) -> None:
    """A wire that loses bytes loses frames, which are counted or missing; what is left is right."""

    async def main() -> tuple[CanImu, dict[str, ImuBlock]]:
        async with serial_wire(WIRES[wire]) as (theirs, ours):
            link = CanLink("array", "slcan", ours, {"sleep_after_open": 0.0})
            return await heard_of(link, theirs, "slcan", {"sleep_after_open": 0.1})

    imu, blocks = in_real_time(main)
    for gyro, rate in zip(GYROS, stranger.RATES_DPS, strict=True):
        rates = np.degrees(blocks[gyro.name].rate_rps)
        if wire == "bytes lost":
            assert 0.8 * COUNT < len(rates) <= COUNT
            assert np.mean(np.abs(rates - rate) < 1e-9) > 0.95  # a digit less in a line may leave a line
        else:
            assert (len(rates), imu.counts(gyro.name).lost) == (COUNT, 0)
            assert rates == pytest.approx(rate, abs=1e-9)


@contextmanager
def foreign_device(options: dict[str, Any], *words: str) -> Iterator[None]:
    with subprocess.Popen(
        called("device", GROUP, "udp_multicast", options, *words),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield
        process.stdin.close()
        process.wait(10)


@needs_j1939
@pytest.mark.parametrize("version", ["short", "long"])
def test_our_driver_sets_and_names_a_device_of_can_j1939_and_reads_it(version: str) -> None:
    """A version that takes the transport protocol stays unknown; all else is as of a device that is brief."""
    options = multicast()

    async def main() -> tuple[Any, Any, Any]:
        link = CanLink("imu", "udp_multicast", GROUP, options)
        imu = AceinnaImu(imu_setup("j1939", "imu", 100.0, model="openimu300ri", configure=True), link)
        await imu.open()
        identity = await imu.identify()
        blocks = await collect(imu, 1.5)
        imu.close()
        return identity, blocks["imu"], imu.counts("imu")

    with foreign_device(options, version):
        identity, block, counts = in_real_time(main)
    named = stranger.NAME
    assert identity.model == f"J1939 manufacturer {named['manufacturer_code']}, function {named['function']}"
    assert identity.serial == str(named["identity_number"])
    assert identity.firmware == ("2.7.18 stage 1 build 44" if version == "short" else "")
    assert np.degrees(np.nanmedian(block.rate_rps, axis=0)) == pytest.approx(stranger.RATES_DPS[:3], abs=1 / 256)
    assert block.accel_mps2 is not None
    assert np.nanmedian(block.accel_mps2, axis=0) == pytest.approx([0, 0, 9.81], abs=0.005)
    assert counts.corrupt == 0


@needs_j1939
def test_can_j1939_asks_our_twin_and_leaves_it_its_address(tmp_path: Path) -> None:
    """On a bus that there is, the twin has a NAME, answers, refuses, bears long messages, defends its address."""
    options = multicast()
    wire = f"can:udp_multicast:{GROUP}?" + "&".join(f"{key}={value}" for key, value in options.items())
    with twins(tmp_path, "galil_j1939.toml", ('openimu = "slcan"', f'openimu = "{wire}"')) as links:
        assert links["openimu"] == wire
        said = answered("host", GROUP, "udp_multicast", options)
    named = {"manufacturer_code": 823, "identity_number": 305_001, "function": 131}
    assert next(name for address, name in said["claims"] if address == stranger.DEVICE) == named
    assert said["FEDA"] == [19, 1, 51, 2, 1]
    unknown = stranger.UNKNOWN
    assert said["E800"] == [1, 0xFF, 0xFF, 0xFF, stranger.HOST, unknown & 0xFF, unknown >> 8, 0]
    assert said["samples"] > 20
    assert said["contender"] == stranger.DEVICE + 1


@needs_j1939
def test_python_cans_slcan_carries_can_j1939_to_our_twin(tmp_path: Path) -> None:
    with twins(tmp_path, "galil_j1939.toml") as links:
        channel, interface, _ = address(links["openimu"])
        said = answered("host", channel, interface, {"sleep_after_open": 0.1})
    assert (said["FEDA"], said["contender"]) == ([19, 1, 51, 2, 1], stranger.DEVICE + 1)


def test_python_can_reads_what_an_adapter_hands_on_of_a_j1939_device(tmp_path: Path) -> None:
    with twins(tmp_path, "galil_j1939.toml") as links:
        channel, interface, _ = address(links["openimu"])
        seen = answered("listen", channel, interface, {"sleep_after_open": 0.1}, ACEINNA_DBC)
    up = seen["ACCS.Acceleration3"]
    assert 50 < up["count"] < 120 * stranger.SECONDS
    assert up["sum"] / up["count"] == pytest.approx(9.80, abs=0.1)
