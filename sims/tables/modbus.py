"""The protocol side of the table twin: drives on Modbus, TCP or RTU, at the connections of a stock pymodbus server.

Requests are read by the letter of the MODBUS Application Protocol Specification V1.1b3, the Messaging on TCP/IP
Implementation Guide V1.0b and MODBUS over Serial Line V1.02: a stock server passes what a drive would not.
"""

import asyncio
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from pymodbus.constants import ExcCodes
from pymodbus.framer import FramerRTU
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.tables.modbus.order import READ, WRITE_MORE, WRITE_ONE
from drivers.tables.modbus.registers import DriveProfile, Register
from sims.tables.drive import Drive
from sims.wires.faults import FaultyWay, WireFaults, damaged
from sims.wires.line_controller import Refused, TableTwinSetup
from sims.wires.wires import ByteDevice, Write

_BROADCAST = 0
_MOST_READ, _MOST_WRITTEN = 125, 123  # registers a request
_HEADER = struct.Struct(">HHH")  # on TCP: transaction, protocol, length
_LENGTHS = range(2, 255)  # of unit id and PDU
_LONGEST_FRAME = 256  # on RTU
NOBODY = [SimDevice(1, simdata=[SimData(0, datatype=DataType.REGISTERS)])]
"""Whom a stock server wants to be given to serve."""


class FaultyModbus(FaultyWay[bytes]):
    """Faults of a wire, applied to Modbus requests and replies."""

    def __init__(self, faults: WireFaults, seed: int | tuple[int, ...]) -> None:
        """Must be made within a running loop."""
        # A reply is late by the delays of request and reply: the stock server cannot hold two requests at once.
        both = replace(faults, latency_s=2 * faults.latency_s, jitter_s=2 * faults.jitter_s)
        super().__init__(self._write, both, seed)
        self.server: ModbusTcpServer | None = None

    def trace(self, sending: bool, data: bytes) -> bytes:
        """Return what arrives of a frame at once, possibly damaged; empty if it is lost.

        A reply (``sending``) on a wire with delays is empty too, and delivered later.
        """
        if self.silent or self._random.random() < self._faults.loss:
            return b""
        data = damaged(data, self._faults, self._random)
        if not sending or not self._faults.delays:
            return data
        self._put(data)
        return b""

    def _write(self, data: bytes) -> None:
        for connection in list(self.server.active_connections.values()) if self.server is not None else ():
            if connection.transport is not None:
                connection.transport.write(data)  # type: ignore[attr-defined]


def pull_plug(server: ModbusTcpServer) -> None:
    """Close all connections of a server and have it listen no more, until ``listen`` is called at the same address."""
    for bound in getattr(server.transport, "sockets", ()):
        server.init_setup_connect_listen(*bound.getsockname()[:2])  # also if any port was requested
    server.close()


class DriveRegisters:
    """Translates Modbus requests to reads and writes of one drive."""

    def __init__(self, drive: Drive, profile: DriveProfile, counts_per_turn: int) -> None:
        """``counts_per_turn`` scales the registers, as the profile says."""
        self._drive = drive
        self._counts = counts_per_turn
        self._by_address: dict[int, Register] = {r.address: r for r in profile.registers.values()}

    def answer(self, pdu: bytes) -> bytes:
        """Return the reply to a request, an exception reply if it is refused; both start with the function code.

        A value that fits no register is a device failure. Any request ends the silence of the master.
        """
        self._drive.heard()
        try:
            return pdu[:1] + self._carry_out(pdu[0], pdu[1:])
        except Refused as refusal:
            return _exception(pdu, refusal.code)
        except ValueError:  # the drive's value fits no register
            return _exception(pdu, ExcCodes.DEVICE_FAILURE)

    def _carry_out(self, function: int, data: bytes) -> bytes:
        """Return the data of the reply to a request: byte count and words read, or for a write its first four bytes.

        Checked are function code, quantity, address and value in the specified order; Refused with the exception code
        if a check fails.
        """
        if function == READ:
            address, count = _unpacked(">HH", data)
            if not 1 <= count <= _MOST_READ:
                raise Refused(ExcCodes.ILLEGAL_VALUE)
            registers = self._at(address, count)
            words = [word for r in registers for word in r.encode(self._drive.read(r.name), self._counts)]
            return bytes([2 * count]) + struct.pack(f">{count}H", *words)
        if function == WRITE_ONE:
            address, word = _unpacked(">HH", data)
            self._write(address, [word])
        elif function == WRITE_MORE:
            address, count, size = _unpacked(">HHB", data[:5])
            if not 1 <= count <= _MOST_WRITTEN or size != 2 * count:
                raise Refused(ExcCodes.ILLEGAL_VALUE)
            self._write(address, _unpacked(f">{count}H", data[5:]))
        else:
            raise Refused(ExcCodes.ILLEGAL_FUNCTION)
        return data[:4]

    def _write(self, address: int, words: Sequence[int]) -> None:
        """Write words to the registers from ``address`` on, in their order.

        Refused for a missing or divided register, for one that the drive does not accept from this master, or for a
        value that it does not accept; registers before that one have been written.
        """
        for register in self._at(address, len(words)):
            value = register.decode(words[: register.words], self._counts)
            words = words[register.words :]
            if not self._drive.commanded_by_us(register.name):
                raise Refused(ExcCodes.DEVICE_FAILURE)
            if not self._drive.accepts(register.name, value):
                raise Refused(ExcCodes.ILLEGAL_VALUE)
            self._drive.write(register.name, value)

    def _at(self, address: int, count: int) -> list[Register]:
        """Return the registers that exactly fill ``count`` addresses; Refused for a missing or divided one."""
        found: list[Register] = []
        while count:
            register = self._by_address.get(address)
            if register is None or register.words > count:
                raise Refused(ExcCodes.ILLEGAL_ADDRESS)
            found.append(register)
            address, count = address + register.words, count - register.words
        return found


