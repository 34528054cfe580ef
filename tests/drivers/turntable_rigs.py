"""Every turntable driver with its twin on a wire in memory, for tests under virtual time."""

from __future__ import annotations

import asyncio
import itertools
import math
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Protocol

from modbus_twin import modbus_server
from pymodbus.transport import NULLMODEM_HOST
from setups import setup_of, twin_on
from wire_pair import pair

from drivers.links.memory_link import MemoryLink
from drivers.specs import AxisSetup
from drivers.tables.acutrol.table import AcutrolTable
from drivers.tables.aerosmith.table import AerosmithTable
from drivers.tables.galil.table import GalilTable
from drivers.tables.modbus.registers import load_profile
from drivers.tables.modbus.table import ModbusTable
from drivers.types import AxisLimits
from sims.physics.table import AxisData, TableModel
from sims.tables.aerosmith_controller import STA_FAULT
from sims.wires.line_controller import TableTwinSetup
from station.run.event_loop.loops import VirtualLoop

DEG = math.pi / 180
MAX_RATE, MAX_ACCELERATION = 100 * DEG, 50 * DEG
LIMITS = AxisLimits(MAX_RATE, MAX_ACCELERATION)
START_RAD = {"x": 3 * DEG, "y": -2 * DEG, "z": 1.5 * DEG}
TIMEOUT_S = 0.2
COUNTS = {"modbus": 65536, "galil": 3_600_000, "acutrol": 36_000_000, "aerosmith": 3_600_000}
_wires = itertools.count(60_000)


class Controller(Protocol):
    """A twin of a byte device."""

    def received(self, data: bytes) -> None: ...


@dataclass
class Rig:
    """A driver, opened unless told otherwise, the table beneath its twin, and the wire between them."""

    table: Any
    model: TableModel
    axes: str
    counts_per_turn: int
    silence: Callable[[], Awaitable[None]]
    speak: Callable[[], None] = field(default=lambda: None)

    @property
    def count_rad(self) -> float:
        return 2 * math.pi / self.counts_per_turn


def virtually(main: Callable[[], Awaitable[None]]) -> None:
    async def run() -> None:
        await main()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


def model_of(axes: str, counts_per_turn: int) -> TableModel:
    data = {axis: AxisData(MAX_RATE, MAX_ACCELERATION, counts_per_turn, START_RAD[axis]) for axis in axes}
    return TableModel(data, asyncio.get_running_loop().time)


async def settle(table: Any, axis: str, limit_s: float = 60.0) -> None:
    async with asyncio.timeout(limit_s):
        while not (await table.status(axis)).target_reached:
            await asyncio.sleep(0.05)


class MemoryWire:
    """Joins a driver's link and a twin at once; silent, it carries nothing."""

    def __init__(self, link: MemoryLink) -> None:
        self.link = link
        self.silent = False
        self.controller: Controller | None = None

    def write(self, data: bytes) -> None:
        """Send bytes of the twin to the driver."""
        if not self.silent:
            self.link.write(data)

    async def carry(self) -> None:
        """Carry what the driver writes to the twin, until cancelled."""
        while True:
            data = (await self.link.receive()).data
            if not self.silent and self.controller is not None:
                self.controller.received(data)


def byte_pair(
    kind: str, link: MemoryLink, model: TableModel, write: Callable[[bytes], None], axes: str, **twin: Any
) -> tuple[Any, Controller]:
    """Return driver and twin of one protocol, joined to nothing but ``link`` and ``write``."""
    if kind == "galil":
        letters = dict(zip(axes, "ABC", strict=False))
        galil_axes = {axis: AxisSetup(letter, COUNTS[kind], LIMITS) for axis, letter in letters.items()}
        table: Any = GalilTable(setup_of("galil", galil_axes, TIMEOUT_S), link)
        return table, twin_on("galil", model, write, letters, **twin)
    if kind == "acutrol":
        numbers = {axis: place for place, axis in enumerate(axes, 1)}
        acutrol_axes = {axis: AxisSetup(number, COUNTS["acutrol"], LIMITS) for axis, number in numbers.items()}
        table = AcutrolTable(setup_of("acutrol", acutrol_axes, TIMEOUT_S), link)
        return table, twin_on("acutrol", model, write, numbers, **twin)
    table = AerosmithTable(
        setup_of("aerosmith", {axes: AxisSetup("", 1, LIMITS)}, TIMEOUT_S, fault_mask=STA_FAULT), link
    )
    return table, twin_on("aerosmith", model, write, {axes: ""}, **twin)


@asynccontextmanager
async def rig(kind: str, *, opened: bool = True, **twin: Any) -> AsyncIterator[Rig]:
    """Join driver and twin of a protocol; ``twin`` are options of the twin."""
    if kind == "modbus":
        async with _modbus_rig(opened, **twin) as modbus:
            yield modbus
        return
    axes = "x" if kind == "aerosmith" else "xyz"
    model = model_of(axes, COUNTS[kind])
    near, far = pair("table")
    wire = MemoryWire(far)
    table, wire.controller = byte_pair(kind, near, model, wire.write, axes, **twin)
    carrier = asyncio.get_running_loop().create_task(wire.carry())

    async def silence() -> None:
        wire.silent = True

    def speak() -> None:
        wire.silent = False

    try:
        if opened:
            await table.open()
        yield Rig(table, model, axes, COUNTS[kind], silence, speak)
    finally:
        carrier.cancel()
        table.close()


@asynccontextmanager
async def _modbus_rig(opened: bool, watchdog_s: float = 0.0) -> AsyncIterator[Rig]:
    profile, unit_ids = load_profile("kinco"), {"x": 1, "y": 2, "z": 3}
    model = model_of("xyz", COUNTS["modbus"])
    address = (NULLMODEM_HOST, next(_wires))
    server = modbus_server(TableTwinSetup(model, unit_ids, {"profile": profile}, watchdog_s), address)
    await server.serve_forever(background=True)
    drives = {axis: AxisSetup(unit_id, COUNTS["modbus"], LIMITS) for axis, unit_id in unit_ids.items()}
    table = ModbusTable(setup_of("modbus", drives, TIMEOUT_S, profile=profile), address)
    try:
        if opened:
            await table.open()
        yield Rig(table, model, "xyz", COUNTS["modbus"], server.shutdown)
    finally:
        table.close()
        await server.shutdown()
