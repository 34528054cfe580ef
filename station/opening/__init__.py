"""Opens a bench: drivers on their links, and the twins at the far end of twin links.

The only package of the station that knows that there are twins.
"""

import sys
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from drivers.links.counted import CountedLink
from drivers.links.lock import held
from drivers.protocols import Device, ImuSource, Turntable
from drivers.recipe import packed_device
from drivers.specs import DeviceSetup, ImuSetup, TableSetup
from drivers.types import LinkCounts
from station.bench.bench import Bench
from station.bench.device import AnyDevice, DeviceConfig
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


@dataclass(frozen=True, slots=True)
class OpenDevice:
    """A device of any kind with its driver, not yet opened itself."""

    config: AnyDevice
    driver: Device
    link_counts: LinkCounts | None
    """Of its link; None where its driver opens its links itself."""
    packed: bytes = b""
    """What makes its driver in another process (``drivers.recipe``); empty if nothing has to make it safe there."""

    @property
    def counts(self) -> LinkCounts | None:
        """Counts of its link so far; None for a driver that opens its links itself and does not count."""
        counts = getattr(self.driver, "counts", None) if self.link_counts is None else self.link_counts
        return counts if isinstance(counts, LinkCounts) else None

    @property
    def name(self) -> str:
        """Its name on the bench."""
        return self.config.name


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardedDevices:
    """All that another process needs to make devices safe if this one is killed.

    ``packed`` rebuilds the drivers (``drivers.recipe``), in the order in which they are made safe; ``locks`` are the
    descriptors that hold their links.
    """

    packed: tuple[bytes, ...]
    locks: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class OpenBench:
    """The drivers of a bench. The drivers themselves have not been opened."""

    bench: Bench
    table: Turntable
    imus: tuple[OpenImu, ...]
    at_rest: Callable[[], bool] = lambda: True
    """Whether the table of the twins is at rest, for trying what the station leaves behind."""
    guarded: GuardedDevices | None = None
    """None for twins in this process, which end with it, and where processes hold no locks."""
    devices: Mapping[str, OpenDevice] = field(default_factory=dict)
    """All of them by name: the table, those under test, others."""

    def __post_init__(self) -> None:
        """Enter ``self.table`` in ``devices`` as the driver of the table, which is made safe by it, and list it first.

        An entry is added if there is none.
        """
        name = self.bench.table.name
        known = self.devices.get(name)
        if known is None:
            known = OpenDevice(self.bench.table, self.table, None)
        others = {key: device for key, device in self.devices.items() if key != name}
        object.__setattr__(self, "devices", {name: replace(known, driver=self.table), **others})

    @property
    def others(self) -> tuple[OpenDevice, ...]:
        """The devices of kinds other than table and IMU."""
        names = {device.name for device in self.bench.others}
        return tuple(device for device in self.devices.values() if device.name in names)

    def in_safe_order(self) -> list[OpenDevice]:
        """Return the devices that have to be made safe, in that order."""
        return in_safe_order(self.devices.values())

    def link_counts(self) -> dict[str, LinkCounts]:
        """Return the link counts by device; devices whose drivers do not count are left out."""
        counts = {device.name: device.counts for device in self.devices.values()}
        return {name: found for name, found in counts.items() if found is not None}


def in_safe_order(devices: Iterable[OpenDevice]) -> list[OpenDevice]:
    """Return those of some devices that have to be made safe, in the order that their kinds state."""
    placed = [(device.config.kind.safe_order, device) for device in devices]
    ordered = [(order, device) for order, device in placed if order is not None]
    return [device for _, device in sorted(ordered, key=lambda one: one[0])]  # the table's order is the least


def with_links(bench: Bench, links: dict[str, str], devices: Sequence[str]) -> Bench:
    """Return the bench with other ``links``, by the name of a device or "table".

    The table's link replaces those of all its axes. If ``devices`` names devices under test, only these are used of
    them; else those that were and those with a link here. Of other kinds, those named and those with a link here are
    used in addition. BenchError for a name that the bench does not have, and for the table in ``devices`` without a
    link.
    """
    table = bench.table.name
    for name in (*links, *devices):
        if name not in bench.devices or (name == table and name not in links):
            raise BenchError(f"the bench has no device {name!r}; it has {', '.join(bench.devices)}")
    under_test = {imu.name for imu in bench.imus}.intersection(devices)
    imus = tuple(
        replace(
            imu,
            link=links.get(imu.name, imu.link),
            used=imu.name in devices if under_test else imu.used or imu.name in links,
        )
        for imu in bench.imus
    )
    others = tuple(
        replace(
            device,
            link=links.get(device.name, device.link),
            used=device.used or device.name in links or device.name in devices,
        )
        for device in bench.others
    )
    at_link = bench.table.at(links[table]) if table in links else bench.table
    return replace(bench, table=at_link, imus=imus, others=others)


