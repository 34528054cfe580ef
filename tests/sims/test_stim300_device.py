"""The STIM300's twin by the bytes it sends: start, answers, units, modes, and each of its faults."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from drivers.imus.stim300.codec import LAYOUTS, STATUS_OVERLOAD, STATUS_START_UP, Datagrams, Stim300Decoder
from drivers.imus.stim300.special import BiasTrim, Configuration, ExtendedError, PartNumber, SerialNumber, Special
from drivers.imus.stim300.units import GYRO_LSB_DEG, GYRO_LSB_DPS
from drivers.imus.stim300.utility import UtilityMessage, encode_message, parse_message
from sims.imus.stim300 import Stim300Device
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.motion import AxisMotion
from sims.wires.frames import ImuTwinSetup, NodeFaults
from station.run.event_loop.loops import VirtualLoop

DPS = np.array([20.0, -7.0, 3.0])


def array_of(rate_hz: int, dps: np.ndarray = DPS) -> GyroArray:
    """Return three gyros at rest, whose biases are the rates (they are taken off)."""
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
    return GyroArray(
        mounting=mounted(MOUNTS_DEG["triad"]),
        truth=GyroTruth(none, -np.radians(dps), none, none, 0.0, 0.0),
        body=body,
        rate_hz=rate_hz,
        seed=(1,),
    )


@dataclass
class Sent:
    """What a device has sent."""

    raw: bytes = b""
    parts: list[Datagrams | Special] = field(default_factory=list)

    @property
    def normal(self) -> list[Datagrams]:
        return [part for part in self.parts if isinstance(part, Datagrams)]

    def joined(self, name: str) -> np.ndarray:
        return np.concatenate([getattr(part, name) for part in self.normal])

    @property
    def gyro(self) -> np.ndarray:
        return np.concatenate([part.groups["gyro"][0] for part in self.normal])

    @property
    def status(self) -> np.ndarray:
        return np.concatenate([part.groups["gyro"][1] for part in self.normal])

    @property
    def specials(self) -> list[Special]:
        return [part for part in self.parts if not isinstance(part, Datagrams)]


def run(
    seconds: float, rate_hz: int = 2000, *, act: Callable[[Stim300Device], Any] = lambda _: None, **options: Any
) -> Sent:
    """Serve a device, act on it in the middle, and return what it has sent."""
    sent = Sent()

    def take(data: bytes) -> None:
        sent.raw += data

    async def scene() -> None:
        faults = options.pop("faults", NodeFaults())
        device = Stim300Device(
            ImuTwinSetup(gyros=array_of(rate_hz, options.pop("dps", DPS)), rate_hz=rate_hz, faults=faults),
            take,
            **options,
        )
        task = asyncio.ensure_future(device.serve())
        await asyncio.sleep(seconds / 2)
        act(device)
        await asyncio.sleep(seconds / 2)
        task.cancel()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(scene())
    sent.parts = list(Stim300Decoder().feed(sent.raw))
    return sent


def test_after_power_on_it_names_itself_and_its_first_samples_carry_the_start_up_bit() -> None:
    sent = run(1.0, cold=True, line_termination=True, identifier=0xA5, rate_hz=1000)
    assert [type(value) for value in sent.parts[:3]] == [PartNumber, SerialNumber, Configuration]
    assert sent.specials[0] == PartNumber("84167-440000-3321", "K")
    assert sent.specials[1] == SerialNumber("N25582405002002")
    starting = (sent.status & STATUS_START_UP) != 0
    np.testing.assert_array_equal(starting, np.arange(len(starting)) < 500)
    assert sent.raw.endswith(b"\r\n")


@pytest.mark.parametrize("identifier", sorted(set(LAYOUTS) - set(range(0x98, 0x9D)) - set(range(0xAD, 0xB0))))
def test_it_sends_any_normal_datagram(identifier: int) -> None:
    sent = run(0.1, 500, identifier=identifier)
    assert {part.identifier for part in sent.parts if isinstance(part, Datagrams)} == {identifier}
    np.testing.assert_array_equal(np.diff(sent.joined("counter")) % 256, 4)
    np.testing.assert_allclose(sent.gyro * GYRO_LSB_DPS, np.tile(DPS, (len(sent.gyro), 1)), atol=1e-4)


@pytest.mark.parametrize("rate_hz", [125, 500, 2000])
def test_increments_and_integrals_keep_the_whole_angle(rate_hz: int) -> None:
    increments = run(2.0, rate_hz, gyro_unit="increment").gyro
    np.testing.assert_allclose(increments.mean(axis=0) * GYRO_LSB_DEG * rate_hz, DPS, rtol=1e-4)
    average = run(1.0, rate_hz, gyro_unit="average").gyro
    np.testing.assert_allclose(average * GYRO_LSB_DPS, np.tile(DPS, (len(average), 1)), atol=0.1)
    integral = run(2.0, rate_hz, gyro_unit="integrated").gyro
    unwrapped = np.unwrap(integral * GYRO_LSB_DEG, period=8.0, axis=0)
    np.testing.assert_allclose(unwrapped[-1] - unwrapped[0], DPS * (len(integral) - 1) / rate_hz, rtol=1e-4)
    assert integral.max() - integral.min() > (1 << 24) * 0.9  # it has gone round


def test_answers_take_the_place_of_samples() -> None:
    sent = run(1.0, act=lambda device: [device.received(byte) for byte in (b"N", b"\rI\rC\rT\r", b"x\rE\r")])
    kinds = [PartNumber, SerialNumber, Configuration, BiasTrim, ExtendedError]
    assert [type(value) for value in sent.specials] == kinds
    steps = np.diff(sent.joined("counter")) % 256
    assert sorted(set(steps.tolist())) == [1, 1 + len(kinds)]


def test_a_reset_begins_anew() -> None:
    sent = run(1.0, act=lambda device: device.received(b"R\r"))
    assert [type(value) for value in sent.specials] == [PartNumber, SerialNumber, Configuration]
    status = sent.status
    assert not status[:900].any()
    assert (status[-900:] == STATUS_START_UP).all()


def test_a_stuck_gyro_keeps_its_output_while_the_others_go_on() -> None:
    def act(device: Stim300Device) -> None:
        device.faults.stuck = {1}

    gyro = run(1.0, gyro_unit="integrated", act=act).gyro
    moves = np.abs(np.diff(gyro[1100:], axis=0)).min(axis=0)
    assert moves[0] > 0
    assert np.ptp(gyro[1100:, 1]) == 0
    assert moves[2] > 0


def test_a_saturated_gyro_stands_at_its_range_and_says_nothing() -> None:
    def act(device: Stim300Device) -> None:
        device.faults.saturated = {2}

    sent = run(1.0, act=act)
    assert (sent.gyro[1100:, 2] * GYRO_LSB_DPS == 400.0).all()
    assert not sent.status.any()


def test_an_overload_is_told_by_status_and_error_register() -> None:
    def act(device: Stim300Device) -> None:
        device.overload_gyro = 1
        device.received(b"E\r")
        asyncio.get_running_loop().call_later(0.2, device.received, b"E\r")

    sent = run(1.0, act=act)
    assert (sent.status[1100:] == STATUS_OVERLOAD | 0x02).all()
    assert [value.texts for value in sent.specials if isinstance(value, ExtendedError)] == [
        (),
        ("gyro Y is overloaded",),
    ]


def test_beyond_its_range_it_reports_an_overload_by_itself() -> None:
    status = run(0.1, dps=np.array([410.0, -420.0, 399.0])).status
    assert (status == STATUS_OVERLOAD | 0x03).all()


def test_dropped_and_doubled_samples_are_as_many_as_asked_for() -> None:
    devices = []

    def act(device: Stim300Device) -> None:
        devices.append(device)
        device.faults.dropped, device.faults.doubled = 0.05, 0.02

    steps = np.diff(run(2.0, act=act).joined("counter")) % 256
    (device,) = devices
    assert 60 < device.dropped < 140
    assert 15 < device.doubled < 65
    assert (steps - 1).clip(0).sum() == device.dropped
    assert (steps == 0).sum() == device.doubled


def test_a_clock_that_runs_fast_sends_more() -> None:
    assert (
        len(run(4.0, 500, faults=NodeFaults(clock_ppm=5000)).joined("counter")) - len(run(4.0, 500).joined("counter"))
        == 10
    )


def test_samples_that_a_busy_computer_sends_late_say_how_late() -> None:
    sent = Sent()

    async def scene() -> None:
        device = Stim300Device(
            ImuTwinSetup(gyros=array_of(500), rate_hz=500), lambda data: setattr(sent, "raw", sent.raw + data)
        )
        task = asyncio.ensure_future(device.serve())
        await asyncio.sleep(0.03)
        time.sleep(0.04)  # the computer does something else
        await asyncio.sleep(0.03)
        task.cancel()

    asyncio.run(scene())
    sent.parts = list(Stim300Decoder().feed(sent.raw))
    assert sent.joined("latency_us").max() > 25_000
    assert not run(0.1).joined("latency_us").any()


def typed(*lines: bytes) -> Sent:
    return run(0.2, act=lambda device: [device.received(line) for line in lines])


def replies(raw: bytes) -> list[tuple[str, ...]]:
    """Return the replies of utility mode behind its greeting."""
    found = [parse_message(line + b"\r") for line in raw[raw.index(b"#UTIL") :].split(b"\r")]
    return [message.fields for message in found if message is not None][1:]


def test_utility_mode_answers_like_the_datasheet() -> None:
    raw = typed(b"UTILITYMODE\r", b"$isn,28\r", b"$xn,150\r").raw
    assert b"#UTILITYMODE,234\r#isn,0,N25582405002002,252\r#xn,0,125\r" in raw


def test_utility_mode_refuses_with_the_status_of_what_is_wrong() -> None:
    lines = [b"$isn,29\r", b"$dbto,0.00123,0\r", b"$sm,", b"99\r", b"$save,1,19\r"]
    raw = typed(b"UTILITYMODE\r", *lines).raw
    assert replies(raw) == [("", "2"), ("", "3"), ("", "2"), ("", "2")]
    assert b"#,2,139\r#,3,158\r" in raw


def test_utility_mode_tells_part_number_gyro_and_transmission() -> None:
    asked = [encode_message(UtilityMessage(False, fields)) for fields in (("ipn",), ("ig", "x"), ("ig", "w"), ("it",))]
    raw = typed(b"UTILITYMODE\r", *asked).raw
    assert replies(raw) == [
        ("ipn", "0", "84167-440000-3321", "K"),
        ("ig", "0", "X", "1", "0", "4", "0", "0"),
        ("ig", "5"),
        ("it", "0", "921600", "1", "n", "0", "0", "0"),
    ]


def test_foreign_bytes_from_the_host_change_nothing() -> None:
    sent = run(0.5, act=lambda device: device.received(np.random.default_rng(1).bytes(100_000)))
    assert not sent.specials
    assert set((np.diff(sent.joined("counter")) % 256).tolist()) == {1}
