"""Whatever happens on the wire, the table stands soon after, nothing is printed, and the reason says what it was."""

from __future__ import annotations

import asyncio
import logging
import math
import os
import re
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import pytest
from misbehaving_wire import KINDS, Kind, Proxy
from modbus_twin import modbus_server
from setups import setup_of
from turntable_rigs import COUNTS, DEG, LIMITS, byte_pair, model_of

from drivers.errors import DeviceError
from drivers.links.memory_link import MemoryLink
from drivers.links.tcp_link import TcpLink
from drivers.specs import AxisSetup
from drivers.tables.modbus.line import Address, SerialPort
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from sims.physics.table import TableModel
from sims.wires.line_controller import TableTwinSetup
from sims.wires.wires import on_pty, on_tcp
from station.run.event_loop.loops import ScaledLoop

PHASES = ("connecting", "homing", "ramp", "steady", "last stop")
AT_REST_S = 1.5
TIMEOUT_S = 0.2
RATE = 20 * DEG
AXIS = "y"
PROFILE, UNIT_IDS = load_profile("kinco"), {"x": 1, "y": 2, "z": 3}
AT_ONCE = 16  # cases in one loop


@dataclass
class Found:
    """How a case ended."""

    case: tuple[str, Kind, str]
    reason: str = ""
    stopped: str = ""
    rest_s: float = math.nan
    printed: list[str] = field(default_factory=list)

    @property
    def wrong(self) -> str:
        protocol, kind, phase = self.case
        if self.printed:
            return f"printed {self.printed[0]}"
        if phase != "connecting" and not self.rest_s <= (AT_REST_S if kind.says else 3.0):
            return f"at rest after {self.rest_s:.2f} s"
        said = f"{self.reason} {self.stopped}"
        if phase != "last stop" and not kind.says and self.reason and not kind.may_end:
            return "ended"
        if kind.says and not re.search(kind.says, said) and (phase not in ("connecting", "last stop") or said.strip()):
            return "unnamed"
        return ""

    def __str__(self) -> str:
        protocol, kind, phase = self.case
        return (
            f"{protocol}, {kind.name}, {phase}: {self.wrong} (rest {self.rest_s:.2f} s; {self.reason}; {self.stopped})"
        )


@asynccontextmanager
async def joined(protocol: str, proxy: Proxy) -> AsyncIterator[tuple[Any, TableModel]]:
    """Put a driver, not yet opened, and a twin at the two ends of a proxy."""
    own = "modbus" if protocol == "rtu" else protocol
    model = model_of("xyz", COUNTS[own])
    for motion in model.motion.values():
        motion.move(-100.0, 60 * DEG, 1.0, 1.0)  # far enough from home to be seen on the way there
    async with AsyncExitStack() as stack:
        address: Address
        if own == "modbus":
            drives = {axis: AxisSetup(unit_id, COUNTS[own], LIMITS) for axis, unit_id in UNIT_IDS.items()}
            if protocol == "rtu":
                address, far = await serial_pair(stack, proxy)
            else:
                far = ("127.0.0.1", 0)
            server: Any = modbus_server(TableTwinSetup(model, UNIT_IDS, {"profile": PROFILE}, 0.0), far)
            await server.serve_forever(background=True)
            stack.push_async_callback(server.shutdown)
            if protocol != "rtu":
                proxy.port = server.transport.sockets[0].getsockname()[1]
                await proxy.listen()
                address = proxy.where
            table: Any = ModbusTable(setup_of("modbus", drives, TIMEOUT_S, profile=PROFILE), address)
        else:
            made = await stack.enter_async_context(
                on_tcp(lambda write: byte_pair(own, MemoryLink("unused"), model, write, "xyz")[1], "127.0.0.1")
            )
            proxy.port = made[1]
            await proxy.listen()
            table = byte_pair(own, TcpLink("table", *proxy.where, 2.0), model, lambda data: None, "xyz")[0]  # type: ignore[arg-type]
        try:
            yield table, model
        finally:
            table.close()
            await proxy.close()


async def serial_pair(stack: AsyncExitStack, proxy: Proxy) -> tuple[SerialPort, SerialPort]:
    """Return the two ports of a serial line through a proxy."""
    ends: list[Callable[[bytes], None]] = []

    class End:
        def __init__(self, place: int, change: Callable[[bytes], list[bytes]]) -> None:
            self.place, self.change = place, change

        def received(self, data: bytes) -> None:
            for piece in self.change(data):
                if proxy.kind and proxy.kind.late_s:
                    asyncio.get_running_loop().call_later(proxy.kind.late_s / 2, ends[self.place], piece)
                else:
                    ends[self.place](piece)  # timers of one instant keep no order

    names = []
    for place, change in ((1, proxy.requests), (0, proxy.replies)):

        def make(write: Callable[[bytes], None], place: int = place, change: Any = change) -> End:
            ends.append(write)
            return End(place, change)

        names.append(await stack.enter_async_context(on_pty(make)))
    return SerialPort(names[0], 115200), SerialPort(names[1], 115200)


