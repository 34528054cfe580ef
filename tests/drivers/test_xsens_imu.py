"""An Xsens MTi: the driver against the twin, a real capture and hand-written answers, in memory and virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from setups import imu_setup
from wire_pair import pair

from drivers.errors import BadReply, DeviceError, DeviceFault, DeviceRefused, LinkLost
from drivers.imus.xsens.imu import XsensImu
from drivers.imus.xsens.mtdata2 import (
    ACCELERATION,
    EVERY,
    PACKET_COUNTER,
    RATE_OF_TURN,
    RATE_OF_TURN_HR,
    SAMPLE_TIME_FINE,
    TEMPERATURE,
    Output,
    decode_outputs,
    encode_mtdata2,
    encode_outputs,
)
from drivers.imus.xsens.xbus import Mid, XbusDecoder, encode
from drivers.links.memory_link import MemoryLink
from drivers.types import Identity, ImuBlock, SourceCounts
from sims.imus.xsens import XsensDevice
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.motion import AxisMotion
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.run.event_loop.loops import VirtualLoop

CAPTURE = Path(__file__).parents[1] / "data" / "xsens" / "capture1.bin"
DEG = np.pi / 180
ACK = 1
Write = Callable[[bytes], None]


def virtually(main: Coroutine[Any, Any, Any]) -> Any:
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main)


class Table:
    """A table that turns about z, with a triad of silent gyros on it."""

    def __init__(self) -> None:
        self.motion = AxisMotion(0.0, 10.0, 10.0)
        self.body = Body(
            gimbals="z",
            angles=lambda _axis, t: self.motion.angles(t),
            revision=lambda: self.motion.revision,
            latitude_rad=0.8,
            heading_rad=0.0,
        )

    def gyros(self, rate_hz: float) -> GyroArray:
        zeros = np.zeros(3)
        truth = GyroTruth(zeros, zeros, zeros, zeros, 0.0, 0.0)
        return GyroArray(mounting=mounted(MOUNTS_DEG["triad"]), truth=truth, body=self.body, rate_hz=rate_hz, seed=(1,))


@dataclass
class Taken:
    """What a source delivered until its end."""

    t_s: np.ndarray
    arrival_s: np.ndarray
    rate: np.ndarray
    temperature: np.ndarray
    counter: np.ndarray
    accel: np.ndarray | None
    sizes: list[int]
    counts: SourceCounts
    ended: DeviceError


def joined(blocks: list[ImuBlock], counts: SourceCounts, ended: DeviceError) -> Taken:
    def of(name: str) -> Any:
        return np.concatenate([getattr(block, name) for block in blocks])

    if not blocks:
        empty = np.empty(0)
        return Taken(empty, empty, empty, empty, empty, None, [], counts, ended)
    accel = None if blocks[0].accel_mps2 is None else of("accel_mps2")
    sizes = [len(block.t_ns) for block in blocks]
    return Taken(
        of("t_ns") * 1e-9,
        of("arrival_ns") * 1e-9,
        of("rate_rps"),
        of("temperature_c"),
        of("counter"),
        accel,
        sizes,
        counts,
        ended,
    )


async def take(imu: XsensImu, far: MemoryLink, duration_s: float) -> Taken:
    """Read blocks until the wire is unplugged after some time, or the source gives up."""
    found: list[ImuBlock] = []

    async def read() -> None:
        async for name, block in imu.blocks():
            assert name == "mti"
            found.append(block)

    asyncio.get_running_loop().call_later(duration_s, far.close)
    with pytest.raises(DeviceError) as ended:
        await read()
    found += [block for _, block in imu.flush()]
    return joined(found, imu.counts("mti"), ended.value)


async def listen(far: MemoryLink, received: Callable[[bytes], None]) -> None:
    with suppress(LinkLost):
        while True:
            received((await far.receive()).data)


def with_twin(
    rate_hz: int = 100,
    twin_hz: int | None = None,
    duration_s: float = 3.0,
    *,
    prepare: Callable[[XsensDevice, Table], None] = lambda device, table: None,
    delay_s: Callable[[], float] = lambda: 0.0,
    identify: bool = True,
    options: dict[str, Any] | None = None,
    accelerometer: bool = True,
    **twin: Any,
) -> tuple[Identity, Taken, XsensDevice]:
    """Run a source at a twin; return its identity, what it delivered, and the twin."""

    async def main() -> tuple[Identity, Taken, XsensDevice]:
        loop = asyncio.get_running_loop()
        near, far = pair("mti")
        table = Table()
        due = [0.0]

        def write(data: bytes) -> None:
            due[0] = max(due[0] + 1e-9, loop.time() + delay_s())  # a wire keeps the order
            loop.call_at(due[0], far.write, data)

        force = table.body.up if accelerometer else None
        own_hz = twin_hz or rate_hz
        ride = ImuTwinSetup(
            gyros=table.gyros(own_hz), rate_hz=own_hz, up=force, faults=twin.pop("faults", NodeFaults())
        )
        device = XsensDevice(ride, write, **twin)
        prepare(device, table)
        imu = XsensImu(imu_setup("xsens", "mti", rate_hz, **(options or {})), near)
        tasks = [loop.create_task(device.serve()), loop.create_task(listen(far, device.received))]
        await imu.open()
        identity = await imu.identify() if identify else Identity()
        taken = await take(imu, far, duration_s)
        imu.close()
        for task in tasks:
            task.cancel()
        return identity, taken, device

    return virtually(main())


def with_peer(
    answer: Callable[[int, bytes, Write], None],
    act: Callable[[XsensImu], Coroutine[Any, Any, Any]],
    **options: Any,
) -> tuple[Any, float, list[tuple[int, bytes]]]:
    """Let ``answer`` stand for the device; return what ``act`` does, how long it took, and the requests."""

    async def main() -> tuple[Any, float, list[tuple[int, bytes]]]:
        loop = asyncio.get_running_loop()
        near, far = pair("mti")
        decoder, requests = XbusDecoder(), []

        def received(data: bytes) -> None:
            for messages in decoder.feed(data):
                for request in messages.each():
                    requests.append((messages.mid, request))
                    answer(messages.mid, request, far.write)

        task = loop.create_task(listen(far, received))
        imu = XsensImu(imu_setup("xsens", "mti", 100, **options), near)
        await imu.open()
        try:
            result = await act(imu)
        except DeviceError as error:
            result = error
        took = loop.time()
        imu.close()
        task.cancel()
        return result, took, requests

    return virtually(main())


def willing(mid: int, request: bytes, write: Write) -> None:
    """Answer as a device that grants everything."""
    write(encode(mid + ACK, request))


def from_bytes(parts: list[tuple[float, bytes]], rate_hz: float = 100) -> Taken:
    """Let a source listen to these bytes, each part at its instant (s)."""

    async def main() -> Taken:
        loop = asyncio.get_running_loop()
        near, far = pair("mti")
        imu = XsensImu(imu_setup("xsens", "mti", rate_hz, configure=False), near)
        await imu.open()
        for at, together in groupby(parts, key=lambda part: part[0]):
            loop.call_at(at, far.write, b"".join(data for _, data in together))
        taken = await take(imu, far, parts[-1][0] + 1.0)
        imu.close()
        return taken

    return virtually(main())


def sample(ticks: int, rate: tuple[float, ...] = (0.1, 0.2, 0.3), kind: int = RATE_OF_TURN) -> bytes:
    return encode_mtdata2([(SAMPLE_TIME_FINE, np.array([[ticks % 2**32]])), (kind, np.array([rate]))])


def stream(count: int, first: int = 5000, start_s: float = 0.1) -> list[tuple[float, bytes]]:
    return [(start_s + i / 100, sample(first + 100 * i)) for i in range(count)]


def test_the_device_says_who_it_is() -> None:
    identity, _, device = with_twin(serial="0370ABCD", product="MTI-630-8A1G6", duration_s=0.1)
    assert identity == Identity("MTI-630-8A1G6", "0370ABCD", "1.8.2 build 37")


@pytest.mark.parametrize(("number_format", "resolution"), [(0, 1e-6), (1, 2.0**-20), (2, 1e-9), (3, 1e-15)])
def test_rate_acceleration_and_temperature_come_in_every_number_format(number_format: int, resolution: float) -> None:
    table: list[Table] = []

    def turn(device: XsensDevice, its: Table) -> None:
        table.append(its)
        its.motion.jog(0.0, 0.5, 2.0)

    _, taken, device = with_twin(prepare=turn, options={"number_format": number_format})
    assert device.outputs[2:] == tuple(
        Output(kind | number_format, 100) for kind in (RATE_OF_TURN, ACCELERATION, TEMPERATURE)
    )
    wanted = table[0].body.rate_rps(taken.t_s)
    np.testing.assert_allclose(taken.rate[60:], wanted[60:], atol=resolution)
    assert taken.accel is not None
    np.testing.assert_allclose(taken.accel, [[0, 0, 9.80665]] * len(taken.t_s), atol=max(resolution, 1e-9) * 10)
    np.testing.assert_allclose(taken.temperature, 25, atol=0.1)
    assert isinstance(taken.ended, LinkLost)
    assert "unplugged" in str(taken.ended)


@pytest.mark.parametrize("rate_hz", [10, 100, 400, 1000, 2000])
def test_blocks_hold_about_ten_milliseconds_and_none_is_lost(rate_hz: int) -> None:
    _, taken, _ = with_twin(rate_hz)
    assert set(taken.sizes[1:-1]) == {max(rate_hz // 100, 1)}
    assert taken.counts == SourceCounts(samples=len(taken.t_s))
    assert len(taken.t_s) >= 2.9 * rate_hz
    np.testing.assert_allclose(np.diff(taken.t_s), 1 / rate_hz, atol=1e-9)


def test_the_time_of_a_sample_is_when_it_was_taken_not_when_it_came() -> None:
    _, taken, _ = with_twin(1000, identify=False)  # ten come together; the last of them has not waited
    index = np.round(taken.t_s * 1000)
    np.testing.assert_allclose(taken.t_s, index / 1000, atol=1e-7)
    assert (taken.arrival_s - taken.t_s).max() == pytest.approx(0.009, abs=1e-6)


@pytest.mark.parametrize(("rate_hz", "clock_ppm"), [pytest.param(100, 50.0, marks=pytest.mark.full), (400, -50.0)])
def test_times_are_true_to_a_fifth_of_a_millisecond_on_a_bad_line(rate_hz: int, clock_ppm: float) -> None:
    rng = np.random.default_rng(3)

    def lossy(device: XsensDevice, table: Table) -> None:
        device.faults.dropped = 0.01

    wraps_after = 20 * 10_000
    _, taken, device = with_twin(
        rate_hz,
        duration_s=40.0,
        prepare=lossy,
        delay_s=lambda: abs(rng.normal(0, 0.005)),
        identify=False,
        faults=NodeFaults(clock_ppm=clock_ppm),
        uptime_ticks=2**32 - wraps_after,
    )
    index = np.round(((taken.counter + wraps_after) % 2**32) * rate_hz / 10_000)
    true_s = index / (rate_hz * (1 + clock_ppm * 1e-6))
    settled = true_s > 5
    assert np.sqrt(np.mean((taken.t_s - true_s)[settled] ** 2)) < 2e-4
    assert taken.counter.min() < 10_000 < 2**31 < taken.counter.max()
    span = int(index[-1] - index[0]) + 1
    assert taken.counts.samples + taken.counts.lost == span
    assert 0.005 < taken.counts.lost / span < 0.015
    assert (taken.counts.repeated, taken.counts.corrupt) == (0, 0)


def test_doubled_samples_are_counted_and_left_out() -> None:
    def double(device: XsensDevice, table: Table) -> None:
        device.faults.doubled = 0.1

    _, taken, _ = with_twin(400, prepare=double)
    assert taken.counts.repeated > 50
    assert taken.counts.samples == len(taken.t_s)
    assert (taken.counts.lost, taken.counts.corrupt) == (0, 0)
    np.testing.assert_allclose(np.diff(taken.t_s), 1 / 400, atol=1e-9)


def test_a_device_without_accelerometers_gives_none() -> None:
    _, taken, _ = with_twin(accelerometer=False)
    assert taken.accel is None
    assert len(taken.t_s) > 240  # half a second is spent on waiting for an answer that grants more


def test_a_source_may_be_started_again() -> None:
    async def main() -> None:
        loop = asyncio.get_running_loop()
        near, far = pair("mti")
        device = XsensDevice(ImuTwinSetup(gyros=Table().gyros(100), rate_hz=100), far.write)
        tasks = [loop.create_task(device.serve()), loop.create_task(listen(far, device.received))]
        imu = XsensImu(imu_setup("xsens", "mti", 100), near)
        await imu.open()
        for _ in range(2):
            found = []
            async for _, block in imu.blocks():
                found.append(block)
                if len(found) == 50:
                    break
            t_s = np.concatenate([block.t_ns for block in found]) * 1e-9
            np.testing.assert_allclose(np.diff(t_s), 0.01, atol=1e-9)
            device.restart()
            await asyncio.sleep(5.0)
        for task in tasks:
            task.cancel()

    virtually(main())


def test_a_rate_that_the_device_does_not_have_is_refused_with_what_to_do() -> None:
    _, taken, _ = with_twin(1000, twin_hz=400)
    assert isinstance(taken.ended, DeviceRefused)
    assert str(taken.ended) == (
        "mti: it provides RateOfTurn(Float32) at 400 Hz instead of 1000 Hz. "
        "Set the rate in the bench file to one that the device supports"
    )


def test_an_error_is_told_with_its_code_in_words_and_what_was_asked() -> None:
    def refusing(mid: int, request: bytes, write: Write) -> None:
        write(encode(Mid.ERROR, b"\x21") if mid == Mid.OUTPUT_CONFIGURATION else encode(mid + ACK))

    error, _, _ = with_peer(refusing, lambda imu: imu.configure())
    assert isinstance(error, DeviceRefused)
    assert str(error) == "mti: it refused OutputConfiguration with error 33: a parameter is not valid"


def test_what_an_older_device_cannot_be_asked_stays_empty() -> None:
    def old(mid: int, request: bytes, write: Write) -> None:
        known = {Mid.GO_TO_CONFIG: b"", Mid.REQ_DEVICE_ID: b"\x00\x30\x12\x34"}
        write(encode(mid + ACK, known[Mid(mid)]) if mid in known else encode(Mid.ERROR, b"\x04"))

    identity, _, _ = with_peer(old, lambda imu: imu.identify())
    assert identity == Identity("", "00301234", "")


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (b"", "Is it powered? Does its baud rate match the link"),
        (b"\x12\x34\x56", "the received data are not Xbus. Does the baud rate match the device"),
        (sample(100), "yet it sends data. Is the wire to the device connected? To listen only, set configure = false"),
    ],
)
def test_a_device_that_does_not_answer_is_known_within_a_second(sent: bytes, why: str) -> None:
    error, took, requests = with_peer(lambda mid, request, write: write(sent), lambda imu: imu.identify())
    assert isinstance(error, LinkLost)
    assert why in str(error)
    assert "no answer to GoToConfig within 1 s" in str(error)
    assert took == pytest.approx(1.0)
    assert requests == [(Mid.GO_TO_CONFIG, b"")] * 2


def test_a_lost_request_is_sent_once_more() -> None:
    asked: list[int] = []

    def deaf_once(mid: int, request: bytes, write: Write) -> None:
        asked.append(mid)
        if asked.count(mid) == 2:
            willing(mid, request, write)

    error, took, _ = with_peer(deaf_once, lambda imu: imu.configure())
    assert error is None
    assert asked == [Mid.GO_TO_CONFIG] * 2 + [Mid.OUTPUT_CONFIGURATION] * 2 + [Mid.GO_TO_MEASUREMENT] * 2
    assert took == pytest.approx(1.5)


def test_answers_that_come_late_are_never_taken_for_those_of_a_later_request() -> None:
    def slow(mid: int, request: bytes, write: Write) -> None:
        answers = {Mid.REQ_DEVICE_ID: b"\x11\x22\x33\x44", Mid.REQ_PRODUCT_CODE: b"MTI-30", Mid.REQ_FIRMWARE: b"\1\2\3"}
        data = answers.get(Mid(mid), b"")
        asyncio.get_running_loop().call_later(0.7, write, encode(mid + ACK, data))  # after the second try was sent

    identity, _, _ = with_peer(slow, lambda imu: imu.identify())
    assert identity == Identity("MTI-30", "11223344", "1.2.3")


def test_an_old_answer_of_the_same_kind_is_passed_over_for_the_right_one() -> None:
    old = encode_outputs([Output(RATE_OF_TURN, 400)])

    def stale(mid: int, request: bytes, write: Write) -> None:
        if mid == Mid.OUTPUT_CONFIGURATION:
            write(encode(mid + ACK, old))
            asyncio.get_running_loop().call_later(0.3, willing, mid, request, write)
        else:
            willing(mid, request, write)

    error, took, requests = with_peer(stale, lambda imu: imu.configure())
    assert error is None
    assert took == pytest.approx(0.3)
    assert [mid for mid, _ in requests] == [Mid.GO_TO_CONFIG, Mid.OUTPUT_CONFIGURATION, Mid.GO_TO_MEASUREMENT]


def test_an_error_left_from_before_does_not_refuse_the_first_request() -> None:
    def quarrelsome(mid: int, request: bytes, write: Write) -> None:
        if mid == Mid.GO_TO_CONFIG:
            write(encode(Mid.ERROR, b"\x04") + encode(Mid.ERROR, b"\x29"))
        willing(mid, request, write)

    error, _, _ = with_peer(quarrelsome, lambda imu: imu.configure())
    assert error is None


def test_noise_that_looks_like_a_long_message_does_not_hide_an_answer_for_long() -> None:
    def noisy(mid: int, request: bytes, write: Write) -> None:
        if mid == Mid.GO_TO_CONFIG:
            write(b"\xfa\xff\x36\xff\x07\xff")
        willing(mid, request, write)

    error, took, _ = with_peer(noisy, lambda imu: imu.configure())
    assert error is None
    assert took == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("granted", "error", "why"),
    [
        (b"\x80\x20\x01", BadReply, "OutputConfiguration is invalid"),
        (encode_outputs([Output(SAMPLE_TIME_FINE, EVERY)]), DeviceRefused, "does not provide RateOfTurn"),
        (encode_outputs([Output(RATE_OF_TURN, 100)]), DeviceRefused, "neither SampleTimeFine nor PacketCounter"),
    ],
)
def test_a_configuration_that_cannot_be_used_is_refused(granted: bytes, error: type[DeviceError], why: str) -> None:
    def stubborn(mid: int, request: bytes, write: Write) -> None:
        write(encode(mid + ACK, granted if mid == Mid.OUTPUT_CONFIGURATION else b""))

    found, _, _ = with_peer(stubborn, lambda imu: imu.configure())
    assert isinstance(found, error)
    assert why in str(found)


def test_rarer_temperature_and_no_acceleration_are_good_enough() -> None:
    wanted: list[bytes] = []

    def modest(mid: int, request: bytes, write: Write) -> None:
        outputs = decode_outputs(request) or ()
        wanted.append(request)
        mine = [Output(TEMPERATURE, 1) if o.data_id == TEMPERATURE else o for o in outputs if o.data_id != ACCELERATION]
        write(encode(mid + ACK, encode_outputs(mine)))

    error, _, requests = with_peer(modest, lambda imu: imu.configure())
    assert error is None
    assert decode_outputs(requests[1][1]) == (
        Output(PACKET_COUNTER, EVERY),
        Output(SAMPLE_TIME_FINE, EVERY),
        Output(RATE_OF_TURN, 100),
        Output(ACCELERATION, 100),
        Output(TEMPERATURE, 100),
    )


def test_a_listener_sends_nothing_and_hears_a_device_that_streams_already() -> None:
    heard: list[bytes] = []

    def eavesdrop(device: XsensDevice, table: Table) -> None:
        device.received = heard.append  # type: ignore[method-assign]

    identity, taken, device = with_twin(prepare=eavesdrop, options={"configure": False})
    assert (identity, heard) == (Identity(), [])
    assert device.measuring
    assert len(taken.t_s) > 295
    assert taken.accel is not None
    assert taken.counts == SourceCounts(samples=len(taken.t_s))


def test_a_real_capture_is_heard_without_its_gnss_messages_being_taken_for_losses() -> None:
    data, size_at = CAPTURE.read_bytes(), 3
    parts, position = [], 0
    while position < len(data):
        size = data[position + size_at] + 5
        parts.append((0.1 + 0.01 * len(parts), data[position : position + size]))
        position += size
    taken = from_bytes(parts)
    assert len(taken.t_s) == 96  # of 100 messages, 4 are of GNSS
    assert (taken.counts.lost, taken.counts.repeated, taken.counts.corrupt) == (0, 0, 0)
    np.testing.assert_allclose(np.diff(taken.t_s), 0.01, atol=1e-3)
    np.testing.assert_array_equal(np.diff(taken.counter), 100)
    assert np.degrees(taken.rate).std() < 0.2
    assert taken.accel is not None
    assert np.linalg.norm(taken.accel[1:], axis=1) == pytest.approx(9.8, abs=0.1)
    assert np.isnan(taken.temperature).all()


def test_temperature_that_comes_now_and_then_holds_until_the_next() -> None:
    parts = stream(20)
    for at, value in ((5, 30.0), (12, 31.0)):
        packets = [
            (SAMPLE_TIME_FINE, np.array([[5000 + 100 * at]])),
            (TEMPERATURE, np.array([[value]])),
            (RATE_OF_TURN, np.array([[0.1, 0.2, 0.3]])),
        ]
        parts[at] = (parts[at][0], encode_mtdata2(packets))
    taken = from_bytes(parts)
    np.testing.assert_array_equal(taken.temperature, [np.nan] * 5 + [30.0] * 7 + [31.0] * 8)


def test_high_rate_packets_serve_where_there_are_no_others() -> None:
    parts = [(0.1 + i / 100, sample(100 * i, kind=RATE_OF_TURN_HR)) for i in range(20)]
    np.testing.assert_allclose(from_bytes(parts).rate, [[0.1, 0.2, 0.3]] * 20, atol=1e-7)


def test_without_sample_times_the_packet_counter_tells_the_time() -> None:
    counts = [i for i in range(65500, 65600) if i not in (65520, 65560)]
    parts = [
        (
            (i - 65490) / 100,
            encode_mtdata2([(PACKET_COUNTER, np.array([[i % 65536]])), (RATE_OF_TURN, np.zeros((1, 3)))]),
        )
        for i in counts
    ]
    taken = from_bytes(parts)
    np.testing.assert_allclose(taken.t_s, (np.array(counts) - 65490) / 100, atol=1e-6)
    assert taken.counts == SourceCounts(samples=98, lost=2)


def test_a_stream_without_any_count_is_refused_with_what_to_do() -> None:
    taken = from_bytes([(0.1 + i / 100, encode_mtdata2([(RATE_OF_TURN, np.zeros((1, 3)))])) for i in range(5)])
    assert isinstance(taken.ended, BadReply)
    assert "neither SampleTimeFine nor PacketCounter; let the station configure it" in str(taken.ended)


def test_a_stream_without_rates_is_refused_with_what_there_is() -> None:
    packets = [(SAMPLE_TIME_FINE, np.zeros((1, 1))), (ACCELERATION, np.zeros((1, 3)))]
    taken = from_bytes([(0.1 + i / 100, encode_mtdata2(packets)) for i in range(150)])
    assert isinstance(taken.ended, BadReply)
    assert "no RateOfTurn, only SampleTimeFine, Acceleration(Float32);" in str(taken.ended)


def test_values_that_are_no_numbers_are_marked_as_invalid() -> None:
    parts = stream(10)
    parts[4] = (parts[4][0], sample(5400, (np.inf, 0.2, np.nan)))
    taken = from_bytes(parts)
    np.testing.assert_array_equal(np.isnan(taken.rate[4]), [True, False, True])
    assert np.isnan(taken.rate).sum() == 2


def test_messages_cut_or_damaged_are_counted_and_the_others_kept() -> None:
    parts = stream(100)
    parts[20] = (parts[20][0], parts[20][1][:-5])
    flipped = bytearray(parts[50][1])
    flipped[12] ^= 8
    parts[50] = (parts[50][0], bytes(flipped))
    parts[70] = (parts[70][0], encode(Mid.MTDATA2, bytes(parts[70][1][4:-3])))  # its last packet has no end
    taken = from_bytes(parts)
    assert len(taken.t_s) == 97
    assert taken.counts.lost == 3
    assert taken.counts.corrupt >= 3
    np.testing.assert_allclose(taken.t_s, 0.1 + (taken.counter - 5000) / 10_000, atol=1e-6)


@pytest.mark.parametrize("error_ticks", [2**31 + 7, 2**24, 16384, -2000, -16384])
def test_a_damaged_time_that_no_checksum_has_caught_spoils_nothing(error_ticks: int) -> None:
    parts = stream(1000)
    parts[600] = (parts[600][0], sample(5000 + 60_000 + error_ticks))
    taken = from_bytes(parts)
    assert isinstance(taken.ended, LinkLost)
    assert len(taken.t_s) == 999
    np.testing.assert_allclose(taken.t_s, np.delete(0.1 + np.arange(1000) / 100, 600), atol=1e-6)
    assert (taken.counts.corrupt, taken.counts.lost) == (1, 1)


def test_a_stall_of_the_line_is_not_taken_for_damage() -> None:
    parts = stream(1000)
    parts = [(9.0 if 5.0 < at < 9.0 else at, data) for at, data in parts]
    taken = from_bytes(parts)
    assert len(taken.t_s) == 1000
    assert (taken.counts.corrupt, taken.counts.lost) == (0, 0)
    assert taken.counts.late > 350
    np.testing.assert_allclose(np.diff(taken.t_s), 0.01, atol=1e-4)


def test_a_backlog_at_the_start_is_not_taken_for_damage() -> None:
    parts = [(max(at, 3.0), data) for at, data in stream(1000)]
    taken = from_bytes(parts)
    assert len(taken.t_s) == 1000
    assert (taken.counts.corrupt, taken.counts.lost) == (0, 0)
    np.testing.assert_allclose(taken.t_s[-100:], 0.1 + np.arange(900, 1000) / 100, atol=1e-3)


@pytest.mark.parametrize("then_ticks", [0, 4000, 3_000_000_000])
def test_a_device_that_counts_anew_ends_the_run(then_ticks: int) -> None:
    first, second = stream(400), stream(400, first=then_ticks, start_s=5.0)
    taken = from_bytes(first + second)
    assert isinstance(taken.ended, DeviceFault)
    assert "it has restarted" in str(taken.ended)
    assert len(taken.t_s) == 400


def test_a_restart_that_the_device_tells_ends_the_run_at_once() -> None:
    def restarting(device: XsensDevice, table: Table) -> None:
        asyncio.get_running_loop().call_later(1.5, device.restart)

    _, taken, _ = with_twin(prepare=restarting)
    assert isinstance(taken.ended, DeviceFault)
    assert "it has restarted. Check its power supply" in str(taken.ended)
    assert taken.t_s[-1] < 1.52


def test_a_fault_that_the_device_reports_ends_the_run_with_its_words() -> None:
    def overflowing(device: XsensDevice, table: Table) -> None:
        asyncio.get_running_loop().call_later(1.5, device.report, 41)

    _, taken, _ = with_twin(prepare=overflowing)
    assert isinstance(taken.ended, DeviceFault)
    assert "error 41: it makes more data than the line carries: raise the baud rate" in str(taken.ended)


def test_the_last_samples_are_not_kept_back() -> None:
    parts = [(0.1 + i / 1000, sample(10 * i)) for i in range(105)]
    taken = from_bytes(parts, rate_hz=1000)
    assert taken.sizes == [10] * 10 + [5]
