"""The protocol side of the table twin: drives behind a stock pymodbus server, on TCP or RTU."""

from __future__ import annotations

from collections.abc import Mapping

from pymodbus.constants import ExcCodes
from pymodbus.server import ModbusSerialServer, ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.modbus_line import Address, SerialPort
from drivers.registers import DriveProfile, Register
from sims.drive import Drive
from sims.table import TableModel


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
    table: TableModel, profile: DriveProfile, unit_ids: Mapping[str, int], address: Address, watchdog_s: float
) -> ModbusTcpServer | ModbusSerialServer:
    """Return a server, not yet listening, with one unit id an axis; at a host and port, or on a serial line."""
    devices = []
    low = min(r.address for r in profile.registers.values())
    high = max(r.address + r.words for r in profile.registers.values())
    for axis, unit_id in unit_ids.items():
        registers = DriveRegisters(Drive(table, axis, profile, watchdog_s), profile, table.data[axis].counts_per_turn)
        block = SimData(low, count=high - low, datatype=DataType.REGISTERS)
        devices.append(SimDevice(unit_id, simdata=[block], action=registers.act))
    if not isinstance(address, SerialPort):
        return ModbusTcpServer(devices, address=address)
    return ModbusSerialServer(
        devices, port=address.port, baudrate=address.baud, parity=address.parity, stopbits=address.stop_bits
    )