class ModbusTcp:
    """Drives by unit id behind a TCP gateway; requests to a missing unit get exception 0Bh."""

    def __init__(self, drives: Mapping[int, DriveRegisters], write: Write) -> None:
        """Begin without a request."""
        self._drives, self._write = drives, write
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Answer each complete request in order, also for a unit that is no drive: by an exception.

        Frames of another protocol are discarded. ConnectionError if a length is impossible, as the next start is then
        unknown.
        """
        self._buffer += data
        while len(self._buffer) >= _HEADER.size:
            number, protocol, length = _HEADER.unpack_from(self._buffer)
            if length not in _LENGTHS:
                raise ConnectionError
            end = _HEADER.size + length
            if len(self._buffer) < end:
                return
            unit, pdu, self._buffer = self._buffer[6], self._buffer[7:end], self._buffer[end:]
            if protocol:
                continue  # discarded according to the implementation guide (4.4.2.1)
            drive = self._drives.get(unit)
            reply = drive.answer(pdu) if drive else _exception(pdu, ExcCodes.GATEWAY_NO_RESPONSE)
            self._write(_HEADER.pack(number, 0, len(reply) + 1) + bytes([unit]) + reply)


class ModbusRtu:
    """Drives by unit id on a serial line; missing units are silent, a broadcast is carried out without a reply.

    A frame ends with 3.5 characters of silence, or at once if it is complete by its length.
    """

    def __init__(self, drives: Mapping[int, DriveRegisters], silence_s: float, write: Write) -> None:
        """Prepare for ``drives`` by unit id; ``silence_s`` ends a frame. Needs a running loop."""
        self._drives, self._write, self._silence_s = drives, write, silence_s
        self._buffer = b""
        self._loop = asyncio.get_running_loop()
        self._silence: asyncio.TimerHandle | None = None

    def received(self, data: bytes) -> None:
        """Collect bytes from the master; serve a complete, sound frame at once, anything else after the silence.

        Only the last bytes are kept, one more than the longest frame has.
        """
        if self._silence is not None:
            self._silence.cancel()
        self._buffer = (self._buffer + data)[-_LONGEST_FRAME - 1 :]
        function = self._buffer[1] if len(self._buffer) > 1 else 0
        more = self._buffer[6] + 1 if function == WRITE_MORE and len(self._buffer) > 6 else 0
        if len(self._buffer) == 8 + more and function in (READ, WRITE_ONE, WRITE_MORE) and _is_sound(self._buffer):
            self._serve()
        else:
            self._silence = self._loop.call_later(self._silence_s, self._serve)

    def _serve(self) -> None:
        """Carry out the frame received and reply if it is addressed to a unit.

        A broadcast is carried out by all and gets no reply; damaged frames, and those for other units, are dropped.
        """
        frame, self._buffer = self._buffer, b""
        if not _is_sound(frame):
            return
        unit, pdu = frame[0], frame[1:-2]
        if unit == _BROADCAST:
            for drive in self._drives.values():
                drive.answer(pdu)
        elif unit in self._drives:
            reply = frame[:1] + self._drives[unit].answer(pdu)
            self._write(reply + FramerRTU.compute_CRC(reply).to_bytes(2))


class Connection(ServerRequestHandler):
    """One master's connection to a pymodbus server, which owns the transport."""

    def __init__(self, server: Any, make: Callable[[Write], ByteDevice]) -> None:
        """Serve the connection by the device of ``make``, which gets the function to write with."""
        super().__init__(server, server.trace_packet, None, server.trace_connect)  # type: ignore[no-untyped-call]
        self._device = make(self._say)

    def data_received(self, data: bytes) -> None:
        """Take bytes from the master; close if the device cannot find the next request in them."""
        try:
            self._device.received(self.trace_packet(False, data))
        except ConnectionError:
            self.close()

    def _say(self, frame: bytes) -> None:
        if frame := self.trace_packet(True, frame):
            self.send(frame)


def drives_by_unit(setup: TableTwinSetup) -> dict[int, DriveRegisters]:
    """Return a drive for each axis, by its unit id."""
    table, profile = setup.table, setup.options["profile"]
    drives = {}
    for axis, unit_id in setup.addresses.items():
        drive = Drive(table, axis, profile, setup.watchdog_s, cycle_s=setup.cycle_s)
        drives[unit_id] = DriveRegisters(drive, profile, table.data[axis].counts_per_turn)
    return drives


def modbus_server(
    setup: TableTwinSetup, address: tuple[str, int], faults: FaultyModbus | None = None
) -> ModbusTcpServer:
    """Return a server, not yet listening, for the axes' unit ids at a host and port; ``faults`` affect its frames.

    All its connections reach the same drives, made here.
    """
    server = ModbusTcpServer(NOBODY, address=address, trace_packet=None if faults is None else faults.trace)
    make = partial(ModbusTcp, drives_by_unit(setup))
    server.callback_new_connection = partial(Connection, server, make)  # type: ignore[method-assign]
    if faults is not None:
        faults.server = server
    return server


def _exception(pdu: bytes, code: int) -> bytes:
    return bytes((pdu[0] | 0x80, code))


def _unpacked(layout: str, data: bytes) -> tuple[int, ...]:
    """Return the numbers of a request; a length that contradicts it is an illegal value."""
    try:
        return struct.unpack(layout, data)
    except struct.error:
        raise Refused(ExcCodes.ILLEGAL_VALUE) from None


def _is_sound(frame: bytes) -> bool:
    return len(frame) >= 4 and FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:]))
