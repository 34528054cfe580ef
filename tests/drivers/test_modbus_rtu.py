"""Modbus RTU on a serial line: replies that come late, get lost or are damaged are never taken for another's answer."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import random
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from modbus_twin import modbus_server
from pymodbus.client import AsyncModbusSerialClient
from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerRTU
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.transport import NULLMODEM_HOST
from serial_wire import peer, wire
from setups import setup_of

from drivers.errors import BadReply, DeviceRefused, LinkLost
from drivers.specs import AxisSetup
from drivers.tables.modbus.line import ModbusLine, SerialPort
from drivers.tables.modbus.order import Request, RtuGate, rtu_frames
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits, LinkCounts
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import ScaledLoop, VirtualLoop

VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "modbus_cia402.json").read_text())["vectors"]
DEG = math.pi / 180
COUNTS = 65536
UNITS = (1, 2, 3)
TIMEOUT_S = 0.2
NO_SUCH_REGISTER = 0x80
_wires = itertools.count(70_000)


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    run(main, VirtualLoop)


def run(main: Callable[[], Awaitable[None]], loop: Callable[[], asyncio.AbstractEventLoop] = ScaledLoop) -> None:
    async def body() -> None:
        await main()

    with asyncio.Runner(loop_factory=loop) as runner:
        runner.run(body())


def read(unit: int, address: int, count: int) -> Request:
    return Request(axis="x", unit_id=unit, register=f"register {address}", address=address, count=count)


def write(unit: int, address: int, *words: int) -> Request:
    return Request(
        axis="x", unit_id=unit, register=f"register {address}", address=address, count=len(words), words=words
    )


def probes(units: tuple[int, ...] = UNITS) -> dict[int, list[Request]]:
    return {unit: [read(unit, 0x10, 1), read(unit, 0x20, 2)] for unit in units}


class Witness:
    """A device whose every answer tells which request it answers: the address asked, and how many it has served."""

    def __init__(self) -> None:
        self.served = 0
        self.writes: list[tuple[int, int, list[int]]] = []

    async def act(
        self, function: int, start: int, address: int, count: int, words: list[int], new: list[int] | None
    ) -> ExcCodes | None:
        if address == NO_SUCH_REGISTER:
            return ExcCodes.ILLEGAL_ADDRESS
        if new is not None:
            self.served += 1
            self.writes.append((self.served, address, list(new)))
        elif function == 3:
            self.served += 1
            told = [address, self.served] if count == 2 else [(address << 8) | self.served & 0xFF]
            words[address - start : address - start + count] = told
        return None


class Mischief:
    """Holds back, loses and damages what the devices say; each device's replies keep their order."""

    def __init__(self, rng: random.Random, worst_s: float) -> None:
        self._rng, self._worst_s = rng, worst_s
        self._last_s = dict.fromkeys(UNITS, 0.0)
        self.deliver: Callable[[bytes], None] = lambda _: None

    def __call__(self, data: bytes) -> list[bytes]:
        loop, rng = asyncio.get_running_loop(), self._rng
        if rng.random() < 0.08:
            return []
        if rng.random() < 0.05:
            spot = rng.randrange(len(data))
            data = data[:spot] + bytes((data[spot] ^ 1 << rng.randrange(8),)) + data[spot + 1 :]
        unit = data[0] if data[0] in UNITS else 1
        delay_s = 0.002 if rng.random() < 0.6 else rng.uniform(0.0, self._worst_s)
        self._last_s[unit] = max(self._last_s[unit], loop.time() + delay_s)
        cut = rng.randrange(len(data)) if rng.random() < 0.2 else 0
        for part in (data[:cut], data[cut:]):
            if part:
                loop.call_at(self._last_s[unit], self.deliver, part)
        return []


