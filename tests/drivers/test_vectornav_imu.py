"""A VectorNav as a source: its identity, its samples and their times, and lines and devices that misbehave."""

from __future__ import annotations

import asyncio
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from setups import imu_setup
from wire_pair import pair

from drivers.errors import BadReply, DeviceFault, DeviceRefused, LinkLost
from drivers.imus.vectornav.codec import Sentence, encode_sentence
from drivers.imus.vectornav.imu import VectorNavImu
from drivers.links.memory_link import MemoryLink
from drivers.types import Identity, ImuBlock
from sims.imus.vectornav import VectorNavDevice
from sims.physics.body import Body
from sims.physics.geometry import along
from sims.physics.gyro import GyroArray, GyroTruth
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.run.event_loop.loops import VirtualLoop

SLOPE_RPS2 = 0.05
"""The body turns about z at a rate that grows by this, so a rate tells when it was measured."""
ON_SINCE_NS = 30_000_000_000
TICK_NS = 1_250_000
IDENTITY = Identity("VN-100S-CR, hardware 7", "0100012345", "2.1.0.0")


def gyros(rate_hz: float) -> GyroArray:
    body = Body(
        gimbals="z",
        angles=lambda _axis, t: SLOPE_RPS2 * t**2 / 2,
        revision=lambda: 0,
        latitude_rad=0.0,
        heading_rad=0.0,
        earth_turns=False,
    )
    none = np.zeros(3)
    truth = GyroTruth(none, none, none, none, 0.0, 0.0)
    return GyroArray(
        mounting=along([[1, 0, 0], [0, 1, 0], [0, 0, 1]]), truth=truth, body=body, rate_hz=rate_hz, seed=(1,)
    )


@dataclass
class Bench:
    """A source, its twin, and the twin's end of the wire, on which tests may speak for it."""

    imu: VectorNavImu
    device: VectorNavDevice
    far: MemoryLink


@asynccontextmanager
async def bench(
    rate_hz: float = 100,
    output: Any = "binary",
    *,
    wire: Callable[[bytes, Callable[[bytes], None]], None] = lambda data, write: write(data),
    to_device: Callable[[bytes], bytes] = lambda data: data,
    serial_port: int = 1,
    **twin: Any,
) -> AsyncIterator[Bench]:
    """Join a source to its twin; ``wire`` hands on what the twin sends, ``to_device`` what it is sent."""
    near, far = pair("imu")
    ride = ImuTwinSetup(
        gyros=gyros(rate_hz), rate_hz=rate_hz, up=twin.pop("up", None), faults=twin.pop("faults", NodeFaults())
    )
    device = VectorNavDevice(ride, lambda data: wire(data, far.write), **twin)

    async def hear() -> None:
        while True:
            device.received(to_device((await far.receive()).data))

    tasks = [asyncio.ensure_future(hear()), asyncio.ensure_future(device.serve())]
    imu = VectorNavImu(imu_setup("vectornav", "imu", rate_hz, 0.25, output=output, serial_port=serial_port), near)
    await imu.open()
    try:
        yield Bench(imu, device, far)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await main()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


async def sampled(imu: VectorNavImu, duration_s: float) -> ImuBlock:
    """Return all samples of a while as one block."""
    found: list[ImuBlock] = []
    try:
        async with asyncio.timeout(duration_s):
            async for name, block in imu.blocks():
                assert name == "imu"
                found.append(block)
    except TimeoutError:
        found += [block for _, block in imu.flush()]

    def joined(name: str) -> Any:
        parts = [getattr(block, name) for block in found]
        return None if parts[0] is None else np.concatenate(parts)

    names = ("t_ns", "arrival_ns", "rate_rps", "temperature_c", "counter", "accel_mps2")
    return ImuBlock(*(joined(name) for name in names))


def true_s(block: ImuBlock) -> np.ndarray:
    return block.rate_rps[:, 2] / SLOPE_RPS2


def rms_s(block: ImuBlock, after_s: float) -> float:
    """Return how wrong the times are, once the fit has settled."""
    late = block.t_ns * 1e-9 > after_s
    return float(np.sqrt(np.mean((block.t_ns[late] * 1e-9 - true_s(block)[late]) ** 2)))


def test_it_says_what_it_is_while_it_streams_what_it_was_set_to_before() -> None:
    async def main() -> None:
        async with bench() as b:
            await asyncio.sleep(0.5)
            assert await b.imu.identify() == IDENTITY

    virtually(main)


