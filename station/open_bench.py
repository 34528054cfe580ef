"""Turns a bench into drivers on links, and builds the twins at the far end of those that say so.

The only module of the station that knows that there are twins.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import os
import tty
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any
from urllib.parse import parse_qs, urlsplit

import can
from pymodbus.transport import NULLMODEM_HOST

from drivers.byte_links import MemoryLink, SerialLink, TcpLink
from drivers.can_imu import BUILT_IN_DBC, CanChannel, CanImu
from drivers.can_link import CanLink
from drivers.can_memory import MemoryBus
from drivers.errors import DeviceError
from drivers.modbus_table import DriveAxis, ModbusTable
from drivers.seams import ByteLink, ImuSource, Turntable
from drivers.stim300_imu import Stim300Imu
from sims.body import Body
from sims.can_nodes import CanNodes
from sims.geometry import MOUNTS_DEG, Mounting, along, mounted
from sims.gyro import GyroArray, GyroTruth
from sims.modbus import modbus_server
from sims.stim300_device import Stim300Device
from sims.table import AxisData, TableModel
from station.bench import Bench, ImuConfig
from station.errors import BenchError
from station.tables import Table

TWIN = "twin:"
_wires = itertools.count(1)  # names of wires in memory, one each within a process


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
        twins = _Twins(bench, stack)
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


def _can_imu(imu: ImuConfig, twins: _Twins) -> ImuSource:
    channels = tuple(
        CanChannel(name, rate, temperature)
        for name, (rate, temperature) in zip(imu.array.names, imu.signals, strict=True)
    )
    dbc = imu.dbc or BUILT_IN_DBC
    if imu.link == TWIN:
        channel = f"wire{next(_wires)}"
        link = CanLink(imu.name, "memory", channel, {})
        twins.serve_can(imu, MemoryBus(channel))
    else:
        interface, channel, options = _can_address(imu)
        link = CanLink(imu.name, interface, channel, options)
    return CanImu(imu.name, link, dbc, channels, imu.rate_hz)


def _stim300(imu: ImuConfig, twins: _Twins, time_scale: float) -> ImuSource:
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


class _Twins:
    """The twins of a bench: one table model, gyros that ride on it, and the tasks that serve them."""

    def __init__(self, bench: Bench, stack: AsyncExitStack) -> None:
        self._bench, self._stack = bench, stack
        loop = asyncio.get_running_loop()
        truths = bench.twin.truths.again()
        start = truths.quantities("start", "angle", len(bench.table.gimbals), 0.0)
        axes = {
            name: AxisData(axis.limits.rate_rps, axis.limits.acceleration_rps2, axis.counts_per_turn, angle)
            for (name, axis), angle in zip(bench.table.axes.items(), start, strict=True)
        }
        self.table = TableModel(axes, loop.time)
        site = bench.site
        latitude, heading = (site.latitude_rad, site.heading_rad) if site else (math.pi / 4, 0.0)
        self._body = Body(bench.table.gimbals, self.table.angles, self.table.revision, latitude, heading)
        self._truths = {imu.name: _truth(truths, imu) for imu in bench.imus}
        self._read_faults(truths)
        truths.done()

    async def serve_table_in_memory(self) -> tuple[str, int]:
        address = (NULLMODEM_HOST, next(_wires))
        await self.serve_table(address, self._bench.twin.watchdog_s)
        return address

    async def serve_table(self, address: tuple[str, int], watchdog_s: float) -> Any:
        config = self._bench.table
        units = {name: axis.unit_id for name, axis in config.axes.items()}
        server = modbus_server(self.table, config.profile, units, address, watchdog_s)
        try:
            await server.serve_forever(background=True)
        except RuntimeError:
            raise DeviceError("table twin", f"cannot listen on {address[0]}:{address[1]}; is the port free?") from None
        self._stack.push_async_callback(server.shutdown)
        return server

    def gyros(self, imu: ImuConfig) -> GyroArray:
        index = [other.name for other in self._bench.imus].index(imu.name)
        return GyroArray(
            _mounting(imu), self._truths[imu.name], self._body, imu.rate_hz, (self._bench.twin.seed, index)
        )

    def serve_can(self, imu: ImuConfig, bus: can.BusABC) -> None:
        self._stack.callback(bus.shutdown)
        nodes = CanNodes(self.gyros(imu), bus, imu.dbc or BUILT_IN_DBC, imu.signals, imu.rate_hz)
        self._run(nodes.serve())

    def serve_stim300(self, imu: ImuConfig, write: Callable[[bytes], None]) -> None:
        self._run(Stim300Device(self.gyros(imu), write, round(imu.rate_hz)).serve())

    def _run(self, twin: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(twin)

        async def end() -> None:
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task

        self._stack.push_async_callback(end)

    def _read_faults(self, truths: Table) -> None:
        """Arm the fault input of one axis, for trying what the station does about it."""
        if not truths.has("fault"):
            return
        fault = truths.table("fault")
        axis = fault.string("axis", one_of=self._bench.table.axes)
        at_s = fault.quantity("at", "time")
        fault.done()
        loop = asyncio.get_running_loop()
        handle = loop.call_at(loop.time() + at_s, self.table.trip, axis, "fault input")
        self._stack.callback(handle.cancel)


def _truth(truths: Table, imu: ImuConfig) -> GyroTruth:
    import numpy as np

    table = truths.table(imu.name, optional=True)
    n = len(imu.array)
    truth = GyroTruth(
        k=np.array(table.quantities("k", "ratio", n, 0.0)),
        b_rps=np.array(table.quantities("b", "rate", n, 0.0)),
        sigma_j_rad=np.array(table.quantities("sigma_j", "angle", n, 0.0)),
        sigma_k_rad=np.array(table.quantities("sigma_k", "angle", n, 0.0)),
        arw_rps_rthz=table.quantity("arw", "angle random walk", imu.arw_rps_rthz),
        bias_instability_rps=table.quantity("bias_instability", "rate", 0.0),
        temperature_c=table.quantity("temperature", "temperature", 25.0),
    )
    table.done()
    return truth


def _mounting(imu: ImuConfig) -> Mounting:
    if imu.array_name in MOUNTS_DEG:
        return mounted(MOUNTS_DEG[imu.array_name])
    # Explicit axes are what the bench file says, for the twin as for the estimator.
    explicit = Mounting(imu.array.p, imu.array.j, imu.array.k)
    return explicit if imu.array_name == "explicit" else along(imu.array.p.tolist())


async def serve_twins(
    bench: Bench, *, time_scale: float, host: str, port: int, announce: Callable[[str], None]
) -> None:
    """Serve every twin of the bench on real ports until cancelled; announce each address as a line of JSON."""
    async with AsyncExitStack() as stack:
        twins = _Twins(bench, stack)
        server = await twins.serve_table((host, port), bench.twin.watchdog_s * time_scale)
        bound = server.transport.sockets[0].getsockname()
        announce(
            json.dumps(
                {
                    "device": "table",
                    "link": f"tcp://{bound[0]}:{bound[1]}",
                    "protocol": "modbus-tcp",
                    "unit_ids": {name: axis.unit_id for name, axis in bench.table.axes.items()},
                    "watchdog_s": bench.twin.watchdog_s * time_scale,
                }
            )
        )
        for imu in bench.imus:
            if imu.protocol == "can":
                # A port of its own, so that two stations on one machine do not hear each other's arrays.
                options = {"port": 43113 + bound[1] % 1000, "hop_limit": 0}
                bus = can.Bus(interface="udp_multicast", channel="239.74.163.2", **options)
                twins.serve_can(imu, bus)
                query = "&".join(f"{key}={value}" for key, value in options.items())
                link = f"can:udp_multicast:239.74.163.2?{query}"
            else:
                link = f"serial://{_serve_on_pty(twins, imu, stack)}"
            announce(json.dumps({"device": imu.name, "link": link, "protocol": imu.protocol, "rate_hz": imu.rate_hz}))
        announce(json.dumps({"ready": True, "time_scale": time_scale}))
        await asyncio.Event().wait()


def _serve_on_pty(twins: _Twins, imu: ImuConfig, stack: AsyncExitStack) -> str:
    """Serve a STIM300 on a new pseudo-terminal and return its name.

    The far end is kept open so that the device goes on when a station leaves; what nobody reads is dropped.
    """
    ours, theirs = os.openpty()
    tty.setraw(ours)
    tty.setraw(theirs)
    os.set_blocking(ours, False)
    stack.callback(os.close, ours)
    stack.callback(os.close, theirs)

    def write(data: bytes) -> None:
        with suppress(BlockingIOError):
            os.write(ours, data)

    twins.serve_stim300(imu, write)
    return os.ttyname(theirs)
