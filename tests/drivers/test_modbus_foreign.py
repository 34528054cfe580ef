"""Modbus programs that are not ours: the stock client and mbpoll read the table twin, a libmodbus server is driven."""

from __future__ import annotations

import asyncio
import math
import shutil
import subprocess
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from modbus_twin import modbus_server
from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from serial_wire import wire
from setups import setup_of

from drivers.specs import AxisSetup
from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits
from sims.physics.table import AxisData, TableModel
from sims.wires.line_controller import Seat
from station.run.event_loop.loops import ScaledLoop

DEG = math.pi / 180
COUNTS = 65536
RATE_RPS = 36 * DEG
UNIT_IDS = {"x": 1, "y": 2, "z": 3}
PROFILE = load_profile("kinco")
STATUSWORD, RATE = 0x3200, 0x3B00
RAW_RATE = round(0.1 * 60 * 512 / 1875 * COUNTS)
"""What the rate register holds at 36 deg/s."""

mbpoll = pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed (apt install mbpoll)")
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
        server: Any = modbus_server(Seat(model, UNIT_IDS, {"profile": PROFILE}, 0.0), bound)
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


@pytest.fixture(scope="module")
def libmodbus_server(tmp_path_factory: pytest.TempPathFactory) -> str:
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler (cc)")
    program = str(tmp_path_factory.mktemp("libmodbus") / "server")
    source = str(Path(__file__).with_name("libmodbus_server.c"))
    command = [compiler, "-I/usr/include/modbus", "-o", program, source, "-lmodbus"]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    if "modbus.h" in built.stderr:
        pytest.skip("libmodbus is not installed (apt install libmodbus-dev)")
    assert built.returncode == 0, built.stderr
    return program


@transports
def test_a_drive_served_by_libmodbus_is_enabled_jogged_read_and_stopped(libmodbus_server: str, transport: str) -> None:
    async def main() -> None:
        with wire() as (near, far):
            arguments = ["tcp"] if transport == "tcp" else ["rtu", far]
            server = await asyncio.create_subprocess_exec(
                libmodbus_server, *arguments, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.DEVNULL
            )
            assert server.stdout is not None
            port = int(await server.stdout.readline())
            address: Address = ("127.0.0.1", port) if transport == "tcp" else SerialPort(near, 115200)
            drives = {"x": AxisSetup(1, COUNTS, AxisLimits(100 * DEG, 50 * DEG))}
            table = ModbusTable(setup_of("modbus", drives, 0.5, profile=PROFILE), address)
            await table.open()
            assert (await table.status("x")).text == "switch on disabled"
            await table.enable()
            assert (await table.status("x")).enabled
            await table.jog("x", -12.5 * DEG, 20 * DEG)
            state = await table.read("x")
            assert state.rate_rps == pytest.approx(-12.5 * DEG, rel=1e-4)
            assert state.angle_rad == 0.0
            await table.stop()
            assert (await table.status("x")).text == "quick stop active"
            table.close()
            if transport == "rtu":
                server.terminate()
            await server.wait()
            await asyncio.sleep(0)

    run(main)