def needs_only_memory(bench: Bench) -> bool:
    """Return whether every link leads to a twin, so that virtual time will do."""
    links = {bench.table.link}.union(*(device.links for device in bench.used if device is not bench.table))
    return links == {TWIN}


@asynccontextmanager
async def open_bench(bench: Bench, *, time_scale: float = 1.0) -> AsyncIterator[OpenBench]:
    """Build links, twins and drivers of the used devices; all twins end with the context. Drivers are not opened.

    ``time_scale`` is how fast the loop's clock runs: times that wait for a host, not for physics, are stretched by it,
    but never shortened. Links of devices that have to be made safe are locked until the context ends: DeviceRefused if
    another program of this machine holds one. BenchError if no device under test is used, or for an invalid link or
    truth of a twin; PluginError for a kind of device without a twin.
    """
    used = [imu for imu in bench.imus if imu.used]
    if not used:
        raise BenchError("the bench file uses no device. Set used = true, or name one with --device")
    async with AsyncExitStack() as stack:
        time_scale = max(time_scale, 1.0)
        twins = Twins(bench, stack, time_scale)
        table, packed = await _table_driver(bench, twins, time_scale)
        locks: tuple[int, ...] = ()
        for device in bench.used:
            for link in device.links if device.kind.safe_order is not None else ():
                if link != TWIN:
                    holding = held(device.name, link, device.spec.tcp_port, f"bench {bench.name}")
                    locks += await stack.enter_async_context(holding)
        imus = tuple([await _imu_driver(imu, twins, time_scale) for imu in used])
        devices = [OpenDevice(bench.table, table, None, packed)]
        devices += [OpenDevice(imu.config, imu.source, imu.counts) for imu in imus]
        devices += [_other_driver(device, twins, time_scale) for device in bench.others if device.used]
        recipes = tuple(device.packed for device in in_safe_order(devices) if device.packed)
        guarded = GuardedDevices(packed=recipes, locks=locks) if recipes else None
        yield OpenBench(
            bench=bench,
            table=table,
            imus=imus,
            at_rest=twins.table.at_rest,
            guarded=guarded,
            devices={device.name: device for device in devices},
        )


async def _table_driver(bench: Bench, twins: Twins, time_scale: float) -> tuple[Turntable, bytes]:
    """Return the driver of the table, and the pickle that rebuilds it in another process; a twin is started.

    The pickle is empty for a twin and on Windows. BenchError for an invalid link.
    """
    config = bench.table
    spec = config.spec
    axes = {
        name: replace(axis, link=driver_link(spec, axis.link, f"axis {name}", time_scale) if axis.link else None)
        for name, axis in config.axes.items()
    }
    twin = config.link == TWIN
    link = await twins.table_in_memory() if twin else driver_link(spec, config.link, "table", time_scale)
    setup = TableSetup(axes, config.timeout_s * time_scale, config.options)
    packed = b"" if twin or sys.platform == "win32" else packed_device(config.kind, spec, setup, link)
    return spec.make(setup, link if spec.opens_links else CountedLink(link)), packed


def _other_driver(config: DeviceConfig, twins: Twins, time_scale: float) -> OpenDevice:
    """Return the driver of a device of another kind, with the pickle that rebuilds it in another process.

    The pickle is empty unless it has to be made safe, and for a twin and on Windows. The counts are None if the driver
    opens its links itself. A twin is started. BenchError for an invalid link, PluginError for a kind of device without
    a twin.
    """
    spec = config.spec
    setup = DeviceSetup(
        name=config.name, timeout_s=config.timeout_s * time_scale, options=config.options, settings=config.settings
    )
    twin = config.link == TWIN
    link = twins.other_in_memory(config) if twin else driver_link(spec, config.link, config.name, time_scale)
    safe_elsewhere = config.kind.safe_order is not None and not twin and sys.platform != "win32"
    packed = packed_device(config.kind, spec, setup, link) if safe_elsewhere else b""
    if spec.opens_links:
        return OpenDevice(config, spec.make(setup, link), None, packed)
    counted = CountedLink(link)
    return OpenDevice(config, spec.make(setup, counted), counted.counts, packed)


async def _imu_driver(imu: ImuConfig, twins: Twins, time_scale: float) -> OpenImu:
    """Return the driver of a device under test, with its link counted; the link is not yet open.

    A twin is started. BenchError for an invalid link.
    """
    spec = imu.spec
    link: Any
    if imu.link == TWIN:
        link = twins.bus_in_memory(imu) if spec.on_can else twins.imu_in_memory(imu)
    else:
        link = driver_link(spec, imu.link, imu.name, time_scale, gather_s=_GATHER_S)
    counted = CountedLink(link)
    source = spec.make(ImuSetup(imu.name, imu.rate_hz, _ANSWER_S * time_scale, imu.options, imu.can), counted)
    return OpenImu(imu, source, counted.counts)