@asynccontextmanager
async def bus(mischief: Mischief | None) -> AsyncIterator[tuple[SerialPort, dict[int, Witness]]]:
    """Serve a witness at every unit id, behind the mischief from the first connection on."""
    devices = {unit: Witness() for unit in UNITS}
    block = SimData(0, count=0x200, datatype=DataType.REGISTERS)
    port = SerialPort(f"socket://{NULLMODEM_HOST}:{next(_wires)}")
    server = ModbusSerialServer(
        [SimDevice(unit, simdata=[block], action=device.act) for unit, device in devices.items()], port=port.port
    )

    def connected(is_up: bool) -> None:
        if is_up and mischief is not None:
            (handler,) = server.active_connections.values()
            transport: Any = handler.transport
            mischief.deliver = transport.other_modem.protocol.data_received
            transport.set_manipulator(mischief)

    server.trace_connect = connected
    await server.serve_forever(background=True)
    try:
        yield port, devices
    finally:
        await server.shutdown()


async def check(line: ModbusLine, device: Witness, request: Request) -> None:
    """Ask, and see that what is believed was answered to this very request."""
    before = device.served
    reply = await line.ask(request)
    if request.words:
        done = [entry for entry in device.writes if entry[0] > before]
        assert (request.address, list(request.words)) in [(address, words) for _, address, words in done]
    elif request.count == 2:
        address, served = reply.words
        assert address == request.address, "the value of another register"
        assert served > before, "the value of an earlier request"
    else:
        assert reply.words[0] >> 8 == request.address, "the value of another register"
        assert 0 < (reply.words[0] - before) & 0xFF < 0x80, "the value of an earlier request"


def some_request(rng: random.Random) -> Request:
    unit = rng.choice(UNITS)
    kind = rng.randrange(6)
    if kind == 0:
        return read(unit, rng.choice((0x10, 0x11, 0x12)), 1)
    if kind == 1:
        return write(unit, rng.choice((0x100, 0x101)), rng.randrange(3))
    if kind == 2:
        return write(unit, rng.choice((0x110, 0x112)), rng.randrange(3), 0)
    if kind == 3:
        return read(unit, NO_SUCH_REGISTER, rng.choice((1, 2)))
    return read(unit, rng.choice((0x20, 0x22, 0x24)), 2)


async def hostile_session(seed: int, requests: int, worst_s: float) -> tuple[int, LinkCounts]:
    rng = random.Random(seed)
    loop = asyncio.get_running_loop()
    believed = 0
    async with bus(Mischief(rng, worst_s)) as (port, devices):
        line = ModbusLine("table", port, TIMEOUT_S, probes())
        await line.open()
        for _ in range(requests):
            request = some_request(rng)
            wrong = request.address == NO_SUCH_REGISTER
            began_s = loop.time()
            try:
                if rng.random() < 0.1:  # whoever asks may be cancelled, and its reply come all the same
                    async with asyncio.timeout(rng.uniform(0.0, 2 * TIMEOUT_S)):
                        await check(line, devices[request.unit_id], request)
                elif rng.random() < 0.05:
                    await line.tell(request)
                    continue
                else:
                    await check(line, devices[request.unit_id], request)
                assert not wrong, "a register that is not there was read"
                believed += 1
            except DeviceRefused:
                assert wrong, "refused what the device had not refused"
            except (LinkLost, TimeoutError):
                pass
            finally:
                assert loop.time() - began_s <= 2 * TIMEOUT_S + 0.01
            await asyncio.sleep(rng.choice((0.0, 0.0, 0.01, 0.3)))
        line.close()
        await asyncio.sleep(2.0)
    return believed, line.counts


@pytest.mark.parametrize("worst_s", [0.5, 1.5])
def test_no_late_lost_or_damaged_reply_is_ever_taken_for_an_answer(worst_s: float) -> None:
    async def main() -> None:
        believed = late = 0
        for seed in range(20):
            good, counts = await hostile_session(seed, 60, worst_s)
            believed += good
            late += counts.late
        assert believed > 20 * 60 * 0.1
        assert late > 100

    virtually(main)


@pytest.mark.full
@pytest.mark.timeout(600)
def test_no_late_reply_is_ever_taken_for_an_answer_in_a_long_campaign() -> None:
    async def main() -> None:
        for seed in range(1000, 1400):
            await hostile_session(seed, 100, random.Random(seed).uniform(0.2, 2.0))

    virtually(main)