@pytest.mark.parametrize(("output", "rate_hz"), [("binary", 800), ("binary", 50), ("ascii", 200), ("ascii", 25)])
def test_samples_are_those_of_the_twin_at_their_times(output: Any, rate_hz: int) -> None:
    async def main() -> None:
        async with bench(rate_hz, output, up=lambda t: np.tile([0.6, 0.0, 0.8], (len(t), 1))) as b:
            await b.imu.identify()
            await asyncio.sleep(1.0)
            block = await sampled(b.imu, 4.0)
            n = len(block.t_ns)
            assert 4.0 * rate_hz - 10 - 0.05 * rate_hz < n <= 4.0 * rate_hz
            np.testing.assert_allclose(np.diff(block.t_ns), 1e9 / rate_hz, atol=2)
            np.testing.assert_allclose(true_s(block), block.t_ns * 1e-9, atol=3e-5)
            np.testing.assert_allclose(block.rate_rps[:, :2], 0.0, atol=1e-6)
            assert block.accel_mps2 is not None
            np.testing.assert_allclose(block.accel_mps2, n * [[0.6 * 9.80665, 0.0, 0.8 * 9.80665]], atol=6e-4)
            np.testing.assert_allclose(block.temperature_c, 25.0, atol=0.1)
            counts = b.imu.counts("imu")
            assert (counts.samples, counts.lost, counts.repeated, counts.corrupt) == (n, 0, 0, 0)
            if output == "binary":
                assert block.counter is not None
                np.testing.assert_allclose((block.counter - ON_SINCE_NS) * 1e-9, true_s(block), atol=1e-6)

    virtually(main)


@pytest.mark.parametrize(
    ("output", "jitter_s", "loss", "limit_s"),
    [
        ("binary", 5e-3, 0.01, 0.2e-3),
        ("ascii", 5e-3, 0.0, 1e-3),
        pytest.param("ascii", 2e-3, 0.01, 1e-3, marks=pytest.mark.full),
    ],
)
def test_times_hold_with_drift_jitter_and_loss(output: Any, jitter_s: float, loss: float, limit_s: float) -> None:
    jitter = random.Random(3)
    free_at = [0.0]

    def late(data: bytes, write: Callable[[bytes], None]) -> None:
        loop = asyncio.get_running_loop()
        free_at[0] = max(free_at[0], loop.time() + abs(jitter.gauss(0.0, jitter_s)))
        loop.call_at(free_at[0], write, data)

    async def main() -> None:
        async with bench(100, output, wire=late, faults=NodeFaults(clock_ppm=50.0)) as b:
            b.device.faults.dropped = loss
            block = await sampled(b.imu, 40.0)
            assert rms_s(block, after_s=15.0) < limit_s
            counts = b.imu.counts("imu")
            assert counts.samples == len(block.t_ns)
            index = np.round(true_s(block) * 100 * (1 + 50e-6)).astype(int)
            assert counts.lost == index[-1] - index[0] + 1 - len(index)
            assert (counts.lost > 20) == (loss > 0)

    virtually(main)


@pytest.mark.parametrize("output", ["binary", "ascii"])
def test_doubled_samples_are_given_once_and_counted(output: Any) -> None:
    async def main() -> None:
        async with bench(100, output) as b:
            b.device.faults.doubled = 0.02
            block = await sampled(b.imu, 15.0)
            # Of the last ones, without a stamp, nobody can tell yet.
            assert (np.diff(true_s(block))[:-40] > 0).all()
            counts = b.imu.counts("imu")
            assert counts.lost == 0
            assert 10 < counts.repeated < 60

    virtually(main)


def test_a_burst_that_comes_again_is_repeats() -> None:
    async def main() -> None:
        sent: list[bytes] = []

        def twice(data: bytes, write: Callable[[bytes], None]) -> None:
            sent.append(data)
            write(data)
            if len(sent) == 100:
                write(b"".join(sent[90:]))

        async with bench(800, wire=twice) as b:
            block = await sampled(b.imu, 3.0)
            assert (np.diff(block.t_ns) > 0).all()
            counts = b.imu.counts("imu")
            assert (counts.lost, counts.repeated) == (0, 80)

    virtually(main)


