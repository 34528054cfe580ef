"""Turns a bench into drivers on links, and builds the twins at the far end of those that say so.

The only package of the station that knows that there are twins.
"""

import sys
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, replace
from typing import Any

from drivers.links.counted import CountedLink
from drivers.links.lock import held
from drivers.protocols import ImuSource, Turntable
from drivers.specs import ImuSetup, TableSetup
from drivers.tables.recipe import packed_table
from drivers.types import LinkCounts
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.bench.table import TWIN
from station.errors import BenchError
from station.opening.links import driver_link
from station.opening.serving import serve_twins as serve_twins
from station.opening.simulate import (
    DeviceTruth as DeviceTruth,
    Hidden as Hidden,
    simulate as simulate,
    simulate_bench as simulate_bench,
)
from station.opening.twins import Twins

_GATHER_S = 0.005
_ANSWER_S = 0.25  # one try of a question to a sensor, of which there are two: silence is known after half a second


@dataclass(frozen=True, slots=True)
class OpenImu:
    """A device under test with its driver."""

    config: ImuConfig
    source: ImuSource
    counts: LinkCounts
    """Of its link."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardedTable:
    """What another process needs to stop the table if this one is killed.

    ``packed`` makes the driver (``drivers.tables.recipe``), ``locks`` are the descriptors that hold its links.
    """

    packed: bytes
    locks: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OpenBench:
    """The drivers of a bench, not yet opened themselves."""

    bench: Bench
    table: Turntable
    imus: tuple[OpenImu, ...]
    at_rest: Callable[[], bool] = lambda: True
    """Whether the table of the twins is at rest, for trying what the station leaves behind."""
    guarded: GuardedTable | None = None
    """None for a twin in this process, which ends with it, and where processes hold no locks."""

    def link_counts(self) -> dict[str, LinkCounts]:
        """Return by device what went over its link; none of a table from outside that opens its links itself."""
        of_table = getattr(self.table, "counts", None)
        found = {"table": of_table} if isinstance(of_table, LinkCounts) else {}
        return found | {imu.config.name: imu.counts for imu in self.imus}


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
        raise BenchError("the bench file uses no device. Set used = true, or name one with --device")
    async with AsyncExitStack() as stack:
        time_scale = max(time_scale, 1.0)
        twins = Twins(bench, stack, time_scale)
        table, packed = await _table(bench, twins, time_scale)
        locks: tuple[int, ...] = ()
        for link in bench.table.links:
            if link != TWIN:
                holding = held("table", link, bench.table.spec.tcp_port, f"bench {bench.name}")
                locks += await stack.enter_async_context(holding)
        imus = tuple([await _imu(imu, twins, time_scale) for imu in used])
        guarded = GuardedTable(packed=packed, locks=locks) if packed else None
        yield OpenBench(bench, table, imus, twins.table.at_rest, guarded)


async def _table(bench: Bench, twins: Twins, time_scale: float) -> tuple[Turntable, bytes]:
    """Return the driver of the table, and what makes it in another process; nothing for a twin in this one."""
    config = bench.table
    spec = config.spec
    axes = {
        name: replace(axis, link=driver_link(spec, axis.link, f"axis {name}", time_scale) if axis.link else None)
        for name, axis in config.axes.items()
    }
    twin = config.link == TWIN
    link = await twins.table_in_memory() if twin else driver_link(spec, config.link, "table", time_scale)
    setup = TableSetup(axes, config.timeout_s * time_scale, config.options)
    packed = b"" if twin or sys.platform == "win32" else packed_table(spec, setup, link)
    return spec.make(setup, link if spec.opens_links else CountedLink(link)), packed


async def _imu(imu: ImuConfig, twins: Twins, time_scale: float) -> OpenImu:
    spec = imu.spec
    link: Any
    if imu.link == TWIN:
        link = twins.bus_in_memory(imu) if spec.on_can else twins.imu_in_memory(imu)
    else:
        link = driver_link(spec, imu.link, imu.name, time_scale, gather_s=_GATHER_S)
    counted = CountedLink(link)
    source = spec.make(ImuSetup(imu.name, imu.rate_hz, _ANSWER_S * time_scale, imu.options, imu.can), counted)
    return OpenImu(imu, source, counted.counts)
