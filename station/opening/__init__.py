"""Turns a bench into drivers on links, and builds the twins at the far end of those that say so.

The only package of the station that knows that there are twins.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace

from drivers.links.can_link import CanLink
from drivers.links.lock import held
from drivers.protocols import ImuSource, Turntable
from station.bench.bench import Bench
from station.bench.imu import ON_CAN, ImuConfig
from station.bench.table import TWIN
from station.errors import BenchError
from station.opening.devices import BAUD, TCP_PORT, byte_imu, byte_table, frame_imu, modbus_table
from station.opening.links import byte_link, can_address, modbus_address
from station.opening.serving import serve_twins
from station.opening.simulate import DeviceTruth, Hidden, simulate, simulate_bench
from station.opening.twins import Twins

__all__ = [
    "TWIN",
    "DeviceTruth",
    "Hidden",
    "OpenBench",
    "OpenImu",
    "needs_only_memory",
    "open_bench",
    "serve_twins",
    "simulate",
    "simulate_bench",
    "with_links",
]


_GATHER_S = 0.005


@dataclass(frozen=True, slots=True)
class OpenImu:
    """A device under test with its driver."""

    config: ImuConfig
    source: ImuSource


@dataclass(frozen=True, slots=True)
class OpenBench:
    """The drivers of a bench, not yet opened themselves."""

    bench: Bench
    table: Turntable
    imus: tuple[OpenImu, ...]
    at_rest: Callable[[], bool] = lambda: True
    """Whether the table of the twins is at rest, for trying what the station leaves behind."""


def with_links(bench: Bench, links: dict[str, str], devices: Sequence[str]) -> Bench:
    """Return the bench with other links (by device name, or "table"), and with only these devices used.

    Another link of the table is that of all its axes.

    BenchError for a name that the bench does not have.
    """
    names = [imu.name for imu in bench.imus]
    for name in (*links, *devices):
        if name not in names and not (name == "table" and name in links):
            raise BenchError(f"the bench has no device {name!r}; it has table, {', '.join(names)}")
    imus = tuple(
        replace(
            imu,
            link=links.get(imu.name, imu.link),
            used=imu.name in devices if devices else imu.used or imu.name in links,
        )
        for imu in bench.imus
    )
    return replace(bench, table=bench.table.at(links["table"]) if "table" in links else bench.table, imus=imus)


def needs_only_memory(bench: Bench) -> bool:
    """Return whether every link leads to a twin, so that virtual time will do."""
    return all(link == TWIN for link in (bench.table.link, *(imu.link for imu in bench.imus if imu.used)))


@asynccontextmanager
async def open_bench(bench: Bench, *, time_scale: float = 1.0) -> AsyncIterator[OpenBench]:
    """Build links, twins and drivers; all twins end with the context.

    ``time_scale`` is how fast the loop's clock runs: what waits for a host, not for physics, is stretched by it, and
    not shortened where it is below 1, as devices are slow then, too. The table's links are held: DeviceRefused if
    another program of this machine has one.
    """
    used = [imu for imu in bench.imus if imu.used]
    if not used:
        raise BenchError("no device of the bench is used: set used = true, or name one with --device")
    async with AsyncExitStack() as stack:
        time_scale = max(time_scale, 1.0)
        twins = Twins(bench, stack, time_scale)
        table = await _table(bench, twins, time_scale)
        for link in bench.table.links:
            if link != TWIN:
                port = TCP_PORT.get(bench.table.protocol)
                await stack.enter_async_context(held("table", link, port, f"bench {bench.name}"))
        imus = tuple([OpenImu(imu, await _source(imu, twins, time_scale)) for imu in used])
        yield OpenBench(bench, table, imus, twins.table.at_rest)


async def _table(bench: Bench, twins: Twins, time_scale: float) -> Turntable:
    config = bench.table
    if config.protocol == "modbus":
        if config.link == TWIN:
            return modbus_table(config, await twins.modbus_in_memory(), {}, time_scale)
        own = {name: modbus_address(axis.link, f"axis {name}") for name, axis in config.axes.items() if axis.link}
        return modbus_table(config, modbus_address(config.link, "table"), own, time_scale)
    if config.link == TWIN:
        return byte_table(config, twins.table_in_memory(), time_scale)
    link = byte_link(
        config.link, "table", baud=BAUD[config.protocol], time_scale=time_scale, port=TCP_PORT.get(config.protocol)
    )
    return byte_table(config, link, time_scale)


async def _source(imu: ImuConfig, twins: Twins, time_scale: float) -> ImuSource:
    if imu.protocol in ON_CAN:
        if imu.link == TWIN:
            return frame_imu(imu, twins.bus_in_memory(imu))
        interface, channel, options = can_address(imu.link, imu.name)
        return frame_imu(imu, CanLink(imu.name, interface, channel, options))
    if imu.link == TWIN:
        return byte_imu(imu, twins.imu_in_memory(imu), time_scale)
    link = byte_link(imu.link, imu.name, baud=BAUD[imu.protocol], time_scale=time_scale, gather_s=_GATHER_S)
    return byte_imu(imu, link, time_scale)
