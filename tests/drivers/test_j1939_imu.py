"""Aceinna's IMUs on J1939: a real trace, the requests as documented, and the twin on a bus in memory."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any, TypeVar

import can
import numpy as np
import pytest
from can_support import collect, gyros, in_virtual_time, vectors, wire
from hypothesis import given, strategies as st
from setups import imu_setup

from drivers.errors import DeviceRefused, LinkLost
from drivers.imus.aceinna.codec import (
    ACCS,
    ARI,
    AXIS_ORDERS,
    DBC,
    ORIENTATION,
    PACKET_TYPES,
    RATE_DIVIDER,
    RESET_ALGORITHM,
    SAVE,
    SOFTWARE_VERSION,
    SSI2,
    Name,
    command,
    decode_version,
    identifier,
    message,
    request,
    settings,
)
from drivers.imus.aceinna.imu import AceinnaImu
from drivers.imus.can.imu import load_dbc
from drivers.imus.signals import parameter_group
from drivers.links.can_link import CanLink
from drivers.links.can_memory import MemoryBus
from drivers.types import Frame, Identity, SourceCounts
from sims.imus.aceinna import AceinnaDevice
from sims.wires.frames import ImuTwinSetup, NodeFaults

T = TypeVar("T")
RATES_DPS = (10.0, -20.0, 30.0)
FORCE = np.array([1.0, -2.0, 9.8])
HOST, DEVICE = 0x00, 0x80


def fields(decoded: dict[str, Any], unit: str) -> list[float]:
    if "acc_mps2" in decoded:
        return [float(v) for v in decoded["acc_mps2"]]
    return [float(decoded[f"field{i}_{unit}"]) for i in (1, 2, 3)]


class Told:
    """A link that hands over frames once, and is lost."""

    def __init__(self, frames: list[tuple[int, bytes]]) -> None:
        self._frames = [Frame(10_000_000 * i, number, True, data) for i, (number, data) in enumerate(frames)]

    async def open(self) -> None:
        pass

    async def receive(self) -> list[Frame]:
        if not self._frames:
            raise LinkLost("imu", "that was all")
        frames, self._frames = self._frames, []
        return frames

    def send(self, frame: Frame) -> None:
        pass

    def close(self) -> None:
        pass


def decoded(model: str, rates: bytes, accelerations: bytes) -> tuple[list[float], list[float]]:
    """Return rates (deg/s) and accelerations (m/s2) that the driver makes of the data of a message each."""

    async def main() -> tuple[list[float], list[float]]:
        messages = [(identifier(ACCS, DEVICE), accelerations), (identifier(ARI, DEVICE), rates)]
        imu = AceinnaImu(imu_setup("j1939", "imu", 100.0, model=model), Told(messages))
        with suppress(LinkLost):
            async for _ in imu.blocks():
                pass
        ((_, block),) = imu.flush()
        assert block.accel_mps2 is not None
        return np.degrees(block.rate_rps[0]).tolist(), block.accel_mps2[0].tolist()

    return in_virtual_time(main)


def action(group: int, destination: int, source: int) -> Frame:
    """Return the request to reset the algorithm or to save the configuration."""
    return message(group, bytes([0, destination, 0]), source)


DATA = {v["can_id"]: v for v in vectors("can_aceinna_j1939") if v["can_id"] in ("0CF02980", "0CF02A80", "08F02D80")}


@pytest.mark.parametrize("model", ["openimu300ri", "mtlt305d"])
@pytest.mark.parametrize("vector", [v for v in vectors("can_aceinna_j1939") if v["can_id"] in DATA], ids=str)
def test_the_data_messages_of_a_real_trace_decode_and_encode(vector: dict[str, Any], model: str) -> None:
    data, told = bytes.fromhex(vector["hex"]), vector["decoded"]
    message = load_dbc("imu", DBC).get_message_by_frame_id(int(vector["can_id"], 16))
    values = message.decode(data)
    assert message.encode(values)[:6] == data[:6]
    group = parameter_group(int(vector["can_id"], 16))
    assert identifier(group, DEVICE) == int(vector["can_id"], 16)
    if group == SSI2:
        assert list(values.values()) == pytest.approx([told["pitch_deg"], told["roll_deg"]], abs=1e-12)
        return
    expected = np.array(fields(told, "dps" if group == ARI else "mps2"))
    assert list(values.values()) == pytest.approx(expected, abs=1e-9)
    columns = [0, 1, 2] if AXIS_ORDERS[model] == "xyz" else [1, 0, 2]
    rates, accelerations = decoded(model, *((data, bytes(8)) if group == ARI else (bytes(8), data)))
    assert (rates if group == ARI else accelerations) == pytest.approx(expected[columns], abs=1e-9)


REQUESTS = {
    "18FF5500": command(RATE_DIVIDER, DEVICE, bytes([1]), HOST),
    "18FF5600": command(PACKET_TYPES, DEVICE, bytes([7, 0]), HOST),
    "18FF5800": command(ORIENTATION, DEVICE, bytes(2), HOST),
    "18FF5000": action(RESET_ALGORITHM, DEVICE, HOST),
    "18FF5100": action(SAVE, DEVICE, HOST),
    "18EA8000": request(SOFTWARE_VERSION, DEVICE, HOST),
    "18EAFF80": request(0xFF53, 0xFF, DEVICE, standard=True),
}


@pytest.mark.parametrize("vector", [v for v in vectors("can_aceinna_j1939") if v["can_id"] in REQUESTS])
def test_requests_are_written_as_documented(vector: dict[str, Any]) -> None:
    frame = REQUESTS[vector["can_id"]]
    assert (f"{frame.identifier:08X}", frame.data.hex(), frame.extended) == (vector["can_id"], vector["hex"], True)


def test_every_vector_is_looked_at() -> None:
    told = {"0CF02980", "0CF02A80", "08F02D80", "18FF5380", *REQUESTS}  # 18FF5380: a self test status, not used here
    assert {v["can_id"] for v in vectors("can_aceinna_j1939")} == told


def test_settings_make_the_documented_commands() -> None:
    assert [(f"{group:04X}", values.hex()) for group, values in settings(50.0)] == [("FF55", "02"), ("FF56", "0600")]


@pytest.mark.parametrize(
    ("rate_hz", "message"),
    [(33.0, "33 Hz: the device sends at 100, 50, 25, 20, 10, 5, 4, 2 Hz"), (0.0, "rate 0 Hz")],
)
def test_what_the_device_cannot_do_is_refused_before_it_is_asked(rate_hz: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        AceinnaImu(imu_setup("j1939", "imu", rate_hz, configure=True), CanLink("imu", "memory", wire(), {}))


@given(st.lists(st.integers(0, 0xFFFF), min_size=3, max_size=3))
def test_every_code_is_a_rate_or_none_at_the_ends_and_beyond(raw: list[int]) -> None:
    rates, _ = decoded("openimu300ri", np.array([*raw, 0], dtype="<u2").tobytes(), bytes(8))
    for code, rate in zip(raw, rates, strict=True):
        assert math.isnan(rate) == (code == 0 or code >= 64000)
        if 0 < code < 64000:
            assert rate == pytest.approx(code / 128 - 250, abs=1e-12)


@given(st.binary(max_size=12))
def test_no_answer_makes_the_codec_raise(data: bytes) -> None:
    assert (decode_version(data) == "") == (len(data) != 5)
    assert (Name.decode(data) is None) == (len(data) != 8)


@given(st.integers(0, (1 << 21) - 1), st.integers(0, (1 << 11) - 1), st.integers(0, 255))
def test_a_name_survives_its_bytes(identity: int, manufacturer: int, function: int) -> None:
    name = Name(identity, manufacturer, function)
    assert Name.decode(name.encode()) == name


def with_twin(
    main: Callable[[AceinnaImu, AceinnaDevice, MemoryBus], Awaitable[T]],
    *,
    model: str = "openimu300ri",
    twin_model: str | None = None,
    rate_hz: float = 100.0,
    configure: bool = False,
    obstinate: bool = False,
    faults: NodeFaults | None = None,
    listening: bool = True,
    standard_requests: bool = False,
    **twin: Any,
) -> T:
    """Run ``main`` with a driver that is not open yet and a running twin."""

    async def run() -> T:
        name = wire()
        bus = MemoryBus(name)
        ride = ImuTwinSetup(
            gyros=gyros(rate_hz, RATES_DPS),
            rate_hz=100.0,
            up=lambda t_s: np.tile(FORCE / 9.80665, (len(t_s), 1)),
            faults=faults or NodeFaults(),
            options={"model": twin_model or model, "address": DEVICE},
        )
        device = AceinnaDevice(ride, bus, **twin)

        def hear(msg: can.Message) -> None:
            if obstinate and msg.arbitration_id >> 8 & 0xFFFF == RATE_DIVIDER:
                return  # this one keeps its rate
            if standard_requests and msg.arbitration_id >> 8 & 0xFF00 == 0xEA00:
                msg.data = msg.data[::-1]  # this one reads what the standard says
            device.received(msg)

        ear = MemoryBus(name, hear if listening else (lambda msg: None))
        setup = imu_setup("j1939", "imu", rate_hz, model=model, configure=configure)
        imu = AceinnaImu(setup, CanLink("imu", "memory", name, {}))
        task = asyncio.create_task(device.serve())
        try:
            return await main(imu, device, bus)
        finally:
            task.cancel()
            imu.close()
            ear.shutdown()
            bus.shutdown()

    return in_virtual_time(run)


@pytest.mark.parametrize("model", ["openimu300ri", "mtlt305d"])
def test_rates_and_accelerations_of_either_model_come_out_as_x_y_z(model: str) -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        return (await collect(imu, 3.0))["imu"], imu.counts("imu")

    block, counts = with_twin(main, model=model)
    n = len(block.t_ns)
    np.testing.assert_allclose(np.degrees(block.rate_rps), np.tile(RATES_DPS, (n, 1)), atol=0.004)
    np.testing.assert_allclose(block.accel_mps2, np.tile(FORCE, (n, 1)), atol=0.006)
    np.testing.assert_allclose(np.diff(block.t_ns), 10_000_000, atol=2)
    assert np.isnan(block.temperature_c).all()
    assert counts == SourceCounts(samples=n)


def test_the_wrong_order_of_axes_swaps_x_and_y() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        return (await collect(imu, 1.0))["imu"]

    block = with_twin(main, model="openimu300ri", twin_model="mtlt305d")
    np.testing.assert_allclose(np.degrees(block.rate_rps[0]), [-20.0, 10.0, 30.0], atol=0.004)


def test_a_saturated_rate_is_none() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        return (await collect(imu, 1.0))["imu"]

    block = with_twin(main, faults=NodeFaults(saturated={2}))
    assert np.isnan(block.rate_rps[:, 2]).all()
    assert np.isfinite(block.rate_rps[:, :2]).all()


def test_losses_are_found_by_the_rhythm_and_frames_of_a_wrong_length_are_counted() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        for _ in range(3):
            bus.send(can.Message(arbitration_id=0x0CF02A80, is_extended_id=True, data=bytes(7)))
        reader = asyncio.create_task(collect(imu, 6.0))
        await asyncio.sleep(2.001)
        device.faults.silent = True
        await asyncio.sleep(0.05)
        device.faults.silent = False
        return (await reader)["imu"], imu.counts("imu")

    block, counts = with_twin(main)
    assert (counts.lost, counts.repeated, counts.corrupt) == (5, 0, 3)
    assert np.diff(block.t_ns).max() == pytest.approx(60_000_000, abs=10)


def test_the_device_says_who_it_is() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Identity:
        await imu.open()
        return await imu.identify()

    told = Identity("J1939 manufacturer 823, function 131", "7654", "19.1.51 stage 2 build 1")
    assert with_twin(main, name=Name(7654, 823, 131)) == told
    assert with_twin(main, name=Name(7654, 823, 131), standard_requests=True) == told


def test_a_device_that_does_not_answer_stays_unknown_within_a_second_and_still_measures() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        start = asyncio.get_running_loop().time()
        identity = await imu.identify()
        took_s = asyncio.get_running_loop().time() - start
        return identity, took_s, (await collect(imu, 1.0))["imu"]

    identity, took_s, block = with_twin(main, listening=False)
    assert identity == Identity()
    assert took_s < 1.0
    assert len(block.t_ns) > 90


def test_settings_are_sent_and_kept() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()
        return (await collect(imu, 2.0))["imu"]

    block = with_twin(main, rate_hz=50.0, configure=True)
    np.testing.assert_allclose(np.diff(block.t_ns), 20_000_000, atol=2)


def test_a_setting_that_the_device_does_not_take_is_said_with_what_it_keeps() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> None:
        await imu.open()

    with pytest.raises(DeviceRefused, match="imu: setting FF55: requested 02, but the device keeps 01"):
        with_twin(main, rate_hz=50.0, configure=True, obstinate=True)


def test_settings_for_a_device_that_is_not_there_end_in_a_lost_link() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> None:
        await imu.open()

    with pytest.raises(LinkLost, match="imu: no answer from J1939 address 0x80 to setting FF55"):
        with_twin(main, rate_hz=50.0, configure=True, listening=False)


def test_a_late_answer_from_before_is_not_taken_for_what_the_device_has_now() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> None:
        # The device told somebody its old divider just before it was set: that answer waits in the link.
        await imu._link.open()
        bus.send(can.Message(arbitration_id=0x18FF5580, is_extended_id=True, data=bytes([0x80, 1])))
        await imu._set(RATE_DIVIDER, bytes([2]))

    with_twin(main)


def test_answers_of_another_device_are_not_taken_for_ours() -> None:
    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Identity:
        await imu.open()
        bus.send(can.Message(arbitration_id=0x18FEDA81, is_extended_id=True, data=bytes([9, 9, 9, 9, 9])))
        return await imu.identify()

    assert with_twin(main).firmware == "19.1.51 stage 2 build 1"


def test_random_frames_do_not_disturb_the_driver() -> None:
    rng = np.random.default_rng(2)

    async def main(imu: AceinnaImu, device: AceinnaDevice, bus: MemoryBus) -> Any:
        await imu.open()

        async def noise() -> None:
            while True:
                for _ in range(20):
                    identifier = int(rng.integers(1 << 29)) & ~0xFF | 0x23
                    bus.send(
                        can.Message(arbitration_id=identifier, is_extended_id=True, data=rng.bytes(rng.integers(9)))
                    )
                await asyncio.sleep(0.003)

        noisy = asyncio.create_task(noise())
        found = (await collect(imu, 3.0))["imu"]
        noisy.cancel()
        return found, imu.counts("imu")

    block, counts = with_twin(main)
    np.testing.assert_allclose(np.degrees(block.rate_rps), np.tile(RATES_DPS, (len(block.t_ns), 1)), atol=0.004)
    assert counts == SourceCounts(samples=len(block.t_ns))


def test_the_twin_answers_only_what_is_asked_of_it() -> None:
    heard: list[Frame] = []

    class Ear:
        def send(self, msg: can.Message) -> None:
            heard.append(Frame(0, msg.arbitration_id, msg.is_extended_id, bytes(msg.data)))

    device = AceinnaDevice(
        ImuTwinSetup(gyros=gyros(100.0), rate_hz=100.0, options={"model": "openimu300ri", "address": DEVICE}), Ear()
    )

    def ask(frame: Frame) -> list[str]:
        heard.clear()
        device.received(can.Message(arbitration_id=frame.identifier, is_extended_id=frame.extended, data=frame.data))
        return [f"{answer.identifier:08X} {answer.data.hex()}" for answer in heard]

    assert ask(request(SOFTWARE_VERSION, DEVICE, HOST)) == ["18FEDA80 1301330201"]
    assert ask(request(SOFTWARE_VERSION, 0x81, HOST)) == []
    assert ask(request(0xFECA, DEVICE, HOST)) == [f"18E8FF80 01ffffff{HOST:02x}00feca"]  # refused by the standard
    assert ask(command(RATE_DIVIDER, DEVICE, bytes([3]), HOST)) == []  # no divider: refused without a word
    assert ask(request(RATE_DIVIDER, DEVICE, HOST)) == ["18FF5580 8001"]
    assert ask(command(RATE_DIVIDER, DEVICE, bytes([4]), HOST)) == []
    assert ask(request(RATE_DIVIDER, DEVICE, HOST)) == ["18FF5580 8004"]
    assert ask(action(SAVE, DEVICE, HOST)) == ["18FF5180 018001"]
    assert ask(action(SAVE, 0x81, HOST)) == []
    assert device.saved == 1
