"""Modbus clients that are not ours read the twin of a table of drives, walk them to operation and turn them."""

from __future__ import annotations

import asyncio
import math
import socket
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from modbus_twin import modbus_server
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from serial_wire import wire
from strangers import needs_program, needs_python

from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import ScaledLoop

DEG = math.pi / 180
COUNTS = 65536
RATE_RPS = 36 * DEG
UNIT_IDS = {"x": 1, "y": 2, "z": 3}
PROFILE = load_profile("kinco")
CONTROLWORD, STATUSWORD, RATE, ACCELERATION, TARGET_RATE = 0x3100, 0x3200, 0x3B00, 0x4B00, 0x6F00
WALK = (0x06, 0x07, 0x0F)
"""Controlwords from switch on disabled to operation enabled."""
RAW_RATE = round(0.1 * 60 * 512 / 1875 * COUNTS)
"""What the rate register holds at 36 deg/s."""

mbpoll = needs_program("mbpoll", "mbpoll")
transports = pytest.mark.parametrize("transport", ["tcp", "rtu"])


def run(main: Callable[[], Awaitable[None]]) -> None:
    async def body() -> None:
        await main()

    with asyncio.Runner(loop_factory=ScaledLoop) as runner:
        runner.run(body())


@asynccontextmanager
async def served(transport: str) -> AsyncIterator[Address]:
    """Serve a table twin whose axis y turns at 36 deg/s, and give the address for a client."""
    data = {axis: AxisData(100 * DEG, 50 * DEG, COUNTS) for axis in "xyz"}
    model = TableModel(data, asyncio.get_running_loop().time)
    model.motion["y"].jog(-10.0, RATE_RPS, 50 * DEG)
    with wire() as (near, far):
        bound: Address = ("127.0.0.1", 0) if transport == "tcp" else SerialPort(far, 115200)
        server: Any = modbus_server(TableTwinSetup(model, UNIT_IDS, {"profile": PROFILE}, 0.0), bound)
        await server.serve_forever(background=True)
        try:
            yield server.transport.sockets[0].getsockname() if transport == "tcp" else SerialPort(near, 115200)
        finally:
            await server.shutdown()
            await asyncio.sleep(0.05)


async def output_of(*command: str) -> str:
    process = await asyncio.create_subprocess_exec(
        *command, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT
    )
    async with asyncio.timeout(20):
        output, _ = await process.communicate()
    return output.decode()


def mbpoll_words(address: Address) -> list[str]:
    if isinstance(address, SerialPort):
        return ["mbpoll", address.port, "-m", "rtu", "-b", str(address.baud), "-P", "none", "-0", "-1"]
    return ["mbpoll", address[0], "-m", "tcp", "-p", str(address[1]), "-0", "-1"]


@transports
def test_the_stock_client_reads_and_moves_the_twin(transport: str) -> None:
    async def main() -> None:
        async with served(transport) as address:
            client: Any
            if isinstance(address, SerialPort):
                client = AsyncModbusSerialClient(address.port, baudrate=address.baud, timeout=2.0)
            else:
                client = AsyncModbusTcpClient(address[0], port=address[1], timeout=2.0)
            await client.connect()
            reply = await client.read_holding_registers(RATE, count=2, device_id=2)
            assert (
                client.convert_from_registers(reply.registers, client.DATATYPE.INT32, word_order="little") == RAW_RATE
            )
            for word in (0x06, 0x07, 0x0F):
                await client.write_register(0x3100, word, device_id=1)
            reply = await client.read_holding_registers(STATUSWORD, count=1, device_id=1)
            assert reply.registers[0] & 0x6F == 0x27
            assert (await client.read_holding_registers(0x3201, count=1, device_id=1)).exception_code == 2
            client.close()
            await asyncio.sleep(0.05)

    run(main)


@mbpoll
@transports
def test_mbpoll_reads_every_station_of_the_twin(transport: str) -> None:
    async def main() -> None:
        async with served(transport) as address:
            read = mbpoll_words(address)
            printed = await output_of(*read, "-a", "1,2,3", "-t", "4:hex", "-r", str(STATUSWORD), "-c", "1")
            words = [line.split()[-1] for line in printed.splitlines() if line.startswith("[12800]")]
            assert words == ["0x1450", "0x0450", "0x1450"]  # bit 12: speed zero
            printed = await output_of(*read, "-a", "2", "-t", "4:int", "-r", str(RATE), "-c", "1")
            (line,) = [line for line in printed.splitlines() if line.startswith("[15104]")]
            assert int(line.split()[-1]) == RAW_RATE
            printed = await output_of(*read, "-a", "1", "-t", "4", "-r", str(STATUSWORD + 1), "-c", "1")
            assert "Illegal data address" in printed

    run(main)


