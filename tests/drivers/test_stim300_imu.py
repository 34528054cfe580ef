"""A STIM300 as a source: who it is, how it is set, and its rates in any unit, over a wire to its twin."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
from setups import imu_setup
from stim300_console import Stim300Utility
from wire_pair import pair

from drivers.errors import DeviceRefused, LinkLost
from drivers.imus.stim300.codec import encode_special
from drivers.imus.stim300.imu import Stim300Imu
from drivers.imus.stim300.special import Configuration
from drivers.links.memory_link import MemoryLink
from drivers.links.serial_link import SerialLink
from drivers.types import Identity, ImuBlock
from sims.imus.stim300 import Stim300Device
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.motion import AxisMotion
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.run.event_loop.loops import VirtualLoop

WHO = Identity("STIM300 84167-440000-3321 rev K", "N25582405002002", "0")
ACCELERATION_DPS2 = 40.0


def on_a_table(rate_hz: int) -> tuple[GyroArray, AxisMotion]:
    """Return a triad without errors on a table whose one axis may move."""
    motion = AxisMotion(0.0, 10.0, 10.0)
    body = Body(
        gimbals="z",
        angles=lambda _axis, t: motion.angles(t),
        revision=lambda: motion.revision,
        latitude_rad=0.0,
        heading_rad=0.0,
        earth_turns=False,
    )
    none = np.zeros(3)
    truth = GyroTruth(none, none, none, none, 0.0, 0.0, warming_c=0.0)
    return GyroArray(mounting=mounted(MOUNTS_DEG["triad"]), truth=truth, body=body, rate_hz=rate_hz, seed=(1,)), motion


@dataclass
class Wire:
    """A twin at the far end of a wire in memory."""

    device: Stim300Device
    near: MemoryLink
    motion: AxisMotion
    heard: bytes = b""
    deaf: set[bytes] = field(default_factory=set)
    """Commands that get lost on their way, once each."""


@asynccontextmanager
async def wired(rate_hz: int = 2000, **options: Any) -> AsyncIterator[Wire]:
    near, far = pair("imu")
    gyros, motion = on_a_table(rate_hz)
    ride = ImuTwinSetup(gyros=gyros, rate_hz=rate_hz, faults=options.pop("faults", NodeFaults()))
    wire = Wire(Stim300Device(ride, far.write, **options), near, motion)

    async def listen() -> None:
        while True:
            data = (await far.receive()).data
            wire.heard += data
            if data in wire.deaf:
                wire.deaf.discard(data)
            else:
                wire.device.received(data)

    tasks = [asyncio.ensure_future(wire.device.serve()), asyncio.ensure_future(listen())]
    try:
        yield wire
    finally:
        for task in tasks:
            task.cancel()


def virtually(scene: Callable[[], Coroutine[Any, Any, None]]) -> None:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(scene())


async def gathered(imu: Stim300Imu, seconds: float) -> list[ImuBlock]:
    blocks = []
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            async for _, block in imu.blocks():
                blocks.append(block)
    return blocks + [block for _, block in imu.flush()]


def joined(blocks: list[ImuBlock], name: str) -> np.ndarray:
    return np.concatenate([getattr(block, name) for block in blocks])


@pytest.mark.parametrize("options", [{}, {"line_termination": True}, {"cold": True}, {"identifier": 0xA5}])
def test_it_tells_who_it_is_and_no_sample_is_lost_by_asking(options: dict[str, Any]) -> None:
    async def scene() -> None:
        async with wired(1000, **options) as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 1000), wire.near)
            await asyncio.sleep(0.1)
            assert await imu.identify() == WHO
            blocks = await gathered(imu, 1.0)
            counts = imu.counts("imu")
            assert (counts.lost, counts.repeated, counts.corrupt) == (0, 0, 0)
            steps = np.diff(joined(blocks, "counter")) % 256 // 2
            # At power-on it has said it all; otherwise three answers stood in for samples.
            assert wire.heard == (b"C\r" if options.get("cold") else b"C\rI\rN\r")
            assert (steps - 1).sum() == wire.heard.count(b"\r")

    virtually(scene)


def test_samples_that_came_while_it_was_asked_are_kept() -> None:
    async def scene() -> None:
        async with wired() as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 2000), wire.near)
            await asyncio.sleep(0.5)
            await imu.identify()
            first = (await gathered(imu, 0.1))[0]
            assert first.arrival_ns[0] <= 0.02e9

    virtually(scene)


def test_a_lost_question_is_asked_again() -> None:
    async def scene() -> None:
        async with wired() as wire:
            wire.deaf = {b"C\r", b"I\r", b"N\r"}
            assert await Stim300Imu(imu_setup("stim300", "imu", 2000), wire.near).identify() == WHO
            assert wire.heard == b"C\rC\rI\rI\rN\rN\r"

    virtually(scene)


@pytest.mark.parametrize("streams", [True, False])
def test_a_device_that_does_not_answer_is_taken_as_it_is(streams: bool) -> None:
    async def scene() -> None:
        near, far = pair("imu")
        imu = Stim300Imu(imu_setup("stim300", "imu", 500, timeout_s=0.5), near)
        task = asyncio.ensure_future(
            Stim300Device(ImuTwinSetup(gyros=on_a_table(500)[0], rate_hz=500), far.write).serve()
        )
        if not streams:
            task.cancel()
        began = asyncio.get_running_loop().time()
        assert await imu.identify() == Identity()
        assert asyncio.get_running_loop().time() - began <= 1.1
        if streams:
            assert len(await gathered(imu, 1.0)) > 90
        task.cancel()

    virtually(scene)


def test_a_wire_that_is_pulled_while_it_is_asked_is_a_lost_link() -> None:
    async def scene() -> None:
        near, far = pair("imu")
        asyncio.get_running_loop().call_later(0.2, far.close)
        with pytest.raises(LinkLost):
            await Stim300Imu(imu_setup("stim300", "imu", 500), near).identify()

    virtually(scene)


@pytest.mark.parametrize(
    ("set_to", "bench", "words"),
    [
        ({"rate_hz": 500}, {}, "sends at 500 Hz, but the bench file says rate 2000 Hz.*m 4, then s"),
        ({"gyro_unit": "increment"}, {"gyro_unit": "rate"}, "gyro unit increment, but the bench file says rate.*u g,0"),
        ({"accel_range_g": 30, "identifier": 0x91}, {"accel_range": 10}, "accelerometers of 30 g.*says 10 g"),
    ],
)
def test_a_device_set_otherwise_than_the_bench_says_is_refused(
    set_to: dict[str, Any], bench: dict[str, Any], words: str
) -> None:
    async def scene() -> None:
        async with wired(**({"rate_hz": 2000} | set_to)) as wire:
            with pytest.raises(DeviceRefused, match=words):
                await Stim300Imu(imu_setup("stim300", "imu", 2000, **bench), wire.near).identify()

    virtually(scene)


def test_external_trigger_and_a_gyro_that_is_off_are_refused() -> None:
    async def scene(byte: int, value: int, words: str) -> None:
        near, far = pair("imu")
        data = bytearray(Configuration.of(rate_hz=2000).data)
        data[byte] = value
        far.write(encode_special(Configuration(bytes(data))))
        with pytest.raises(DeviceRefused, match=words):
            await Stim300Imu(imu_setup("stim300", "imu", 2000), near).identify()

    virtually(lambda: scene(2, 5 << 5, "external trigger"))
    virtually(lambda: scene(4, 0x50, "gyro y is switched off"))


@pytest.mark.parametrize("options", [{}, {"accel_range": 10}])
@pytest.mark.parametrize(("second", "words"), [(None, "10 g, unknown, 10 g"), (30, "10 g, 30 g, 10 g")])
def test_accelerometers_of_ranges_that_differ_are_refused(
    second: int | None, words: str, options: dict[str, Any]
) -> None:
    async def scene() -> None:
        near, far = pair("imu")
        data = bytearray(Configuration.of(rate_hz=2000, accelerometer=True).data)
        code = 0xF if second is None else Configuration.of(rate_hz=2000, accel_range_g=second).data[17] >> 4
        data[16] = data[16] & 0xF0 | code
        far.write(encode_special(Configuration(bytes(data))))
        with pytest.raises(DeviceRefused, match=f"accelerometers x, y, z have ranges of {words}"):
            await Stim300Imu(imu_setup("stim300", "imu", 2000, **options), near).identify()

    virtually(scene)


@pytest.mark.parametrize("rate_hz", [125, 2000])
@pytest.mark.parametrize("unit", ["rate", "increment", "average", "integrated"])
def test_every_gyro_unit_gives_the_rate_at_its_time(unit: str, rate_hz: int) -> None:
    async def scene() -> None:
        async with wired(rate_hz, gyro_unit=unit) as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", rate_hz), wire.near)
            await imu.identify()
            await gathered(imu, 1.0)
            turning = asyncio.get_running_loop().time()
            wire.motion.jog(turning, 8.0, np.radians(ACCELERATION_DPS2))
            blocks = await gathered(imu, 3.0)
            t_s, rate = joined(blocks, "t_ns") * 1e-9, np.degrees(joined(blocks, "rate_rps"))
            speeding_up = t_s > turning + 0.05
            assert np.isfinite(rate[speeding_up]).all()
            expected = ACCELERATION_DPS2 * (t_s[speeding_up] - turning)
            seen = np.linalg.norm(rate[speeding_up], axis=1)
            # Increments have steps of 2^-21 deg: at 2 kHz, of 1 mdeg/s; at 125 Hz a mean is that of its middle.
            np.testing.assert_allclose(seen, expected, atol=3e-3)

    virtually(scene)


def test_an_integral_over_a_gap_is_not_guessed() -> None:
    async def scene() -> None:
        async with wired(500, gyro_unit="integrated") as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 500), wire.near)
            await imu.identify()
            await gathered(imu, 0.5)
            wire.device.faults.dropped = 0.1
            blocks = await gathered(imu, 2.0)
            missing = np.diff(joined(blocks, "counter")) % 256 != 4
            assert missing.sum() > 50
            np.testing.assert_array_equal(np.isnan(joined(blocks, "rate_rps")[1:]).all(axis=1), missing)
            assert imu.counts("imu").lost == wire.device.dropped

    virtually(scene)


def test_the_accelerometer_range_is_the_devices_own() -> None:
    async def scene() -> None:
        async with wired(1000, identifier=0xA7 - 2, accel_range_g=5) as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 1000), wire.near)
            await imu.identify()
            blocks = await gathered(imu, 0.2)
            np.testing.assert_allclose(joined(blocks, "accel_mps2")[-1], [0, 0, 9.80665], atol=1e-4)
            np.testing.assert_allclose(joined(blocks, "temperature_c"), 25.0, atol=0.01)

    virtually(scene)


def test_what_the_device_calls_invalid_is_no_number() -> None:
    async def scene() -> None:
        async with wired(1000, cold=True, identifier=0xA5) as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 1000), wire.near)
            await imu.identify()
            blocks = await gathered(imu, 1.0)
            valid = np.isfinite(joined(blocks, "rate_rps")).all(axis=1)
            assert not valid[:490].any()
            assert valid[500:].all()
            np.testing.assert_array_equal(np.isfinite(joined(blocks, "accel_mps2")).all(axis=1), valid)
            np.testing.assert_array_equal(np.isfinite(joined(blocks, "temperature_c")), valid)
            wire.device.overload_gyro = 1
            await gathered(imu, 0.1)
            assert np.isnan(joined(await gathered(imu, 0.1), "rate_rps")).any(axis=0).tolist() == [False, True, False]

    virtually(scene)


def test_bytes_that_come_one_by_one_still_make_blocks_of_ten_milliseconds() -> None:
    async def scene() -> None:
        near, far = pair("imu")

        def drip(data: bytes) -> None:
            for i in range(len(data)):
                far.write(data[i : i + 1])

        device = Stim300Device(ImuTwinSetup(gyros=on_a_table(2000)[0], rate_hz=2000), drip)
        task = asyncio.ensure_future(device.serve())
        blocks = await gathered(Stim300Imu(imu_setup("stim300", "imu", 2000), near), 1.0)
        task.cancel()
        assert len(joined(blocks, "counter")) == pytest.approx(2000, abs=20)
        assert len(blocks) < 150

    virtually(scene)


def test_sample_times_follow_a_clock_that_drifts() -> None:
    async def scene() -> None:
        async with wired(125, faults=NodeFaults(clock_ppm=50.0)) as wire:
            imu = Stim300Imu(imu_setup("stim300", "imu", 125), wire.near)
            await imu.identify()
            await gathered(imu, 12.0)
            blocks = await gathered(imu, 12.0)
            t_ns = joined(blocks, "t_ns").astype(float)
            assert (t_ns[-1] - t_ns[0]) / (len(t_ns) - 1) * 125e-9 == pytest.approx(1 - 50e-6, abs=5e-6)

    virtually(scene)


def test_utility_mode_identifies_sets_and_refuses() -> None:
    async def scene() -> None:
        async with wired(500) as wire:
            wire.deaf = {b"UTILITYMODE\r"}
            async with Stim300Utility("imu", wire.near) as utility:
                assert await utility.identify() == Identity(
                    "STIM300 84167-440000-3321 rev K", "N25582405002002", "SWD12404 REV 0"
                )
                with pytest.raises(DeviceRefused, match="sm refused with status 5: a parameter is outside"):
                    await utility.ask("sm", 9)
                with pytest.raises(DeviceRefused, match="status 3: the device does not know"):
                    await utility.ask("what")
                await utility.set_rate(2000)
                await utility.set_gyro_unit("integrated")
                await utility.set_datagram(0x91)
                assert await utility.save() == 9957
            imu = Stim300Imu(imu_setup("stim300", "imu", 2000, gyro_unit="integrated"), wire.near)
            assert (await imu.identify()).serial == "N25582405002002"
            blocks = await gathered(imu, 0.5)
            assert len(joined(blocks, "counter")) == pytest.approx(1000, abs=60)
            assert blocks[-1].accel_mps2 is not None

    virtually(scene)


def test_a_device_without_a_voice_is_a_lost_link() -> None:
    async def scene() -> None:
        near, far = pair("imu")
        task = asyncio.ensure_future(
            Stim300Device(ImuTwinSetup(gyros=on_a_table(500)[0], rate_hz=500), far.write).serve()
        )
        with pytest.raises(LinkLost, match="is it powered, and sending samples"):
            async with Stim300Utility("imu", near):
                pass
        task.cancel()

    virtually(scene)


def test_over_a_pseudo_terminal_it_names_itself_and_streams() -> None:
    async def scene() -> None:
        ours, theirs = os.openpty()
        tty.setraw(ours)
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        loop = asyncio.get_running_loop()
        device = Stim300Device(
            ImuTwinSetup(gyros=on_a_table(2000)[0], rate_hz=2000), lambda data: void(os.write(ours, data))
        )
        loop.add_reader(ours, lambda: device.received(os.read(ours, 1000)))
        task = asyncio.ensure_future(device.serve())
        link = SerialLink("imu", os.ttyname(theirs), 921600)
        imu = Stim300Imu(imu_setup("stim300", "imu", 2000), link)
        try:
            await imu.open()
            assert await imu.identify() == WHO
            blocks = await gathered(imu, 0.5)
            assert len(joined(blocks, "counter")) > 900
            assert imu.counts("imu").lost == 0
        finally:
            imu.close()
            task.cancel()
            loop.remove_reader(ours)
            os.close(ours)
            os.close(theirs)

    asyncio.run(scene())


def void(_: int) -> None:
    """Take a result that nobody wants."""