def test_the_stock_client_alone_takes_a_late_reply_for_the_next_answer() -> None:
    async def main() -> None:
        async with bus(None) as (port, _):
            client = AsyncModbusSerialClient(port.port, timeout=TIMEOUT_S, retries=0, reconnect_delay=0)
            await client.connect()
            modem: Any = client.ctx.transport
            held: list[bytes] = []

            def hold(data: bytes) -> list[bytes]:
                held.append(data)
                return []

            modem.other_modem.set_manipulator(hold)
            with pytest.raises(Exception, match="No response"):
                await client.read_holding_registers(0x20, count=2, device_id=1)
            asyncio.get_running_loop().call_later(0.01, modem.protocol.data_received, held[0])
            reply = await client.read_holding_registers(0x22, count=2, device_id=1)
            assert reply.registers[0] == 0x20  # the value of the other register
            client.close()

    virtually(main)


def test_a_line_in_step_asks_nothing_but_what_it_is_asked() -> None:
    async def main() -> None:
        async with bus(None) as (port, devices):
            line = ModbusLine("table", port, TIMEOUT_S, probes())
            await line.open()
            await line.ask(read(1, 0x20, 2))
            served = devices[1].served
            for _ in range(10):
                await line.ask(read(1, 0x20, 2))
            assert devices[1].served == served + 10
            assert line.counts == LinkCounts()
            line.close()

    virtually(main)


def test_frames_are_apart_by_three_and_a_half_characters() -> None:
    assert SerialPort("p", 9600).silence_s == pytest.approx(3.5 * 11 / 9600)
    assert SerialPort("p", 115200).silence_s == 0.00175

    async def main() -> None:
        async with bus(None) as (port, _):
            line = ModbusLine("table", port, TIMEOUT_S, probes())
            await line.open()
            replies = [await line.ask(read(1, 0x20, 2)) for _ in range(5)]
            for one, following in itertools.pairwise(replies):
                assert following.sent_s - one.received_s >= port.silence_s - 1e-9
            line.close()

    virtually(main)


def test_a_device_that_falls_silent_is_known_within_half_a_second_again_and_again_until_it_is_back() -> None:
    heard: list[bytes] = []
    alive = True

    def device(data: bytes, answer: Callable[[bytes], None]) -> None:
        heard.append(data)
        if alive and data[1] == 3:
            answer(sealed(bytes((data[0], 3, 2 * data[5])) + bytes(2 * data[5])))

    async def main() -> None:
        nonlocal alive
        loop = asyncio.get_running_loop()
        with peer(device) as port:
            line = ModbusLine("table", SerialPort(port), TIMEOUT_S, probes((1,)))
            await line.open()
            assert (await line.ask(read(1, 0x20, 2))).words == (0, 0)
            alive = False
            for _ in range(3):
                began_s = loop.time()
                with pytest.raises(
                    LinkLost, match=r"axis x \(unit id 1\) does not answer within 0.4 " r"s after two requests"
                ):
                    await line.ask(read(1, 0x20, 2))
                assert loop.time() - began_s < 0.5
            alive = True
            assert (await line.ask(read(1, 0x20, 2))).words == (0, 0)
            line.close()

    run(main)


def test_a_line_dead_for_long_is_not_asked_ever_more_and_comes_back_at_once() -> None:
    def device(data: bytes, answer: Callable[[bytes], None]) -> None:
        nonlocal heard
        heard += 1
        if alive:
            answer(sealed(bytes((data[0], 3, 2 * data[5])) + bytes(2 * data[5])))

    heard, alive = 0, False

    async def main() -> None:
        nonlocal alive
        loop = asyncio.get_running_loop()
        with peer(device) as port:
            line = ModbusLine("table", SerialPort(port), TIMEOUT_S, probes((1,)))
            await line.open()
            began_s = loop.time()
            while loop.time() < began_s + 20.0:
                with pytest.raises(LinkLost):
                    await line.ask(read(1, 0x20, 2))
            assert heard < 20 * 20.0
            alive = True
            began_s = loop.time()
            while True:
                try:
                    await line.ask(read(1, 0x20, 2))
                    break
                except LinkLost:
                    assert loop.time() - began_s < 10.0
            line.close()

    run(main, lambda: ScaledLoop(5))


def sealed(frame: bytes) -> bytes:
    return frame + FramerRTU.compute_CRC(frame).to_bytes(2, "big")


