"""The protocol side of the table twin: drives behind a stock pymodbus server, on TCP or RTU."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.modbus_line import Address, SerialPort
from drivers.registers import DriveProfile, Register
from sims.drive import Drive
from sims.faults import Line, Silence, WireFaults, damaged
from sims.table import TableModel


class FaultyModbus:
    """What a wire does to requests and replies on it."""

    def __init__(self, faults: WireFaults, seed: int | tuple[int, ...]) -> None:
        """Must be made within a running loop."""
        self._faults = faults
        self._random = np.random.default_rng(seed)
        self._silence = Silence(faults)
        # A reply is late by what request and reply take: the stock server has no place for two requests at once.
        both = replace(faults, latency_s=2 * faults.latency_s, jitter_s=2 * faults.jitter_s)
        self._line = Line(self._write, both, self._random)
        self.server: ModbusTcpServer | ModbusSerialServer | None = None

    def trace(self, sending: bool, data: bytes) -> bytes:
        """Return what comes through of a frame at once."""
        if self._silence.now or self._random.random() < self._faults.loss:
            return b""
        data = damaged(data, self._faults, self._random)
        if not sending or not self._faults.delays:
            return data
        self._line.put(data)
        return b""

    def _write(self, data: bytes) -> None:
        for connection in list(self.server.active_connections.values()) if self.server is not None else ():
            if connection.transport is not None:
                connection.transport.write(data)  # type: ignore[attr-defined]


def pull_plug(server: ModbusTcpServer | ModbusSerialServer) -> None:
    """Close all connections of a server and have it listen no more, until ``listen`` is called at the same address."""
    for bound in getattr(server.transport, "sockets", ()):
        server.init_setup_connect_listen(*bound.getsockname()[:2])  # also where any port was asked for
    server.close()


class DriveRegisters:
    """Translates Modbus requests into reads and writes of one drive."""

    def __init__(self, drive: Drive, profile: DriveProfile, counts_per_turn: int) -> None:
        """``counts_per_turn`` scales the registers, as the profile says."""
        self._drive = drive
        self._counts = counts_per_turn
        self._by_address: dict[int, Register] = {r.address: r for r in profile.registers.values()}

    async def act(
        self, _function: int, start: int, address: int, count: int, words: list[int], new: list[int] | list[bool] | None
    ) -> ExcCodes | None:
        """Serve one request; a register that is not there, or only half of one, is an illegal address."""
        self._drive.heard()
        done = 0
        while done < count:
            register = self._by_address.get(address + done)
            if register is None or done + register.words > count:
                return ExcCodes.ILLEGAL_ADDRESS
            if new is None:
                offset = address + done - start
                value = self._drive.read(register.name)
                words[offset : offset + register.words] = register.encode(value, self._counts)
            else:
                value = register.decode([int(w) for w in new[done : done + register.words]], self._counts)
                if not self._drive.commanded_by_us(register.name):
                    return ExcCodes.DEVICE_FAILURE
                if not self._drive.accepts(register.name, value):
                    return ExcCodes.ILLEGAL_VALUE
                self._drive.write(register.name, value)
            done += register.words
        return None


def modbus_server(
    table: TableModel,
    profile: DriveProfile,
    unit_ids: Mapping[str, int],
    address: Address,
    watchdog_s: float,
    faults: FaultyModbus | None = None,
) -> ModbusTcpServer | ModbusSerialServer:
    """Return a server, not yet listening, with one unit id an axis; at a host and port, or on a serial line."""
    devices = []
    low = min(r.address for r in profile.registers.values())
    high = max(r.address + r.words for r in profile.registers.values())
    for axis, unit_id in unit_ids.items():
        drive = Drive(table, axis, profile, watchdog_s)
        registers = DriveRegisters(drive, profile, table.data[axis].counts_per_turn)
        block = SimData(low, count=high - low, datatype=DataType.REGISTERS)
        devices.append(SimDevice(unit_id, simdata=[block], action=registers.act))
    trace = None if faults is None else faults.trace
    server: ModbusTcpServer | ModbusSerialServer
    if not isinstance(address, SerialPort):
        server = ModbusTcpServer(devices, address=address, trace_packet=trace)
    else:
        server = ModbusSerialServer(
            devices,
            trace_packet=trace,
            port=address.port,
            baudrate=address.baud,
            parity=address.parity,
            stopbits=address.stop_bits,
        )
    if faults is not None:
        faults.server = server
    return server
