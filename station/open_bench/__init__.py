"""Turns a bench into drivers on links, and builds the twins at the far end of those that say so.

The only package of the station that knows that there are twins.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qs, urlsplit

from drivers.byte_links import MemoryLink, SerialLink, TcpLink
from drivers.can_imu import BUILT_IN_DBC, CanChannel, CanImu
from drivers.can_link import CanLink
from drivers.can_memory import MemoryBus
from drivers.modbus_table import DriveAxis, ModbusTable
from drivers.seams import ByteLink, ImuSource, Turntable
from drivers.stim300_imu import Stim300Imu
from station.bench import Bench, ImuConfig
from station.errors import BenchError
from station.open_bench.simulate import DeviceTruth, Hidden, simulate, simulate_bench
from station.open_bench.twins import Twins, serve_twins, wires

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

TWIN = "twin:"


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


def with_links(bench: Bench, links: dict[str, str], devices: Sequence[str]) -> Bench:
    """Return the bench with other links (by device name, or "table"), and with only these devices used.

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
    return replace(bench, table=replace(bench.table, link=links.get("table", bench.table.link)), imus=imus)


def needs_only_memory(bench: Bench) -> bool:
    """Return whether every link leads to a twin, so that virtual time will do."""
    return all(link == TWIN for link in (bench.table.link, *(imu.link for imu in bench.imus if imu.used)))


@asynccontextmanager
async def open_bench(bench: Bench, *, time_scale: float = 1.0) -> AsyncIterator[OpenBench]:
    """Build links, twins and drivers; all twins end with the context.

    ``time_scale`` is how fast the loop's clock runs: what waits for a host, not for physics, is stretched by
    it.
    """
    used = [imu for imu in bench.imus if imu.used]
    if not used:
        raise BenchError("no device of the bench is used: set used = true, or name one with --device")
    async with AsyncExitStack() as stack:
        twins = Twins(bench, stack)
        address = (
            await twins.serve_table_in_memory() if bench.table.link == TWIN else _tcp(bench.table.link, "table", 502)
        )
        table = ModbusTable(
            "table",
            address,
            bench.table.profile,
            {name: DriveAxis(a.unit_id, a.counts_per_turn, a.limits) for name, a in bench.table.axes.items()},
            bench.table.timeout_s * time_scale,
        )
        imus = []
        for imu in used:
            source = _can_imu(imu, twins) if imu.protocol == "can" else _stim300(imu, twins, time_scale)
            imus.append(OpenImu(imu, source))
        yield OpenBench(bench, table, tuple(imus))


def _can_imu(imu: ImuConfig, twins: Twins) -> ImuSource:
    channels = tuple(
        CanChannel(name, rate, temperature)
        for name, (rate, temperature) in zip(imu.array.names, imu.signals, strict=True)
    )
    dbc = imu.dbc or BUILT_IN_DBC
    if imu.link == TWIN:
        channel = f"wire{next(wires)}"
        link = CanLink(imu.name, "memory", channel, {})
        twins.serve_can(imu, MemoryBus(channel))
    else:
        interface, channel, options = _can_address(imu)
        link = CanLink(imu.name, interface, channel, options)
    return CanImu(imu.name, link, dbc, channels, imu.rate_hz)


def _stim300(imu: ImuConfig, twins: Twins, time_scale: float) -> ImuSource:
    link: ByteLink
    if imu.link == TWIN:
        near, far = MemoryLink.pair(imu.name)
        twins.serve_stim300(imu, far.write)
        link = near
    elif imu.link.startswith("serial:"):
        url = urlsplit(imu.link)
        options = parse_qs(url.query)
        if not url.path or set(options) - {"baud"}:
            raise BenchError(f"{imu.name}: {imu.link!r} is no serial link: write serial:///dev/ttyUSB0?baud=921600")
        link = SerialLink(imu.name, url.path, int(options.get("baud", ["921600"])[0]))
    else:
        host, port = _tcp(imu.link, imu.name, None)
        link = TcpLink(imu.name, host, port, 2.0 * time_scale)
    return Stim300Imu(imu.name, link, round(imu.rate_hz))


def _tcp(link: str, device: str, default_port: int | None) -> tuple[str, int]:
    try:
        url = urlsplit(link)
        port = url.port or default_port
    except ValueError:
        url, port = urlsplit(""), None
    if url.scheme != "tcp" or not url.hostname or port is None:
        raise BenchError(f"{device}: {link!r} is no link it can use: write tcp://host:port, or twin:")
    return url.hostname, port


def _can_address(imu: ImuConfig) -> tuple[str, str, dict[str, Any]]:
    """Split can:INTERFACE:CHANNEL?option=value; numbers among the options become numbers."""
    address, _, query = imu.link.partition("?")
    parts = address.split(":", 2)
    if len(parts) != 3 or parts[0] != "can" or not parts[1]:
        raise BenchError(
            f"{imu.name}: {imu.link!r} is no CAN link: write can:INTERFACE:CHANNEL, for instance can:socketcan:can0"
        )
    options: dict[str, Any] = {key: values[0] for key, values in parse_qs(query).items()}
    for key, value in options.items():
        with suppress(ValueError):
            options[key] = float(value) if "." in value else int(value)
    if parts[1] == "slcan":
        options.setdefault("sleep_after_open", 0.1)  # python-can waits two seconds for an Arduino's boot
    return parts[1], parts[2], options