def vector(meaning: str) -> bytes:
    (found,) = [v["hex"] for v in VECTORS if meaning in json.dumps(v["decoded"])]
    return bytes.fromhex(found)


@pytest.mark.parametrize("code", [0x81, 0x83])
def test_a_refusal_as_kinco_prints_it_and_as_the_standard_has_it_is_a_refusal(code: int) -> None:
    refusal = sealed(bytes((1, code, 2)))
    assert code == 0x83 or refusal == vector("exception as the manual")

    def device(data: bytes, answer: Callable[[bytes], None]) -> None:
        if data[2:4] == b"\x00\x80":
            answer(refusal)
        else:
            answer(sealed(bytes((data[0], 3, 2 * data[5])) + bytes(2 * data[5])))

    async def main() -> None:
        with peer(device) as port:
            line = ModbusLine("table", SerialPort(port), TIMEOUT_S, probes((1,)))
            await line.open()
            with pytest.raises(DeviceRefused, match="read 0x0080 .*Modbus exception 2, illegal register address"):
                await line.ask(read(1, 0x80, 1))
            assert (await line.ask(read(1, 0x20, 2))).words == (0, 0)
            line.close()

    run(main)


def test_a_port_that_is_not_there_is_a_lost_link_that_says_what_to_look_at() -> None:
    async def main() -> None:
        line = ModbusLine("table", SerialPort("/dev/no_such_port"), TIMEOUT_S, probes())
        with pytest.raises(LinkLost, match="cannot open serial port /dev/no_such_port. Is it plugged in"):
            await line.open()

    run(main)


def test_a_port_that_goes_away_is_a_lost_link() -> None:
    async def main() -> None:
        with peer(lambda data, answer: answer(sealed(data[:2] + bytes((2 * data[5], *bytes(2 * data[5])))))) as port:
            line = ModbusLine("table", SerialPort(port), TIMEOUT_S, probes((1,)))
            await line.open()
            await line.ask(read(1, 0x20, 2))
        with pytest.raises(LinkLost, match="table: "):
            await line.ask(read(1, 0x20, 2))
        with pytest.raises(LinkLost, match=f"the connection to {port} is gone"):
            await line.ask(read(1, 0x20, 2))
        line.close()

    run(main)


def test_drives_whose_values_are_all_of_one_width_are_refused_on_a_serial_line() -> None:
    async def main() -> None:
        drives = {"x": AxisSetup(1, COUNTS, AxisLimits(1.0, 1.0))}
        table = ModbusTable(
            setup_of("modbus", drives, TIMEOUT_S, profile=load_profile("lexium32")), SerialPort("/dev/null")
        )
        with pytest.raises(DeviceRefused, match="the same width.*Use Modbus TCP"):
            await table.open()

    run(main)


def table_on(port: SerialPort, timeout_s: float) -> ModbusTable:
    limits = AxisLimits(100 * DEG, 50 * DEG)
    drives = {axis: AxisSetup(unit, COUNTS, limits) for axis, unit in zip("xyz", UNITS, strict=True)}
    return ModbusTable(setup_of("modbus", drives, timeout_s, profile=load_profile("kinco")), port)


@asynccontextmanager
async def table_twin(port: SerialPort) -> AsyncIterator[TableModel]:
    data = {axis: AxisData(100 * DEG, 50 * DEG, COUNTS, 0.5 * DEG) for axis in "xyz"}
    model = TableModel(data, asyncio.get_running_loop().time)
    server = modbus_server(
        TableTwinSetup(model, dict(zip("xyz", UNITS, strict=True)), {"profile": load_profile("kinco")}, 0.0), port
    )
    await server.serve_forever(background=True)
    try:
        yield model
    finally:
        await server.shutdown()


