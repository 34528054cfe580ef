"""Fault knobs: what a wire does to bytes and frames, what a bench file may ask for."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from typing import Any

import can
import numpy as np
import pytest

from drivers.errors import LinkLost
from sims.physics.hidden import HiddenError
from sims.physics.table import FOLLOWING_ERROR, AxisData, TableModel
from sims.wires.faults import (
    DeviceFaults,
    FaultyBytes,
    FaultyFrames,
    TableFault,
    WireFaults,
    device_faults,
    faulty_device,
    table_faults,
)
from sims.wires.wires import Plug, Write, in_memory
from station.run.event_loop.loops import VirtualLoop


def virtually(main: Callable[[], Awaitable[Any]]) -> Any:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())  # type: ignore[arg-type]


def through(faults: WireFaults, sent: list[bytes], seed: int = 0, period_s: float = 0.01) -> list[tuple[float, bytes]]:
    """Return what comes through when these are sent one after another, and when."""
    came: list[tuple[float, bytes]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        wire = FaultyBytes(lambda data: came.append((loop.time(), data)), faults, seed)
        for data in sent:
            wire(data)
            await asyncio.sleep(period_s)
        await asyncio.sleep(10.0)

    virtually(main)
    return came


def frames_through(faults: WireFaults, count: int, seed: int = 0) -> list[tuple[float, int]]:
    """Return the numbers of the frames that come through when they are sent each 10 ms, and when they come."""
    came: list[tuple[float, int]] = []

    async def main() -> None:
        loop = asyncio.get_running_loop()
        bus = FaultyFrames(lambda msg: came.append((loop.time(), msg.arbitration_id)), faults, seed)
        for number in range(count):
            bus.send(can.Message(arbitration_id=number))
            await asyncio.sleep(0.01)
        await asyncio.sleep(10.0)

    virtually(main)
    return came


PIECES = [bytes([i % 256] * 20) for i in range(2000)]


def test_a_wire_without_faults_changes_nothing() -> None:
    assert [data for _, data in through(WireFaults(), PIECES)] == PIECES


def test_one_seed_gives_the_same_faults_again_and_another_gives_others() -> None:
    faults = WireFaults(jitter_s=5e-3, loss=0.1, byte_loss=0.01, bit_flips=0.01, doubled=0.05)
    assert through(faults, PIECES[:300], 1) == through(faults, PIECES[:300], 1)
    assert through(faults, PIECES[:300], 1) != through(faults, PIECES[:300], 2)


def test_latency_and_jitter_delay_and_keep_the_order() -> None:
    came = through(WireFaults(latency_s=0.02, jitter_s=0.005), PIECES)
    assert [data for _, data in came] == PIECES
    late = np.array([at for at, _ in came]) - 0.01 * np.arange(len(PIECES))
    assert late.min() >= 0.02 - 1e-9
    assert late.mean() == pytest.approx(0.025, rel=0.1)
    assert late.std() == pytest.approx(0.005, rel=0.2)


def test_a_share_of_what_a_device_sends_comes_late() -> None:
    came = through(WireFaults(late=0.05, late_by_s=0.15), PIECES, period_s=0.5)
    late_s = np.array([at - 0.5 * i for i, (at, _) in enumerate(came)])
    assert set(np.round(late_s - late_s.min(), 6)) == {0.0, 0.15}
    assert np.mean(late_s - late_s.min() > 0.1) == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize("share", [0.01, 0.2])
def test_shares_are_what_they_say(share: float) -> None:
    sent = b"".join(PIECES)
    lost = through(WireFaults(loss=share), PIECES)
    doubled = through(WireFaults(doubled=share), PIECES)
    fewer = b"".join(data for _, data in through(WireFaults(byte_loss=share), PIECES))
    flipped = b"".join(data for _, data in through(WireFaults(bit_flips=share), PIECES))
    about = pytest.approx(share, rel=0.5)
    assert 1 - len(lost) / len(PIECES) == about
    assert len(doubled) / len(PIECES) - 1 == about
    assert 1 - len(fewer) / len(sent) == about
    wrong = np.frombuffer(sent, np.uint8) ^ np.frombuffer(flipped, np.uint8)
    assert np.mean(wrong != 0) == about
    assert set(np.unpackbits(wrong[wrong != 0][:, None], axis=1).sum(axis=1)) == {1}


def test_bytes_come_one_at_a_time() -> None:
    came = [data for _, data in through(WireFaults(one_byte=True), [b"abc", b"de"])]
    assert came == [b"a", b"b", b"c", b"d", b"e"]


def test_silence_has_a_beginning_and_an_end() -> None:
    came = [at for at, _ in through(WireFaults(silent_from_s=3.0, silent_until_s=5.0), PIECES[:1000])]
    assert max(at for at in came if at < 4) == pytest.approx(3.0, abs=0.011)
    assert min(at for at in came if at > 4) == pytest.approx(5.0, abs=0.011)


def test_what_is_under_way_when_silence_falls_does_not_arrive() -> None:
    came = [at for at, _ in through(WireFaults(latency_s=1.0, silent_from_s=3.0), PIECES[:1000])]
    assert max(came) < 3.0


def test_frames_are_lost_doubled_late_and_silent_as_a_whole() -> None:
    came = frames_through(WireFaults(latency_s=0.02, loss=0.1, doubled=0.1), 2000)
    numbers = [number for _, number in came]
    assert numbers == sorted(numbers)
    assert 1 - len(set(numbers)) / 2000 == pytest.approx(0.1, rel=0.3)
    assert len(numbers) / len(set(numbers)) - 1 == pytest.approx(0.1, rel=0.3)
    assert all(at == pytest.approx(0.01 * number + 0.02) for at, number in came)
    gone = frames_through(WireFaults(unplug_s=1.0, replug_s=2.0), 300)
    assert {n for _, n in gone} - {100, 200} == set(range(300)) - set(range(100, 201))


class Parrot:
    def __init__(self, write: Write) -> None:
        self.received = write


def test_a_wire_is_faulty_both_ways_and_is_unplugged_at_its_time() -> None:
    async def main() -> None:
        plug = Plug()
        faults = WireFaults(latency_s=0.1, unplug_s=5.0, replug_s=7.0)
        loop = asyncio.get_running_loop()
        with in_memory("imu", faulty_device(Parrot, faults, 1, plug), plug) as link:
            link.write(b"?")
            assert (await link.receive()).t_ns == 200_000_000
            with pytest.raises(LinkLost):
                await link.receive()
            assert loop.time() == pytest.approx(5.0)
            with pytest.raises(LinkLost):
                await link.open()
            await asyncio.sleep(2.1)
            await link.open()
            link.write(b"!")
            assert (await link.receive()).data == b"!"

    virtually(main)


def test_timers_of_a_wire_end_with_it() -> None:
    async def main() -> None:
        plug = Plug()
        with in_memory("imu", faulty_device(Parrot, WireFaults(unplug_s=5.0), 1, plug), plug):
            pass
        await asyncio.sleep(10.0)
        assert not plug.out

    virtually(main)


def test_a_bench_file_turns_the_knobs_of_a_device_and_its_wire() -> None:
    table = {
        "stuck": 2,
        "from": "10 s",
        "until": "1 min",
        "dropped": "1 %",
        "clock": "50 ppm",
        "latency": "2 ms",
        "jitter": "5 ms",
        "byte_loss": "100 ppm",
        "one_byte": True,
        "silent_from": "20 s",
        "unplug": "30 s",
    }
    device, wire = device_faults(table, 3, "twin.imu.fault")
    assert device == DeviceFaults(stuck=2, from_s=10.0, until_s=60.0, dropped=0.01, clock=50 * 1e-6)
    assert device.clock_ppm == pytest.approx(50.0)
    assert wire == WireFaults(
        latency_s=2e-3, jitter_s=5e-3, byte_loss=100 * 1e-6, one_byte=True, silent_from_s=20.0, unplug_s=30.0
    )
    assert wire.any


def test_nothing_asked_is_nothing_wrong() -> None:
    device, wire = device_faults({}, 3, "twin.imu.fault")
    assert device == DeviceFaults()
    assert not wire.any
    assert wire.unplug_s == math.inf


def test_a_bench_file_turns_the_knobs_of_the_table_and_its_wire() -> None:
    assert table_faults({"axis": "x", "at": "5 s"}, ("z", "x"), "twin.fault") == (TableFault("x", 5.0), WireFaults())
    fault, wire = table_faults({"axis": "z", "at": "5 s", "kind": "servo", "loss": "1 %"}, ("z",), "twin.fault")
    assert fault == TableFault("z", 5.0, "servo")
    assert wire == WireFaults(loss=0.01)
    assert table_faults({"silent_from": "9 s"}, ("z",), "twin.fault") == (None, WireFaults(silent_from_s=9.0))


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"stuck": 4}, "twin.imu.fault.stuck: 4 is not the number of a gyro, 1 to 3"),
        ({"loss": "120 %"}, "loss: give 0 % to 100 %"),
        ({"loss": 0.1}, "twin.imu.fault.loss: 0.1 has no unit"),
        ({"latency": "5 deg"}, "does not measure the same as 's'"),
        ({"latency": "-5 ms"}, "latency: must be 0 or more"),
        ({"one_byte": "yes"}, "'yes' is not true or false"),
        ({"lattency": "5 ms"}, "did you mean latency"),
    ],
)
def test_a_knob_that_cannot_be_is_refused_by_name(table: dict[str, Any], words: str) -> None:
    with pytest.raises(HiddenError, match=words):
        device_faults(table, 3, "twin.imu.fault")


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"axis": "y", "at": "5 s"}, "the table has no axis y; it has z, x"),
        ({"axis": "x"}, "twin.fault: at is missing"),
        ({"axis": "x", "at": "5 s", "kind": "fire"}, "'fire' is not one of fault, limit, servo"),
    ],
)
def test_a_fault_of_the_table_that_cannot_be_is_refused_by_name(table: dict[str, Any], words: str) -> None:
    with pytest.raises(HiddenError, match=words):
        table_faults(table, ("z", "x"), "twin.fault")


def test_faults_strike_the_table() -> None:
    now = [0.0]
    table = TableModel({"x": AxisData(2.0, 4.0, 1000)}, lambda: now[0])
    table.motion["x"].jog(0.0, -1.0, 4.0)
    now[0] = 2.0
    TableFault("x", 2.0, "limit").strike(table, limits_trip=False)
    assert table.pressed == {"x": -1}
    now[0] = 4.0
    assert table.at_rest()
    TableFault("x", 2.0, "limit").strike(table, limits_trip=True)
    assert table.tripped == {"x": "limit switch"}
    TableFault("x", 2.0, "servo").strike(table, limits_trip=False)
    assert table.tripped == {"x": FOLLOWING_ERROR}
    TableFault("x", 2.0).strike(table, limits_trip=False)
    assert table.tripped == {"x": "fault input"}
