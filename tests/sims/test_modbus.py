"""The drives' twin on Modbus, byte by byte: what is refused and how, where frames end, who answers at all."""

from __future__ import annotations

import asyncio
import itertools
import json
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from modbus_twin import modbus_server
from pymodbus.framer import FramerRTU
from pymodbus.transport import NULLMODEM_HOST, CommParams, CommType, ModbusProtocol

from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import VirtualLoop

REFUSALS = json.loads((Path(__file__).parents[1] / "vectors" / "modbus_refusals.json").read_text())["vectors"]
STATUS, POSITION = "0332000001", "0337000002"
_wires = itertools.count(90_000)


class Master(ModbusProtocol):
    """The far end of a null modem, which keeps what it hears."""

    def __init__(self, address: Address) -> None:
        rtu = isinstance(address, SerialPort)
        host, port = (address.port, 0) if isinstance(address, SerialPort) else address
        kind = CommType.SERIAL if rtu else CommType.TCP
        super().__init__(CommParams(comm_type=kind, host=host, port=port, timeout_connect=1.0), False)
        self.rtu, self.heard, self.gone = rtu, b"", False

    def callback_connected(self) -> None:
        self.heard, self.gone = b"", False

    def callback_disconnected(self, exc: Exception | None) -> None:
        self.gone = True

    def data_received(self, data: bytes) -> None:
        self.heard += data

    def request(self, unit: int, pdu: bytes, number: int = 1) -> bytes:
        """Return a request as it goes over the wire."""
        if not self.rtu:
            return struct.pack(">HHHB", number, 0, len(pdu) + 1, unit) + pdu
        frame = bytes([unit]) + pdu
        return frame + FramerRTU.compute_CRC(frame).to_bytes(2, "big")

    async def ask(self, *parts: bytes, wait_s: float = 0.1) -> list[bytes]:
        """Send these parts one at once after the other and return the PDUs that come within a while."""
        self.heard = b""
        for part in parts:
            self.send(part)
        await asyncio.sleep(wait_s)
        if self.rtu:
            return [self.heard[1:-2]] if self.heard else []
        found, rest = [], self.heard
        while rest:
            end = 6 + int.from_bytes(rest[4:6], "big")
            found.append(rest[7:end])
            rest = rest[end:]
        return found


@asynccontextmanager
async def served(transport: str) -> AsyncIterator[tuple[Master, TableModel]]:
    number = next(_wires)
    address: Address = (
        (NULLMODEM_HOST, number) if transport == "tcp" else SerialPort(f"socket://{NULLMODEM_HOST}:{number}")
    )
    table = TableModel({axis: AxisData(1.0, 1.0, 65536) for axis in "xy"}, asyncio.get_running_loop().time)
    server = modbus_server(TableTwinSetup(table, {"x": 1, "y": 2}, {"profile": load_profile("kinco")}, 0.0), address)
    await server.serve_forever(background=True)
    master = Master(address)
    assert await master.connect()
    try:
        yield master, table
    finally:
        master.close()
        await server.shutdown()


def virtually(transport: str, main: Callable[[Master, TableModel], Awaitable[None]]) -> None:
    async def run() -> None:
        async with served(transport) as (master, table):
            await main(master, table)

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


def pdu(text: str) -> bytes:
    return bytes.fromhex(text)


async def answers(master: Master, unit: int = 1) -> bool:
    """Return whether a sound request is answered with the statusword, switch on disabled."""
    found = await master.ask(master.request(unit, pdu(STATUS)))
    return [reply[:2] for reply in found] == [b"\x03\x02"] and found[0][3] & 0x4F == 0x40


@pytest.mark.parametrize("transport", ["tcp", "rtu"])
def test_what_the_drive_does_not_have_is_refused_with_the_code_of_the_specification(transport: str) -> None:
    async def main(master: Master, _: TableModel) -> None:
        for vector in REFUSALS:
            found = await master.ask(master.request(1, pdu(vector["request"])))
            assert found == [pdu(vector["reply"])], vector
            assert await answers(master)

    virtually(transport, main)