def test_three_stations_on_one_serial_line_make_a_table() -> None:
    async def main() -> None:
        with wire() as (near, far):
            async with table_twin(SerialPort(far, 115200, "N", 2)) as model:
                table = table_on(SerialPort(near, 115200, "N", 2), 2.0)
                await table.open()
                await table.enable()
                await table.home()
                for axis, rate in zip("xyz", (20, -30, 40), strict=True):
                    await table.jog(axis, rate * DEG, 50 * DEG)
                await asyncio.sleep(2.0)
                for axis, rate in zip("xyz", (20, -30, 40), strict=True):
                    state = await table.read(axis)
                    truth = float(model.motion[axis].at(state.angle_t_ns * 1e-9)[0])
                    slack = abs(rate) * DEG * state.half_width_ns * 1e-9 + 2 * math.pi / COUNTS
                    assert state.angle_rad == pytest.approx(truth, abs=slack)
                    assert state.rate_rps == pytest.approx(rate * DEG, rel=1e-4)
                await table.stop()
                assert model.at_rest()
                await table.disable()
                table.close()

    run(main, lambda: ScaledLoop(10))


def test_readings_over_a_line_that_holds_replies_back_are_those_of_their_instants() -> None:
    rng = random.Random(4)

    def delay_s() -> float:
        return 0.0 if rng.random() < 0.95 else rng.uniform(0.0, 1.0)

    async def main() -> None:
        with wire(delay_s) as (near, far):
            async with table_twin(SerialPort(far)) as model:
                table = table_on(SerialPort(near), 0.2)
                for axis, motion in model.motion.items():
                    motion.jog(model.clock(), {"x": 90, "y": -60, "z": 30}[axis] * DEG, 0.0)
                await opened(table)
                read_well = 0
                end_s = model.clock() + 12.0
                while model.clock() < end_s:
                    axis = rng.choice("xyz")
                    try:
                        state = await table.read(axis)
                    except LinkLost:
                        continue
                    read_well += 1
                    earliest, latest = (
                        model.motion[axis].at((state.angle_t_ns + side * state.half_width_ns) * 1e-9)[0]
                        for side in (-1, 1)
                    )
                    low, high = sorted((earliest, latest))
                    count = 2 * math.pi / COUNTS
                    assert low - count <= state.angle_rad + 0.5 * DEG <= high + count
                    assert abs(state.rate_rps) <= 100 * DEG
                assert read_well > 20
                assert table.counts.late > 5
                table.close()

    async def opened(table: ModbusTable) -> None:
        async with asyncio.timeout(10.0):
            while True:
                try:
                    return await table.open()
                except LinkLost:
                    table.close()

    run(main, lambda: ScaledLoop(4))


FRAMES = st.sampled_from(
    [sealed(bytes((1, 3, 2, 7, 7))), sealed(bytes((2, 3, 4, 0, 1, 2, 3))), sealed(bytes((1, 6, 0x31, 0, 0, 0x0F)))]
)
AWAITED = sealed(bytes((1, 3, 4, 9, 8, 7, 6)))


@given(st.lists(FRAMES, max_size=4), st.lists(FRAMES, max_size=4), st.data())
def test_the_awaited_frame_comes_through_once_however_the_input_is_cut(
    before: list[bytes], after: list[bytes], data: st.DataObject
) -> None:
    stream = b"".join(before) + AWAITED + b"".join(after)
    cuts = sorted(data.draw(st.sets(st.integers(1, len(stream)), max_size=8)))
    gate = RtuGate(LinkCounts())
    gate.expect(AWAITED[:3])
    assert gate(True, b"request") == b"request"
    through = [passed for end in (*cuts, len(stream)) if (passed := gate(False, stream[:end]))]
    assert through == [AWAITED]


@given(st.binary(max_size=40), st.binary(max_size=40))
def test_bytes_between_frames_do_not_hide_a_frame(before: bytes, after: bytes) -> None:
    # Noise may by chance hold the beginning of a frame only if its CRC is right: then it would be one.
    assert AWAITED in b"".join(rtu_frames(before + AWAITED + after)) or list(rtu_frames(before + AWAITED[:-1]))


def test_every_cut_of_every_reply_gives_the_same() -> None:
    for awaited in (AWAITED, sealed(bytes((1, 6, 0x31, 0, 0, 0x0F))), vector("exception as the manual")):
        for cut in range(len(awaited)):
            gate = RtuGate(LinkCounts())
            gate.expect(awaited[:2])
            gate(True, b"")
            assert gate(False, awaited[:cut]) == b""
            assert gate(False, awaited) == awaited