def test_stuck_and_saturated_gyros_show() -> None:
    async def main() -> None:
        async with bench() as b:
            b.device.range_rps = 0.11
            task = asyncio.get_running_loop().call_later(1.0, b.device.faults.stuck.add, 2)
            block = await sampled(b.imu, 2.0)
            assert len(np.unique(block.rate_rps[-90:, 2])) == 1
            b.device.faults.stuck.clear()
            block = await sampled(b.imu, 2.0)
            assert block.rate_rps.max() == np.float32(0.11)
            task.cancel()

    virtually(main)


def test_a_baud_rate_too_low_is_refused_in_words() -> None:
    async def main() -> None:
        async with bench(800, baud=115200) as b:
            with pytest.raises(DeviceRefused, match=r"imu: .*VNWRG,75.* error 12 .*lower the rate, or raise the baud"):
                await sampled(b.imu, 1.0)

    virtually(main)


def test_output_at_the_other_port_is_not_heard() -> None:
    async def main() -> None:
        async with bench(serial_port=2) as b:
            with pytest.raises(TimeoutError):
                async with asyncio.timeout(2.0):
                    await anext(b.imu.blocks())

    virtually(main)


@pytest.mark.parametrize("unplug", [False, True])
def test_a_dead_device_is_known_within_half_a_second(unplug: bool) -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        async with bench(wire=lambda data, write: None) as b:
            if unplug:
                b.far.close()
            began = loop.time()
            with pytest.raises(LinkLost, match="unplugged" if unplug else "no reply to VNASY,0 within 0.5 s"):
                await b.imu.identify()
            assert loop.time() - began <= 0.5

    virtually(main)


def test_a_link_that_ends_while_it_streams_is_lost() -> None:
    async def main() -> None:
        async with bench() as b:
            asyncio.get_running_loop().call_later(1.0, b.far.close)
            with pytest.raises(LinkLost):
                await sampled(b.imu, 3.0)

    virtually(main)


@pytest.mark.parametrize("delay_s", [0.1, 0.26, 0.3, 0.4, 0.49])
def test_a_late_reply_is_never_taken_for_the_next(delay_s: float) -> None:
    def late(data: bytes, write: Callable[[bytes], None]) -> None:
        asyncio.get_running_loop().call_later(delay_s, write, data)

    async def main() -> None:
        async with bench(wire=late) as b:
            assert await b.imu.identify() == IDENTITY
            block = await sampled(b.imu, 10.0)
            np.testing.assert_allclose(np.diff(block.t_ns), 1e7, atol=2)

    virtually(main)


def test_a_late_refusal_is_not_taken_for_the_next_command() -> None:
    """Every error comes late, so the refused command is sent twice and refused twice."""

    def late_errors(data: bytes, write: Callable[[bytes], None]) -> None:
        delay_s = 0.3 if data.startswith(b"$VNERR") else 0.0
        asyncio.get_running_loop().call_later(delay_s, write, data)

    async def main() -> None:
        async with bench(800, baud=115200, wire=late_errors) as b:
            with pytest.raises(DeviceRefused, match="VNWRG,75"):
                await b.imu.configure()
            assert await b.imu.identify() == IDENTITY

    virtually(main)


@pytest.mark.parametrize("towards_device", [False, True])
def test_a_damaged_command_or_reply_is_tried_again(towards_device: bool) -> None:
    seen = [0]

    def damaged(data: bytes) -> bytes:
        if not data.startswith((b"$VNRRG", b"$VNWRG")):
            return data
        seen[0] += 1
        return data.replace(b"RG,", b"RG.") if seen[0] % 3 == 0 else data

    async def main() -> None:
        there = {"to_device": damaged}
        back = {"wire": lambda data, write: write(damaged(data))}
        async with bench(**(there if towards_device else back)) as b:
            assert await b.imu.identify() == IDENTITY
            assert len((await sampled(b.imu, 8.0)).t_ns) > 400
            # Of the device's complaints about damaged commands the sentences were whole.
            assert (b.imu.counts("imu").corrupt == 0) == towards_device

    virtually(main)


def test_a_device_that_hears_only_damage_is_a_bad_reply() -> None:
    async def main() -> None:
        async with bench(to_device=lambda data: data.replace(b"ASY", b"ASZ")) as b:
            with pytest.raises(BadReply, match="to VNASY,0 it answered VNERR,03"):
                await b.imu.identify()

    virtually(main)