def test_each_of_three_requests_in_one_segment_is_answered_in_order() -> None:
    async def main(master: Master, _: TableModel) -> None:
        asked = [(1, STATUS), (2, POSITION), (1, POSITION)]
        together = b"".join(master.request(unit, pdu(text), 7 + i) for i, (unit, text) in enumerate(asked))
        assert [reply[:2] for reply in await master.ask(together)] == [b"\x03\x02", b"\x03\x04", b"\x03\x04"]
        heard = master.heard
        assert [heard[at : at + 2] for at in (0, 11, 24)] == [bytes([0, number]) for number in (7, 8, 9)]

    virtually("tcp", main)


def test_a_request_may_be_cut_anywhere_on_tcp() -> None:
    async def main(master: Master, _: TableModel) -> None:
        whole = master.request(1, pdu(STATUS)) * 2
        assert len(await master.ask(*(bytes([byte]) for byte in whole))) == 2

    virtually("tcp", main)


def test_a_frame_of_another_protocol_is_discarded() -> None:
    async def main(master: Master, _: TableModel) -> None:
        foreign = bytes.fromhex("000100050006010332000001")
        assert len(await master.ask(foreign + master.request(1, pdu(STATUS)))) == 1

    virtually("tcp", main)


@pytest.mark.parametrize(
    "nonsense", [b"GET / HTTP/1.1\r\n\r\n", bytes(20), b"\xff" * 300], ids=["text", "zeros", "ones"]
)
def test_nonsense_ends_a_connection_and_the_next_one_is_served(nonsense: bytes) -> None:
    async def main(master: Master, _: TableModel) -> None:
        assert await master.ask(nonsense) == []
        assert master.gone
        assert await master.connect()
        assert await answers(master)

    virtually("tcp", main)


def test_a_unit_that_is_not_there_is_named_by_a_gateway_and_silent_on_a_serial_line() -> None:
    async def tcp(master: Master, _: TableModel) -> None:
        assert await master.ask(master.request(9, pdu(STATUS))) == [pdu("830b")]

    async def rtu(master: Master, _: TableModel) -> None:
        assert await master.ask(master.request(9, pdu(STATUS))) == []
        assert await master.ask(master.request(9, pdu("41"))) == []
        assert await answers(master)

    virtually("tcp", tcp)
    virtually("rtu", rtu)


def test_a_broadcast_is_carried_out_by_all_and_answered_by_none() -> None:
    async def main(master: Master, _: TableModel) -> None:
        assert await master.ask(master.request(0, pdu("0631000006"))) == []
        assert await master.ask(master.request(0, pdu(STATUS))) == []
        for unit in (1, 2):
            (reply,) = await master.ask(master.request(unit, pdu(STATUS)))
            assert reply[3] & 0x6F == 0x21  # ready to switch on

    virtually("rtu", main)


def test_silence_of_three_and_a_half_characters_ends_a_frame() -> None:
    async def main(master: Master, _: TableModel) -> None:
        whole = master.request(1, pdu(STATUS))
        assert await master.ask(whole[:5]) == []
        assert await answers(master), "what came before the silence is not part of the frame"
        assert await master.ask(whole[:5]) == []
        assert await master.ask(whole[5:]) == [], "a frame with a pause in it is none"
        assert await answers(master)
        assert len(await master.ask(whole[:5], whole[5:])) == 1, "without a pause it is one"

    virtually("rtu", main)


@pytest.mark.parametrize("before", [b"\x55", b"\xff" * 3, bytes(range(64))], ids=["one", "three", "many"])
def test_a_frame_needs_silence_before_and_after_it(before: bytes) -> None:
    async def main(master: Master, _: TableModel) -> None:
        whole = master.request(1, pdu(STATUS))
        assert await master.ask(before + whole) == []
        assert await answers(master)
        assert await master.ask(whole + before) == []
        assert await answers(master)
        damaged = bytearray(whole)
        damaged[-1] ^= 1
        assert await master.ask(bytes(damaged)) == []
        assert await answers(master)

    virtually("rtu", main)