def test_a_reply_with_a_wrong_crc_is_dropped_and_counted() -> None:
    counts = LinkCounts()
    gate = RtuGate(counts)
    gate.expect(AWAITED[:3])
    gate(True, b"")
    damaged = bytearray(AWAITED)
    damaged[4] ^= 0x10
    assert gate(False, bytes(damaged)) == b""
    gate(True, b"")
    assert counts == LinkCounts(corrupt=1)


@settings(max_examples=50)
@given(st.binary(min_size=2000, max_size=4000))
def test_random_bytes_never_raise_and_never_come_through(noise: bytes) -> None:
    gate = RtuGate(LinkCounts())
    gate.expect(bytes((1, 3, 4)))
    gate(True, b"")
    for at in range(0, len(noise), 250):
        assert gate(False, noise[at : at + 250]) == b""


@pytest.mark.full
def test_ten_million_random_bytes_never_raise() -> None:
    rng = random.Random(1)
    gate = RtuGate(LinkCounts())
    for _ in range(10_000_000 // 250):
        gate.expect(bytes((1, 3, 4)))
        gate(True, b"")
        gate(False, rng.randbytes(250))


@pytest.mark.parametrize("v", [v for v in VECTORS if v["transport"] == "rtu"], ids=lambda v: v["hex"])
def test_every_rtu_vector_has_the_right_crc_and_one_wrong_bit_spoils_it(v: dict[str, Any]) -> None:
    frame = bytes.fromhex(v["hex"])
    assert sealed(frame[:-2]) == frame
    for bit in range(8 * len(frame)):
        spoilt = bytearray(frame)
        spoilt[bit // 8] ^= 1 << bit % 8
        assert not FramerRTU.check_CRC(bytes(spoilt[:-2]), int.from_bytes(spoilt[-2:]))


def test_a_transaction_number_that_was_answered_is_not_taken_for_a_late_reply() -> None:
    async def main() -> None:
        async def gateway(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            first = True
            while request := await reader.read(12):
                number = request[:2] if first else b"\x00\x01"
                writer.write(number + bytes((0, 0, 0, 7, request[6], 3, 4)) + request[8:10] + bytes(2))
                first = False
            writer.close()

        server = await asyncio.start_server(gateway, "127.0.0.1", 0)
        line = ModbusLine("table", server.sockets[0].getsockname()[:2], 0.05, {})
        await line.open()
        await line.ask(read(1, 0x22, 2))
        with pytest.raises(BadReply, match="transaction numbers that were not requested"):
            await line.ask(read(1, 0x20, 2))
        line.close()
        server.close()
        await server.wait_closed()
        await asyncio.sleep(0.01)

    run(main)


def test_a_gateway_that_zeroes_transaction_numbers_is_refused_and_one_that_keeps_them_may_be_late() -> None:
    held: list[bytes] = []

    async def main(zeroed: bool) -> None:
        left = asyncio.Event()

        async def gateway(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while request := await reader.read(12):
                number = b"\x00\x00" if zeroed else request[:2]
                reply = number + bytes((0, 0, 0, 7, request[6], 3, 4)) + request[8:10] + bytes(2)
                if request[8:10] == b"\x00\x20" and not zeroed:
                    held.append(reply)  # comes together with the next answer
                    continue
                writer.write(b"".join(held) + reply)
                held.clear()
            writer.close()
            await writer.wait_closed()
            left.set()

        server = await asyncio.start_server(gateway, "127.0.0.1", 0)
        line = ModbusLine("table", server.sockets[0].getsockname()[:2], 0.05, {})
        await line.open()
        if zeroed:
            with pytest.raises(BadReply, match="transaction numbers that were not requested"):
                await line.ask(read(1, 0x22, 2))
            assert line.counts.foreign == 2
        else:
            with pytest.raises(LinkLost):
                await line.ask(read(1, 0x20, 2))
            assert (await line.ask(read(1, 0x22, 2))).words == (0x22, 0)
            assert line.counts.late == 2
        line.close()
        await left.wait()
        server.close()
        await server.wait_closed()

    run(lambda: main(True))
    run(lambda: main(False))
