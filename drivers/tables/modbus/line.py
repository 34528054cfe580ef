"""One Modbus wire, TCP or RTU on a serial line, behind a stock pymodbus client."""

import asyncio
import logging
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from pymodbus.client import AsyncModbusSerialClient, AsyncModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.transport import NULLMODEM_HOST

from drivers.errors import BadReply, DeviceError, DeviceRefused, LinkLost
from drivers.packaged import packaged_codes, sentence
from drivers.requests.turn import Turn
from drivers.tables.modbus.order import READ, WRITE_ONE, Pending, Request, RtuGate, TcpGate
from drivers.types import LinkCounts

# pymodbus dumps its recent frames at ERROR for every time-out; the station reports it in one line.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

_HEARD_OUT = 0.25  # of a time-out, for the reply to a request that was cancelled
_LISTEN = 0.0025
_FORGOTTEN = 50  # time-outs, after which nothing on the way holds a reply back any more

_EXCEPTIONS = packaged_codes("drivers", "modbus", "exception")
_ASK_AGAIN = (5, 6, 11)  # acknowledge, busy, gateway target does not answer (Application Protocol V1.1b3, 7)
_SLOW_AGAIN = 0.9  # of the slowest answer so far, for each faster one after it
_FIRST_PAUSE = 0.05  # of a time-out, before a busy drive is asked again; doubled each time


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial line: its device, bits per second, parity (N, E or O), stop bits (1 or 2)."""

    port: str
    baud: int = 19200
    parity: str = "N"
    stop_bits: int = 1

    @property
    def silence_s(self) -> float:
        """Silence between frames: 3.5 characters, not below 1.75 ms (Modbus over serial line V1.02, 2.5.1.1)."""
        return max(3.5 * 11 / self.baud, 0.00175)


Address = tuple[str, int] | SerialPort
"""Host and TCP port, or a serial line."""


@dataclass(frozen=True, slots=True)
class Reply:
    """The words that were read or echoed; the answer was given between the two loop times."""

    words: tuple[int, ...]
    sent_s: float
    received_s: float


class _NoReply(Exception):
    """No reply came that could be the answer."""


class _Busy(DeviceRefused):
    """A temporary refusal."""


class ModbusLine:
    """Sends one request at a time, and accepts only what must be its answer (``modbus_order``).

    Every ``ask`` ends within two time-outs, including resynchronisation and waiting for a busy drive.
    """

    def __init__(
        self, device: str, address: Address, timeout_s: float, probes: Mapping[int, Sequence[Request]]
    ) -> None:
        """Prepare for the peer at ``address``, a host and port or a serial port; nothing is opened.

        ``probes`` are harmless reads by unit id, whose RTU replies differ in length.
        """
        self._device, self._address, self._timeout_s = device, address, timeout_s
        self._probes = probes
        self.counts = LinkCounts()
        self._client: Any = None
        self._lock = Turn()
        self._rtu, self._tcp = RtuGate(self.counts), TcpGate(self.counts)
        self._unheard_until_s = 0.0
        self._pending: dict[int, Pending] = defaultdict(Pending)
        self._quiet_until_s = 0.0
        self._failed = self._asking = False
        self._slowest_s = 0.0  # answer lately
        self._untold = 0  # orders in a row that were not answered
        self._ended = ""
        self._shown = 0  # bytes of the answer that is coming in

    @property
    def sound(self) -> bool:
        """Whether it is connected, and on TCP, where a new connection begins in step, the last request was answered."""
        failed = self._failed and not isinstance(self._address, SerialPort)
        return self._client is not None and bool(self._client.connected) and not failed

    async def open(self) -> None:
        """Connect, closing an open connection first; LinkLost if nobody listens or the port cannot be opened.

        On a serial port every unit is taken to have replies under way to an earlier user; DeviceRefused if the probes
        of one cannot be told apart.
        """
        self.close()
        self._failed, self._ended, self._unheard_until_s = False, "", 0.0
        gate = self._rtu if isinstance(self._address, SerialPort) else self._tcp
        settings: dict[str, Any] = {"trace_packet": partial(self._trace, gate), "reconnect_delay": 0}
        if isinstance(self._address, SerialPort):
            line = self._address
            settings |= {"baudrate": line.baud, "parity": line.parity, "stopbits": line.stop_bits}
            self._doubt_all()
            reason = f"cannot open serial port {line.port}. Is it plugged in, not in use, and may you access it?"
            self._client = AsyncModbusSerialClient(line.port, timeout=2 * self._timeout_s, retries=0, **settings)
        else:
            host, port = self._address
            reason = (
                f"nothing answers at {_text(self._address)}. Is the table controller switched "
                "on? Is the address correct?"
            )
            self._client = AsyncModbusTcpClient(host, port=port, timeout=self._timeout_s, retries=1, **settings)
        self._client.set_max_no_responses(1 << 30)  # it is ours to close
        self._client.ctx.callback_disconnected = self._disconnected
        cancels = _cancels()
        try:
            connected = await self._client.connect()
        except Exception as error:  # pyserial lets termios.error through, which not every system has
            raise LinkLost(self._device, f"{reason} ({error})") from None
        _heed(cancels)
        if not connected:
            raise LinkLost(self._device, reason)
        self.counts.opened += 1
        if isinstance(self._address, SerialPort):  # a frame that another master has begun must end first
            self._quiet_until_s = self._now() + self._address.silence_s

    def _trace(self, gate: RtuGate | TcpGate, sending: bool, data: bytes) -> bytes:
        """Count bytes and return those of ``data`` that ``gate`` lets pass; a hook of the client.

        While receiving (not ``sending``), the client shows all bytes so far each time; only new ones are counted.
        """
        if sending:
            self.counts.sent += len(data)
        else:
            self.counts.received += len(data) - (self._shown if len(data) >= self._shown else 0)
        self._shown = 0 if sending else len(data)
        return gate(sending, data)

    def close(self) -> None:
        """Close; twice is once."""
        if self._client is not None:
            self._client.close()
            self._client = None

    async def ask(self, request: Request) -> Reply:
        """Return the reply, asking twice at most; LinkLost without one, BadReply, DeviceRefused with its code."""
        return await self._answered(request, 2 * self._timeout_s, prompt=False)

    async def tell(self, request: Request) -> None:
        """Send once, without waiting for outstanding replies: for stopping, where other axes wait. Raises as ``ask``.

        The echo must come within half a time-out; within twice the time of recent answers where that is more. That is
        doubled for each order in a row that failed, up to the two time-outs of ``ask``. On a serial line that worked so
        far, where two frames could collide, it is at least one time-out. A busy drive is asked again within this time.
        """
        patient = isinstance(self._address, SerialPort) and not self._failed
        least_s = self._timeout_s if patient else self._timeout_s / 2
        within_s = min(max(least_s, 2 * self._slowest_s) * 2 ** min(self._untold, 8), 2 * self._timeout_s)
        self._untold += 1
        await self._answered(request, within_s, prompt=True)
        self._untold = 0

    async def _answered(self, request: Request, within_s: float, *, prompt: bool) -> Reply:
        """Send a request and return its reply; repeat it after growing pauses for up to ``within_s`` if the drive is
        busy.

        With ``prompt`` it is sent as for ``tell`` and the reply has to come within ``within_s``; otherwise as for
        ``ask``, at most twice with a time-out each. LinkLost without a reply or connection, BadReply for one that
        violates Modbus, DeviceRefused for a refusal, also of a drive that stays busy.
        """
        async with self._lock:
            self._check_connected()
            began_s, pause_s = self._now(), _FIRST_PAUSE * self._timeout_s
            limit_s = began_s + within_s if prompt else None  # else the client asks twice
            self._rtu.refusal = None
            await self._await_old_reply()
            while True:
                try:
                    if not isinstance(self._address, SerialPort):
                        reply = await self._execute(request, limit_s)
                    elif prompt:
                        reply = await self._exchange(request, began_s + within_s, self._address)
                    else:
                        reply = await self._ask_in_step(request, self._address, began_s)
                except _Busy:
                    limit_s = began_s + within_s
                    if self._now() + pause_s > limit_s:
                        self._failed = True
                        raise
                except _NoReply:
                    self.counts.timeouts += 1
                    self._failed = True
                    self._check_connected()
                    raise self._unanswered(request, within_s, prompt) from None
                else:
                    self._failed = False
                    self._slowest_s = max(reply.received_s - reply.sent_s, _SLOW_AGAIN * self._slowest_s)
                    return reply
                await asyncio.sleep(pause_s)
                pause_s *= 2

    def _unanswered(self, request: Request, within_s: float, once: bool) -> DeviceError:
        """Return the error for a request without an answer within ``within_s``; ``once`` if it was sent once.

        BadReply if what came on TCP violates Modbus, else LinkLost, which says what came instead, or which refusal.
        """
        if self._tcp.wrong:
            reason = f"sent an answer for {request.register} that violates Modbus: {self._tcp.wrong}"
            return BadReply(self._device, f"{_who(request)} {reason}")
        reason = f"does not answer within {within_s:g} s{'' if once else ' after two requests'}"
        heard = "; what arrives is late, damaged or unrelated" if self._rtu.heard else ""
        if (code := self._rtu.refusal) is not None:
            reason = f"refused all requests within {within_s:g} s"
            heard = f": Modbus exception {code}, {_EXCEPTIONS.get(code, 'unknown exception')}"
        return LinkLost(self._device, f"{_who(request)} {reason}{heard}")

    async def _await_old_reply(self) -> None:
        """Wait a little for the reply to a request that was cancelled, if one is outstanding.

        A stop cancels all requests. A device that has not answered yet may lose the next one, and on a serial line both
        would collide; there the line is kept quiet afterwards. The wait ends after a quarter of a time-out.
        """
        if not self._unheard_until_s:
            return
        gate = self._rtu if isinstance(self._address, SerialPort) else self._tcp
        while not gate.answered and self._now() < self._unheard_until_s:
            await asyncio.sleep(_LISTEN * self._timeout_s)
        self._unheard_until_s = 0.0
        if isinstance(self._address, SerialPort):
            self._quiet_until_s = self._now() + self._address.silence_s

    def _doubt_all(self) -> None:
        """Assume that each unit still has replies to all its probes under way to an earlier user of the line.

        DeviceRefused if the probes of a unit cannot be told apart by their length.
        """
        for unit, probes in self._probes.items():
            if len({probe.head for probe in probes}) < 2:
                raise DeviceRefused(self._device, sentence("link.one_width"))
            for probe in probes:
                if probe.head not in self._pending[unit]:
                    self._pending[unit].add(probe.head, self._now())

    async def _ask_in_step(self, request: Request, line: SerialPort, began_s: float) -> Reply:
        """Send a request on a serial line and return its reply, which cannot be mistaken for another.

        If earlier replies of the unit may look like it, or none comes within a time-out, the unit is probed until no
        reply is pending; then the request is sent (again). _NoReply once two time-outs after ``began_s`` (loop time)
        are over.
        """
        deadline_s = began_s + 2 * self._timeout_s
        pending = self._pending[request.unit_id]
        pending.forget(self._now() - _FORGOTTEN * self._timeout_s)
        if request.head not in pending:
            try:
                return await self._exchange(request, began_s + self._timeout_s, line)
            except _NoReply:
                self.counts.timeouts += 1
        while pending:
            await self._probe(request.unit_id, deadline_s, line)
        return await self._exchange(request, deadline_s, line)

    async def _probe(self, unit: int, deadline_s: float, line: SerialPort) -> None:
        """Send one harmless read whose reply can prove that earlier replies are past; the caller repeats it.

        Chosen is a read whose reply fits nothing that may still come; if there is none, the one asked last, so that in
        the end only its own replies may come. Wait for half of the time left, at least a tenth of the time-out, and
        return as well if nothing came. Raise _NoReply once ``deadline_s`` (loop time) is over.
        """
        pending = self._pending[unit]
        left_s = deadline_s - self._now()
        if left_s <= 0:
            raise _NoReply
        fresh = [probe for probe in self._probes[unit] if probe.head not in pending]
        probe = fresh[0] if fresh else max(self._probes[unit], key=lambda probe: pending.last(probe.head))
        wait_s = max(left_s / 2, self._timeout_s / 10)
        try:
            await self._exchange(probe, min(self._now() + wait_s, deadline_s), line)
        except _NoReply:
            if self._now() >= deadline_s:
                raise

    async def _exchange(self, request: Request, limit_s: float, line: SerialPort) -> Reply:
        """Send a request once on the serial line and return the first reply that fits, before ``limit_s`` (loop time).

        The line is kept quiet before and after. A reply or refusal shows that earlier requests will not be answered any
        more: they are removed from the pending ones. _NoReply without a reply; DeviceRefused, or _Busy, for a refusal.
        A refusal does not name its request: it counts only if no other one of the unit is pending.
        """
        pending = self._pending[request.unit_id]
        # A refusal does not name its request; it counts as the answer only if nothing else may be refused.
        self._rtu.expect(request.head, *(() if pending else request.refusals))
        pending.add(request.head, self._now())
        await asyncio.sleep(self._quiet_until_s - self._now())
        try:
            reply = await self._execute(request, limit_s)
        except DeviceRefused:
            pending.answered(request.head)
            raise
        finally:
            self._quiet_until_s = self._now() + line.silence_s
        pending.answered(request.head)
        return reply

    async def _execute(self, request: Request, limit_s: float | None) -> Reply:
        """Have the client carry out a request, and return the checked reply with its times.

        ``limit_s`` is a time of the loop; None leaves it to the client. _NoReply without a reply by then;
        DeviceRefused, or _Busy, for a refusal. If cancelled, the next request will wait a little for the reply.
        """
        cancels = _cancels()
        sent_s = self._now()
        try:
            async with asyncio.timeout_at(limit_s):
                self._asking = True
                reply = await self._call(request)
        except asyncio.CancelledError:
            self._unheard_until_s = self._now() + _HEARD_OUT * self._timeout_s
            raise
        except (ModbusException, TimeoutError):
            raise _NoReply from None
        finally:
            self._asking = False
        received_s = self._now()
        _heed(cancels)
        return Reply(self._checked(request, reply), sent_s, received_s)

    async def _call(self, request: Request) -> Any:
        client, unit = self._client, request.unit_id
        if request.function == READ:
            return await client.read_holding_registers(request.address, count=request.count, device_id=unit)
        if request.function == WRITE_ONE:
            return await client.write_register(request.address, request.words[0], device_id=unit)
        return await client.write_registers(request.address, list(request.words), device_id=unit)

    def _checked(self, request: Request, reply: Any) -> tuple[int, ...]:
        """Return the words of the reply to a read; those for a write are of no use.

        DeviceRefused for an exception reply; _Busy, which is a DeviceRefused, if the device asks to try again.
        """
        if reply.isError():
            code = int(getattr(reply, "exception_code", 0))
            function = "write" if request.words else "read"
            raise (_Busy if code in _ASK_AGAIN else DeviceRefused)(
                self._device,
                f"{_who(request)} refuses to {function} 0x{request.address:04X} ({request.register}): "
                f"Modbus exception {code}, {_EXCEPTIONS.get(code, 'unknown exception')}",
            )
        return tuple(reply.registers)

    def _disconnected(self, error: Exception | None) -> None:
        """Store why the connection ended, and fail the request that waits for an answer."""
        self._ended = "the controller closed it" if error is None else f"it broke ({error})"
        if self._asking and not self._client.ctx.response_future.done():
            self._client.ctx.response_future.set_exception(self._connection_lost())

    def _check_connected(self) -> None:
        if self._client is None or not self._client.connected:
            raise self._connection_lost()

    def _connection_lost(self) -> LinkLost:
        reason = f"the connection to {_text(self._address)} is gone"
        return LinkLost(self._device, f"{reason}: {self._ended}" if self._ended else reason)

    def _now(self) -> float:
        return asyncio.get_running_loop().time()


def _cancels() -> int:
    task = asyncio.current_task()
    return task.cancelling() if task else 0


def _heed(cancels_before: int) -> None:
    """Raise a cancel that asyncio.wait_for of Python 3.11, within pymodbus, forgot as it came with the result."""
    if _cancels() > cancels_before:
        raise asyncio.CancelledError


def _who(request: Request) -> str:
    return f"axis {request.axis} (unit id {request.unit_id})"


def _text(address: Address) -> str:
    if isinstance(address, SerialPort):
        return address.port
    return "the wire in memory" if address[0] == NULLMODEM_HOST else f"{address[0]}:{address[1]}"