def test_a_reply_behind_the_beginning_of_a_frame_is_found() -> None:
    def begun(data: bytes, write: Callable[[bytes], None]) -> None:
        write(b"\xfa\x05\x01\x00\x1c\x00" + data if data.startswith(b"$VNRRG") else data)

    async def main() -> None:
        async with bench(wire=begun) as b:
            assert await b.imu.identify() == IDENTITY

    virtually(main)


@pytest.mark.parametrize(("code", "text"), [("01", "hard fault"), ("0A", "restarted by its watchdog")])
@pytest.mark.parametrize("while_it_streams", [False, True])
def test_a_fault_that_it_reports_is_its_own(code: str, text: str, while_it_streams: bool) -> None:
    async def main() -> None:
        async with bench() as b:
            error = encode_sentence(Sentence("VNERR", (code,)))
            asyncio.get_running_loop().call_later(1.0 if while_it_streams else 0.0, b.far.write, error)
            with pytest.raises(DeviceFault, match=rf"imu: it reports error \d+ \({text}\)"):
                await (sampled(b.imu, 3.0) if while_it_streams else b.imu.identify())

    virtually(main)


def test_errors_that_no_command_causes_are_no_answers() -> None:
    async def main() -> None:
        async with bench() as b:
            for code in ("02", "0B", "FF"):
                b.far.write(encode_sentence(Sentence("VNERR", (code,))))
            assert await b.imu.identify() == IDENTITY

    virtually(main)


def test_a_device_that_restarts_while_it_streams_has_a_fault() -> None:
    async def main() -> None:
        async with bench() as b:

            def restart() -> None:
                b.device.received(b"$VNWNV*57\r\n$VNRST*4D\r\n")

            asyncio.get_running_loop().call_later(1.0, restart)
            with pytest.raises(DeviceFault, match="it has restarted"):
                await sampled(b.imu, 3.0)
            block = await sampled(b.imu, 3.0)  # a new try sets it up anew
            np.testing.assert_allclose(np.diff(block.t_ns), 1e7, atol=2)

    virtually(main)


def test_a_sentence_of_something_else_is_counted() -> None:
    async def main() -> None:
        async with bench(output="ascii") as b:
            for fields in (("1",), ("a",) * 11):
                asyncio.get_running_loop().call_later(1.0, b.far.write, encode_sentence(Sentence("VNIMU", fields)))
            await sampled(b.imu, 2.0)
            assert b.imu.counts("imu").corrupt == 2

    virtually(main)


def test_a_noisy_line_costs_samples_and_nothing_else() -> None:
    noise = random.Random(7)

    def flips(data: bytes, write: Callable[[bytes], None]) -> None:
        if noise.random() < 0.05 and data[:1] == b"\xfa":
            at = noise.randrange(len(data))
            data = data[:at] + bytes([data[at] ^ 1 << noise.randrange(8)]) + data[at + 1 :]
        for start in range(0, len(data), 7):
            write(data[start : start + 7])

    async def main() -> None:
        async with bench(200, wire=flips) as b:
            block = await sampled(b.imu, 10.0)
            assert rms_s(block, after_s=0.1) < 1e-6
            counts = b.imu.counts("imu")
            assert counts.samples + counts.lost == pytest.approx(2000, abs=5)
            assert 25 < counts.lost < 150
            assert counts.corrupt > 25

    virtually(main)


def test_how_it_is_set_beside_its_output_is_told_as_far_as_its_firmware_knows() -> None:
    async def main() -> None:
        async with bench() as b:
            before = await b.imu.identify()
            b.device.received(encode_sentence(Sentence("VNWRG", ("85", *"0040003000"))))
            after = await b.imu.identify()
            assert after == before  # the same device
            assert before.settings.endswith("register 85 at 0,4,4,4,0,0,3,3,3,0")
            assert after.settings == before.settings.replace("0,4,4,4,0,0,3,3,3,0", "0,0,4,0,0,0,3,0,0,0")
        unknown = encode_sentence(Sentence("VNRRG", ("99",)))
        older = encode_sentence(Sentence("VNRRG", ("85",)))
        async with bench(to_device=lambda data: data.replace(older, unknown)) as b:
            assert (await b.imu.identify()).settings == before.settings.partition("; register 85")[0]

    virtually(main)