@mbpoll
@transports
def test_mbpoll_walks_a_drive_to_operation(transport: str) -> None:
    async def main() -> None:
        async with served(transport) as address:
            write = mbpoll_words(address)
            for word in ("6", "7", "15"):
                printed = await output_of(*write, "-a", "3", "-t", "4", "-r", str(0x3100), word)
                assert "Written 1 references" in printed
            printed = await output_of(*write, "-a", "3", "-t", "4:hex", "-r", str(STATUSWORD), "-c", "1")
            assert "0x1437" in printed

    run(main)


@needs_python("minimalmodbus", "minimalmodbus")
def test_minimalmodbus_over_rtu() -> None:
    def ask(address: Address) -> None:
        import minimalmodbus

        assert isinstance(address, SerialPort)
        drive, turning = (minimalmodbus.Instrument(address.port, unit) for unit in (3, 2))
        drive.serial.baudrate = address.baud
        order = {"signed": True, "byteorder": minimalmodbus.BYTEORDER_LITTLE_SWAP}
        assert turning.read_long(RATE, **order) == RAW_RATE
        for word in WALK:
            drive.write_register(CONTROLWORD, word, functioncode=6)
        assert drive.read_register(STATUSWORD) & 0x6F == 0x27
        drive.write_long(TARGET_RATE, RAW_RATE // 10, **order)
        drive.write_long(ACCELERATION, 2**20, byteorder=minimalmodbus.BYTEORDER_LITTLE_SWAP)
        drive.write_register(CONTROLWORD, 15, functioncode=6)
        time.sleep(0.3)
        assert drive.read_long(RATE, **order) == pytest.approx(RAW_RATE // 10, rel=1e-3)
        drive.write_register(CONTROLWORD, 11, functioncode=6)  # quick stop
        time.sleep(0.3)
        assert drive.read_long(RATE, **order) == 0
        with pytest.raises(minimalmodbus.IllegalRequestError):
            drive.read_register(STATUSWORD + 1)
        drive.serial.close()

    beside("rtu", ask)


@needs_python("pyModbusTCP", "pyModbusTCP")
def test_pymodbustcp_over_tcp() -> None:
    def ask(address: Address) -> None:
        from pyModbusTCP.client import ModbusClient
        from pyModbusTCP.utils import word_list_to_long

        assert not isinstance(address, SerialPort)
        client = ModbusClient(address[0], address[1], unit_id=2, timeout=2.0)
        assert word_list_to_long(client.read_holding_registers(RATE, 2), big_endian=False) == [RAW_RATE]
        client.unit_id = 1
        assert all(client.write_single_register(CONTROLWORD, word) for word in WALK)
        assert client.read_holding_registers(STATUSWORD)[0] & 0x6F == 0x27
        assert client.write_multiple_registers(TARGET_RATE, [RAW_RATE & 0xFFFF, RAW_RATE >> 16])
        assert client.read_holding_registers(STATUSWORD + 1) is None
        assert client.last_except == 2
        assert client.read_input_registers(STATUSWORD) is None
        assert client.last_except == 1
        client.close()

    beside("tcp", ask)


@needs_python("umodbus", "uModbus")
def test_umodbus_over_tcp() -> None:
    def ask(address: Address) -> None:
        from umodbus import conf
        from umodbus.client import tcp
        from umodbus.exceptions import IllegalDataAddressError, IllegalDataValueError

        assert not isinstance(address, SerialPort)
        conf.SIGNED_VALUES = False
        with socket.create_connection(address[:2], timeout=2.0) as wire:
            low, high = tcp.send_message(tcp.read_holding_registers(2, RATE, 2), wire)
            assert low | high << 16 == RAW_RATE
            for word in WALK:
                assert tcp.send_message(tcp.write_single_register(3, CONTROLWORD, word), wire) == word
            assert tcp.send_message(tcp.read_holding_registers(3, STATUSWORD, 1), wire)[0] & 0x6F == 0x27
            with pytest.raises(IllegalDataValueError):  # ten times as fast as it may
                tcp.send_message(tcp.write_multiple_registers(3, TARGET_RATE, [0, 0x7000]), wire)
            with pytest.raises(IllegalDataAddressError):
                tcp.send_message(tcp.read_holding_registers(3, STATUSWORD + 1, 1), wire)

    beside("tcp", ask)


def beside(transport: str, ask: Callable[[Address], None]) -> None:
    """Let a client that blocks ask in a thread of its own, while the twin is served."""

    async def main() -> None:
        async with served(transport) as address:
            await asyncio.to_thread(ask, address)

    run(main)
