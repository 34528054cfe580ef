"""The twin of an Xsens MTi: what it answers in which mode, what it sends, and the faults it can show."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.imus.xsens.mtdata2 import (
    ACCELERATION,
    EULER_ANGLES,
    EVERY,
    PACKET_COUNTER,
    PRESSURE,
    RATE_OF_TURN,
    SAMPLE_TIME_COARSE,
    SAMPLE_TIME_FINE,
    STATUS_BYTE,
    STATUS_WORD,
    TEMPERATURE,
    Output,
    Samples,
    decode_outputs,
    encode_outputs,
    parse_mtdata2,
)
from drivers.imus.xsens.xbus import Mid, XbusDecoder, encode
from sims.imus.xsens import XsensDevice
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.hidden.converter import Saturation, Stuck
from sims.physics.hidden.effects import Hidden
from sims.physics.motion import AxisMotion
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.run.event_loop.loops import VirtualLoop

OPENING = json.loads((Path(__file__).parents[1] / "vectors" / "xsens_opening.json").read_text())["vectors"]
RATE_HZ = 400
NOISE = 1e-3
RANGE_RPS = np.radians(2000)


class Line:
    """A device on a table that turns at a steady rate, and what it has sent."""

    def __init__(
        self,
        *,
        turning_rps: float = 0.5,
        hidden: Hidden | None = None,
        up: Any = None,
        faults: NodeFaults | None = None,
        **options: Any,
    ) -> None:
        motion = AxisMotion(0.0, 100.0, 1e9)
        motion.jog(0.0, turning_rps, 1e9)
        body = Body(
            gimbals="z",
            angles=lambda _axis, t: motion.angles(t),
            revision=lambda: motion.revision,
            latitude_rad=0.8,
            heading_rad=0.0,
        )
        zeros = np.zeros(3)
        truth = GyroTruth(zeros, zeros, zeros, zeros, NOISE, 0.0)
        gyros = GyroArray(
            mounting=mounted(MOUNTS_DEG["triad"]), truth=truth, body=body, rate_hz=RATE_HZ, seed=(1,), hidden=hidden
        )
        self.sent = b""
        self.device = XsensDevice(
            ImuTwinSetup(gyros=gyros, rate_hz=RATE_HZ, up=up, faults=faults or NodeFaults()), self._write, **options
        )

    def _write(self, data: bytes) -> None:
        self.sent += data

    def told(self) -> list[tuple[int, bytes]]:
        """Return the messages sent since the last call, data (n, length) one by one."""
        found = [(m.mid, data) for m in XbusDecoder().feed(self.sent) for data in m.each()]
        self.sent = b""
        return found

    def asked(self, mid: int, data: bytes = b"") -> list[tuple[int, bytes]]:
        self.told()
        self.device.received(encode(mid, data))
        return self.told()

    def streamed(self, duration_s: float, *acts: tuple[float, Callable[[], None]]) -> list[Samples]:
        """Let the device run, do something at instants, and return its samples, runs of the same packets together."""

        async def main() -> None:
            loop = asyncio.get_running_loop()
            task = loop.create_task(self.device.serve())
            for at, act in acts:
                loop.call_at(at, act)
            await asyncio.sleep(duration_s + 1e-3)
            task.cancel()

        with asyncio.Runner(loop_factory=VirtualLoop) as runner:
            runner.run(main())
        decoder = XbusDecoder()
        found: list[Samples] = []
        for messages in decoder.feed(self.sent):
            if messages.mid == Mid.MTDATA2:
                samples, malformed = parse_mtdata2(messages.data)
                assert malformed == 0
                found += samples
        assert (decoder.dropped_bytes, decoder.bad_messages) == (0, 0)
        return found


def of(found: list[Samples], kind: int) -> np.ndarray:
    numbers = [s.numbers(kind) for s in found if s.has(kind)]
    return np.concatenate([part for part in numbers if part is not None])


def counted(found: list[Samples], kind: int) -> np.ndarray:
    numbers = [s.integers(kind) for s in found if s.has(kind)]
    return np.concatenate([part for part in numbers if part is not None])[:, 0]


def test_switched_on_it_measures_and_sends_what_it_is_set_to() -> None:
    found = Line().streamed(1.0)
    (packets,) = {samples.packets for samples in found}
    assert [packet.data_id for packet in packets] == [PACKET_COUNTER, SAMPLE_TIME_FINE, RATE_OF_TURN, TEMPERATURE]
    np.testing.assert_array_equal(counted(found, PACKET_COUNTER), np.arange(RATE_HZ))
    np.testing.assert_array_equal(counted(found, SAMPLE_TIME_FINE), 25 * np.arange(1, RATE_HZ + 1))
    np.testing.assert_allclose(of(found, RATE_OF_TURN).mean(axis=0), [0, 0, 0.5], atol=0.01)
    np.testing.assert_allclose(of(found, TEMPERATURE), 25, atol=0.1)


def test_in_config_mode_it_is_silent_and_answers_every_request() -> None:
    line = Line(serial="0370ABCD", product="MTI-630")
    assert line.asked(Mid.GO_TO_CONFIG) == [(0x31, b"")]
    assert line.asked(Mid.REQ_DEVICE_ID) == [(0x01, bytes.fromhex("0370ABCD"))]
    assert line.asked(Mid.REQ_PRODUCT_CODE) == [(0x1D, b"MTI-630             ")]
    assert line.asked(Mid.REQ_FIRMWARE) == [(0x13, bytes.fromhex("0108020000002500011534"))]
    assert line.asked(Mid.REQ_HARDWARE) == [(0x1F, bytes([2, 0]))]
    assert line.streamed(0.5) == []
    assert line.asked(Mid.GO_TO_MEASUREMENT) == [(0x11, b"")]
    assert len(of(line.streamed(0.5), RATE_OF_TURN)) == RATE_HZ // 2


@pytest.mark.parametrize("mid", [Mid.REQ_DEVICE_ID, Mid.OUTPUT_CONFIGURATION, Mid.GO_TO_MEASUREMENT, 0x18])
def test_while_it_measures_it_takes_no_request_but_to_go_to_config(mid: int) -> None:
    assert Line().asked(mid) == [(Mid.ERROR, b"\x04")]


def test_a_request_that_it_does_not_know_is_an_error() -> None:
    line = Line()
    line.asked(Mid.GO_TO_CONFIG)
    assert line.asked(0x18) == [(Mid.ERROR, b"\x04")]
    assert line.asked(0xFE) == [(Mid.ERROR, b"\x04")]


@pytest.mark.parametrize("data", [b"\x80\x20\x01", encode_outputs([Output(PRESSURE, 100)]), b"\xf7\xf0\x00\x64"])
def test_a_configuration_that_it_cannot_make_out_is_an_error_and_changes_nothing(data: bytes) -> None:
    line = Line()
    before = line.device.outputs
    line.asked(Mid.GO_TO_CONFIG)
    assert line.asked(Mid.OUTPUT_CONFIGURATION, data) == [(Mid.ERROR, b"\x21")]
    assert line.device.outputs == before


def test_it_grants_the_nearest_rate_that_it_has_and_says_so() -> None:
    line = Line(up=lambda t: np.tile([0.0, 0.0, 1.0], (len(t), 1)))
    line.asked(Mid.GO_TO_CONFIG)
    wanted = [
        Output(SAMPLE_TIME_FINE, 100),
        Output(RATE_OF_TURN | 2, 1000),
        Output(ACCELERATION, 130),
        Output(TEMPERATURE, 1),
    ]
    granted = [
        Output(SAMPLE_TIME_FINE, EVERY),
        Output(RATE_OF_TURN | 2, 400),
        Output(ACCELERATION, 133),
        Output(TEMPERATURE, 1),
    ]
    assert line.asked(Mid.OUTPUT_CONFIGURATION, encode_outputs(wanted)) == [(0xC1, encode_outputs(granted))]
    assert line.asked(Mid.OUTPUT_CONFIGURATION) == [(0xC1, encode_outputs(granted))]
    line.asked(Mid.GO_TO_MEASUREMENT)
    found = line.streamed(1.0)
    assert [len(of(found, kind)) for kind in (RATE_OF_TURN, ACCELERATION, TEMPERATURE)] == [400, 133, 1]
    assert len(counted(found, SAMPLE_TIME_FINE)) == 400


@pytest.mark.parametrize("most", [0, EVERY])
def test_no_rate_means_its_highest(most: int) -> None:
    line = Line()
    line.asked(Mid.GO_TO_CONFIG)
    ((_, answer),) = line.asked(Mid.OUTPUT_CONFIGURATION, encode_outputs([Output(RATE_OF_TURN, most)]))
    assert decode_outputs(answer) == (Output(RATE_OF_TURN, RATE_HZ),)


def test_without_accelerometers_it_grants_no_acceleration() -> None:
    line = Line()
    line.asked(Mid.GO_TO_CONFIG)
    wanted = [Output(RATE_OF_TURN, 100), Output(ACCELERATION, 100)]
    assert line.asked(Mid.OUTPUT_CONFIGURATION, encode_outputs(wanted)) == [(0xC1, encode_outputs(wanted[:1]))]


def test_counts_and_status_alone_make_no_message_where_something_has_a_rate() -> None:
    line = Line(uptime_ticks=123_456)
    line.asked(Mid.GO_TO_CONFIG)
    outputs = [Output(kind, EVERY) for kind in (PACKET_COUNTER, SAMPLE_TIME_COARSE, STATUS_BYTE, STATUS_WORD)]
    line.asked(Mid.OUTPUT_CONFIGURATION, encode_outputs([*outputs, Output(RATE_OF_TURN, 100)]))
    line.asked(Mid.GO_TO_MEASUREMENT)
    found = line.streamed(1.0)
    np.testing.assert_array_equal(counted(found, PACKET_COUNTER), np.arange(100))
    assert set(counted(found, SAMPLE_TIME_COARSE)) == {12, 13}
    assert set(counted(found, STATUS_BYTE)) == set(counted(found, STATUS_WORD)) == {1}


def test_requests_may_come_in_any_cut_and_damaged_ones_are_not_answered() -> None:
    line = Line()
    good, bad = encode(Mid.GO_TO_CONFIG), bytearray(encode(Mid.REQ_DEVICE_ID))
    bad[-1] ^= 1
    for byte in bytes(bad) + good + encode(Mid.GO_TO_CONFIG + 1):
        line.device.received(bytes([byte]))
    assert line.told() == [(0x31, b"")]


def test_after_a_reset_it_says_that_it_woke_up_and_counts_from_nought() -> None:
    line = Line(uptime_ticks=5_000_000)
    line.asked(Mid.GO_TO_CONFIG)
    assert line.asked(Mid.RESET) == [(0x41, b""), (Mid.WAKE_UP, b"")]
    found = line.streamed(0.1)
    np.testing.assert_array_equal(counted(found, SAMPLE_TIME_FINE)[:3], [25, 50, 75])
    np.testing.assert_array_equal(counted(found, PACKET_COUNTER)[:3], [0, 1, 2])


def test_its_counts_wrap() -> None:
    ticks = counted(Line(uptime_ticks=2**32 - 60).streamed(0.1), SAMPLE_TIME_FINE)
    np.testing.assert_array_equal(ticks[:4], [2**32 - 35, 2**32 - 10, 15, 40])


@pytest.mark.parametrize("hidden", [False, True])
def test_a_stuck_gyro_keeps_its_last_value_and_the_others_go_on(hidden: bool) -> None:
    if hidden:
        rate = of(Line(hidden=Hidden((Stuck(gyro=2, from_s=0.5, until_s=1e9),))).streamed(1.0), RATE_OF_TURN)
    else:
        line = Line()
        rate = of(line.streamed(1.0, (0.4951, lambda: line.device.faults.stuck.add(1))), RATE_OF_TURN)
    assert len(set(rate[210:, 1])) == 1
    assert len(set(rate[:190, 1])) == 190
    assert len(set(rate[:, 0])) == len(set(rate[:, 2])) == 400
    assert rate[210, 1] in rate[190:210, 1]


def test_a_saturated_gyro_is_pegged() -> None:
    line = Line()
    line.device.faults.saturated = {2}
    rate = of(line.streamed(0.5), RATE_OF_TURN)
    np.testing.assert_allclose(rate[:, 2], RANGE_RPS, rtol=1e-6)
    assert np.abs(rate[:, :2]).max() < 0.2


def test_no_gyro_goes_beyond_its_range() -> None:
    fast = of(Line(turning_rps=50.0).streamed(0.2), RATE_OF_TURN)
    np.testing.assert_allclose(fast[4:, 2], RANGE_RPS, rtol=1e-6)
    limited = Hidden((Saturation(limit_rps=np.full(3, 0.3)),))
    np.testing.assert_allclose(of(Line(hidden=limited).streamed(0.2), RATE_OF_TURN)[4:, 2], 0.3, rtol=1e-6)


def test_dropped_messages_leave_a_gap_in_both_counts_and_doubled_ones_are_the_same_again() -> None:
    line = Line(seed=4)
    line.device.faults.dropped, line.device.faults.doubled = 0.05, 0.05
    found = line.streamed(5.0)
    number, ticks = counted(found, PACKET_COUNTER), counted(found, SAMPLE_TIME_FINE)
    step = np.diff(number)
    np.testing.assert_array_equal(np.diff(ticks), 25 * step)
    assert 60 < (step == 0).sum() < 140
    assert 60 < (step - 1)[step > 1].sum() < 140
    rate = of(found, RATE_OF_TURN)
    np.testing.assert_array_equal(rate[1:][step == 0], rate[:-1][step == 0])


@pytest.mark.parametrize("clock_ppm", [-2000.0, 2000.0])
def test_a_fast_clock_gives_more_samples_by_its_error(clock_ppm: float) -> None:
    ticks = counted(Line(faults=NodeFaults(clock_ppm=clock_ppm)).streamed(10.0), SAMPLE_TIME_FINE)
    assert ticks[-1] == pytest.approx(100_000 * (1 + clock_ppm * 1e-6), abs=100)


def test_it_answers_what_the_makers_sdk_asks_when_it_opens_a_port() -> None:
    line = Line(up=lambda t: np.tile([0.0, 0.0, 1.0], (len(t), 1)))
    for vector in OPENING:
        ((mid, data),) = line.asked(int(vector["mid"], 16), bytes.fromhex(vector["data"]))
        assert mid == int(vector["reply"], 16), vector
        assert data.startswith(bytes.fromhex(vector.get("starts", ""))), vector
        assert len(data) == vector["length"], vector


def test_its_configuration_tells_what_it_is_and_sends() -> None:
    line = Line()
    line.asked(Mid.GO_TO_CONFIG)
    ((_, data),) = line.asked(Mid.REQ_CONFIGURATION)
    assert int.from_bytes(data[4:6]) == 115_200 // RATE_HZ  # sampling period
    assert int.from_bytes(data[96:98]) == 1  # device
    assert data[98:102] == bytes.fromhex("03700715")


@pytest.mark.parametrize("number_format", range(4))
def test_euler_angles_are_those_by_which_it_is_tilted(number_format: int) -> None:
    up = np.array([-0.5, 0.6, np.sqrt(0.39)])
    line = Line(up=lambda t: np.tile(up, (len(t), 1)))
    line.asked(Mid.GO_TO_CONFIG)
    wanted = encode_outputs((Output(EULER_ANGLES | number_format, 100),))
    assert line.asked(Mid.OUTPUT_CONFIGURATION, wanted) == [(Mid.OUTPUT_CONFIGURATION + 1, wanted)]
    line.asked(Mid.GO_TO_MEASUREMENT)
    (samples,) = line.streamed(0.1)
    angles = samples.numbers(EULER_ANGLES)
    assert angles is not None
    np.testing.assert_allclose(angles, np.tile([np.degrees(np.arctan2(up[1], up[2])), 30.0, 0.0], (10, 1)), atol=1e-4)


def test_without_accelerometers_there_are_no_euler_angles() -> None:
    line = Line()
    line.asked(Mid.GO_TO_CONFIG)
    ((_, granted),) = line.asked(Mid.OUTPUT_CONFIGURATION, encode_outputs((Output(EULER_ANGLES, 100),)))
    assert granted == b""
