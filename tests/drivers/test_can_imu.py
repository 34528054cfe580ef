"""Gyros on CAN: frames written by hand from the DBC, on a bus in memory and in virtual time."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Sequence
from pathlib import Path

import can
import numpy as np
import pytest

from drivers.errors import DeviceError, LinkLost
from drivers.imus.can.imu import BUILT_IN_DBC, CanChannel, CanImu, CanSource
from drivers.links.can_link import CanLink
from drivers.links.can_memory import MemoryBus
from drivers.specs import ImuSetup
from drivers.types import ImuBlock, SourceCounts
from station.run.event_loop.loops import VirtualLoop

CHANNELS = (
    CanChannel("g1", "GYRO1_RATE.Rate", "GYRO1_TEMPERATURE.Temperature"),
    CanChannel("g2", "GYRO2_RATE.Rate"),
)
RATE_1, RATE_2, TEMPERATURE_1 = 0x101, 0x102, 0x181
_buses = itertools.count()

Sent = tuple[float, int, bytes]


def received(
    frames: Sequence[Sent], channels: tuple[CanChannel, ...] = CHANNELS, *, remote: bool = False, extended: bool = False
) -> tuple[dict[str, list[ImuBlock]], dict[str, SourceCounts]]:
    """Send frames (instant in s, id, data) to a driver; return its blocks and counts by channel."""

    async def main() -> tuple[dict[str, list[ImuBlock]], dict[str, SourceCounts]]:
        name = f"can test {next(_buses)}"
        link = CanLink("array", "memory", name, {})
        imu = CanImu(ImuSetup("array", 100.0, 0.5, signals=CanSource(BUILT_IN_DBC, channels)), link)
        await imu.open()
        found: dict[str, list[ImuBlock]] = {channel: [] for channel in imu.names}

        async def read() -> None:
            async for channel, block in imu.blocks():
                found[channel].append(block)

        reader = asyncio.create_task(read())
        nodes = MemoryBus(name)
        for at, identifier, data in frames:
            await asyncio.sleep(at - asyncio.get_running_loop().time())
            nodes.send(
                can.Message(
                    arbitration_id=identifier, data=data, is_extended_id=extended, is_remote_frame=remote, dlc=len(data)
                )
            )
        await asyncio.sleep(1.0)
        link.end("the bus is off")
        with pytest.raises(LinkLost, match="array: the bus is off"):
            await reader
        for channel, block in imu.flush():
            found[channel].append(block)
        imu.close()
        nodes.shutdown()
        return found, {channel: imu.counts(channel) for channel in imu.names}

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())


def stream(identifier: int, data: Sequence[bytes], start_s: float = 0.01) -> list[Sent]:
    return [(start_s + i / 100, identifier, raw) for i, raw in enumerate(data)]


def rates_dps(blocks: list[ImuBlock]) -> np.ndarray:
    return np.degrees(np.concatenate([block.rate_rps[:, 0] for block in blocks]))


@pytest.mark.parametrize(
    ("raw", "dps"),
    [
        ("a00f", 20.0),
        ("60f0", -20.0),
        ("0100", 0.005),
        ("ffff", -0.005),
        ("0000", 0.0),
        ("ff7f", 163.835),
        ("0080", -163.84),
    ],
)
def test_two_bytes_are_a_rate_little_endian_and_signed(raw: str, dps: float) -> None:
    blocks, counts = received(stream(RATE_1, [bytes.fromhex(raw)] * 40))
    np.testing.assert_allclose(rates_dps(blocks["g1"]), np.full(40, dps), atol=1e-12)
    assert counts["g1"] == SourceCounts(samples=40)
    assert blocks["g2"] == []


def test_samples_have_the_times_of_their_frames() -> None:
    blocks, _ = received(stream(RATE_1, [i.to_bytes(2, "little") for i in range(60)]))
    t_ns = np.concatenate([block.t_ns for block in blocks["g1"]])
    np.testing.assert_allclose(t_ns, 10_000_000 * np.arange(1, 61), atol=2)
    np.testing.assert_allclose(rates_dps(blocks["g1"]), 0.005 * np.arange(60), atol=1e-12)


def test_channels_are_sources_of_their_own() -> None:
    both = stream(RATE_1, [b"\xa0\x0f"] * 50) + stream(RATE_2, [b"\x60\xf0"] * 30, 0.013)
    blocks, counts = received(sorted(both))
    np.testing.assert_allclose(rates_dps(blocks["g1"]), np.full(50, 20.0), atol=1e-12)
    np.testing.assert_allclose(rates_dps(blocks["g2"]), np.full(30, -20.0), atol=1e-12)
    assert (counts["g1"].samples, counts["g2"].samples) == (50, 30)


def test_temperatures_are_unknown_until_the_first_is_told() -> None:
    told = [(0.205, TEMPERATURE_1, (-1025).to_bytes(2, "little", signed=True))]
    blocks, _ = received(sorted(stream(RATE_1, [b"\x00\x00"] * 80) + told))
    temperature = np.concatenate([block.temperature_c for block in blocks["g1"]])
    assert np.isnan(temperature[0])
    assert temperature[-1] == pytest.approx(-10.25)


@pytest.mark.parametrize("data", [b"", b"\x01", b"\x01\x02\x03", bytes(8)])
def test_frames_of_a_wrong_length_are_counted_and_left_out(data: bytes) -> None:
    frames = [*stream(RATE_1, [b"\xa0\x0f"] * 40), (0.1051, RATE_1, data), (0.2051, TEMPERATURE_1, data)]
    blocks, counts = received(sorted(frames))
    np.testing.assert_allclose(rates_dps(blocks["g1"]), np.full(40, 20.0), atol=1e-12)
    assert counts["g1"] == SourceCounts(samples=40, corrupt=2)


def test_foreign_frames_are_ignored() -> None:
    frames = stream(RATE_1, [b"\xa0\x0f"] * 40) + stream(0x103, [b"\x01\x02"] * 40) + stream(0x7FF, [bytes(8)] * 40)
    _, counts = received(sorted(frames))
    assert counts == {"g1": SourceCounts(samples=40), "g2": SourceCounts()}


def test_remote_frames_carry_no_rate() -> None:
    blocks, counts = received(stream(RATE_1, [b"\x00\x00"] * 20), remote=True)
    assert blocks["g1"] == []
    assert counts["g1"] == SourceCounts()


def test_a_lost_frame_is_counted() -> None:
    frames = stream(RATE_1, [b"\xa0\x0f"] * 200)
    _, counts = received(frames[:90] + frames[93:])
    assert counts["g1"] == SourceCounts(samples=197, lost=3)


@pytest.mark.parametrize(
    "signal", ["GYRO9_RATE.Rate", "GYRO1_RATE.Speed", "GYRO1_RATE", "Rate", "", "GYRO1_TEMPERATURE.Rate"]
)
def test_an_unknown_signal_is_refused_by_name(signal: str) -> None:
    with pytest.raises(DeviceError, match=r"array: gyro_nodes\.dbc has no signal .*MESSAGE\.Signal"):
        CanImu(
            ImuSetup("array", 100.0, 0.5, signals=CanSource(BUILT_IN_DBC, (CanChannel("g1", signal),))),
            CanLink("array", "memory", "nowhere", {}),
        )


def test_a_rate_signal_that_is_no_rate_is_refused() -> None:
    channel = CanChannel("g1", "GYRO1_TEMPERATURE.Temperature")
    with pytest.raises(DeviceError, match="unit 'degC', not deg/s or rad/s"):
        CanImu(
            ImuSetup("array", 100.0, 0.5, signals=CanSource(BUILT_IN_DBC, (channel,))),
            CanLink("array", "memory", "nowhere", {}),
        )


@pytest.mark.parametrize("text", [None, "this is no DBC"])
def test_a_dbc_that_cannot_be_read_is_refused(tmp_path: Path, text: str | None) -> None:
    dbc = tmp_path / "odd.dbc"
    if text is not None:
        dbc.write_text(text)
    with pytest.raises(DeviceError, match=r"array: DBC file odd\.dbc cannot be read"):
        CanImu(
            ImuSetup("array", 100.0, 0.5, signals=CanSource(dbc, CHANNELS)), CanLink("array", "memory", "nowhere", {})
        )


def test_an_extended_frame_of_the_same_number_is_another_message() -> None:
    bus_frames = [(0.01 * (i + 1), RATE_1, b"\xa0\x0f") for i in range(40)]
    blocks, _ = received(bus_frames, extended=True)
    assert not any(blocks.values())