async def drive(case: tuple[str, Kind, str], joined: Callable[[str, Proxy], Any] = joined) -> Found:
    """Do what a run does, with the wire struck in one of its phases; on the way out, stop.

    ``joined`` puts driver and table at the two ends of the wire.
    """
    protocol, kind, phase = case
    loop, found, proxy = asyncio.get_running_loop(), Found(case), Proxy()
    lasting = kind.lasting or protocol == "rtu"  # a serial line is the same line when it is opened again
    async with joined(protocol, proxy) as (table, model):

        async def run() -> None:
            if phase == "connecting":
                proxy.strike(kind)
            await table.open()
            await table.enable()
            if phase == "connecting":
                return
            if phase == "homing":
                loop.call_later(0.35, proxy.strike, kind)
                await table.home()
                return
            await table.jog(AXIS, RATE, 40 * DEG if phase == "ramp" else LIMITS.acceleration_rps2)
            if phase != "last stop":
                loop.call_later({"ramp": 0.2, "steady": 0.6}[phase], proxy.strike, kind)
            ends_s = loop.time() + 1.4
            while loop.time() < ends_s - (0.8 if phase == "last stop" else 0.0):
                await table.read(AXIS)
                await table.status("x")
                await asyncio.sleep(0.05)
            if phase == "last stop":
                proxy.strike(kind)

        async def watch() -> None:
            """Note when the table stands, once told to or struck; a stop that cannot see it ends then."""
            while loop.time() < proxy.struck_s + (1.0 if not kind.says and phase != "last stop" else 0.0):
                await asyncio.sleep(0.01)
            began_s, stands_s = proxy.struck_s if kind.says else loop.time(), math.inf
            while loop.time() < began_s + 4.0 and loop.time() < stands_s + 0.5:
                stands_s = min(stands_s, loop.time()) if model.at_rest() else math.inf
                await asyncio.sleep(0.01)
            found.rest_s = stands_s - began_s

        watching = asyncio.ensure_future(watch())
        try:
            await run()
        except DeviceError as error:
            found.reason = str(error)
        if proxy.kind is None:  # the host was too busy to get so far
            watching.cancel()
            proxy.strike(kind)
            return await drive(case, joined)
        stopping = asyncio.ensure_future(table.stop())
        if phase == "connecting":
            watching.cancel()
        with suppress(asyncio.CancelledError):
            await watching
        await asyncio.wait([stopping], timeout=0.0 if lasting or phase == "connecting" else 2.0)
        stopping.cancel()
        try:
            await stopping
        except DeviceError as error:
            found.stopped = str(error)
        except asyncio.CancelledError:
            found.stopped = "" if lasting or phase == "connecting" else "the stop did not end"
        with suppress(DeviceError):
            if not lasting and phase != "connecting":
                await table.disable()
    return found


def run_cases(
    cases: list[tuple[str, Kind, str]],
    caplog: pytest.LogCaptureFixture,
    joined: Callable[[str, Proxy], Any] = joined,
) -> list[Found]:
    async def main() -> list[Found]:
        printed: list[str] = []
        asyncio.get_running_loop().set_exception_handler(lambda _, context: printed.append(str(context)))
        places = asyncio.Semaphore(AT_ONCE)

        async def in_turn(case: tuple[str, Kind, str]) -> Found:
            async with places:
                return await drive(case, joined)

        found = list(await asyncio.gather(*map(in_turn, cases)))
        await asyncio.sleep(0.05)
        found[-1].printed += printed
        return found

    with caplog.at_level(logging.WARNING), asyncio.Runner(loop_factory=ScaledLoop) as runner:
        found = runner.run(main())
    found[-1].printed += [record.getMessage() for record in caplog.records]
    return found


def in_rotation(protocol: str) -> list[tuple[str, Kind, str]]:
    """Return every kind once, each in another phase than its neighbours."""
    shift = sorted(KINDS).index(protocol)
    return [(protocol, kind, PHASES[(place + shift) % len(PHASES)]) for place, kind in enumerate(KINDS[protocol])]


protocols = pytest.mark.parametrize("protocol", sorted(KINDS))
posix = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")


@posix
def test_every_kind_of_misbehaviour_leaves_the_table_at_rest(caplog: pytest.LogCaptureFixture) -> None:
    found = run_cases([case for protocol in sorted(KINDS) for case in in_rotation(protocol)], caplog)
    # Real time among many on a host that may be busy: a defect shows again by itself.
    wrong = [one.case for one in found if one.wrong]
    assert not wrong or [str(one) for one in run_cases(wrong, caplog) if one.wrong] == []


@posix
@pytest.mark.full
@protocols
@pytest.mark.parametrize("phase", PHASES)
def test_in_every_phase(protocol: str, phase: str, caplog: pytest.LogCaptureFixture) -> None:
    found = run_cases([(protocol, kind, phase) for kind in KINDS[protocol]], caplog)
    assert [str(one) for one in found if one.wrong] == []
