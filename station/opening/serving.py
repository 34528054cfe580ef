"""Twins on real ports, for `station twin`."""

import asyncio
import json
import socket
from collections.abc import Awaitable, Callable
from contextlib import AsyncExitStack, suppress
from functools import partial
from typing import Any

import can

from drivers.errors import DeviceError
from drivers.imus.kind import SPEC as IMU
from drivers.tables.kind import SPEC as TABLE
from sims.wires.slcan_adapter import SlcanAdapter
from sims.wires.socketcand_server import SocketcandServer
from sims.wires.wires import ByteDevice, Plug, Write, on_pty, on_tcp
from station.bench.bench import Bench
from station.bench.device import AnyDevice
from station.bench.imu import ImuConfig
from station.opening.links import can_address
from station.opening.twins import Twins

_MULTICAST = "239.74.163.2"
_BUS = "can0"


async def serve_twins(
    bench: Bench, *, time_scale: float, host: str, port: int, announce: Callable[[str], None]
) -> None:
    """Serve every twin of the bench on real ports until cancelled.

    ``announce`` gets a line of JSON for each, with its name as "device" and its announcement, then one with "ready" and
    "time_scale". ``host`` is the address to listen on, ``port`` that of the table, 0 for any. [twin.wires] of the bench
    file says what each is served on. ``time_scale`` is how fast the clock of the twins runs.
    """
    async with AsyncExitStack() as stack:
        serving = Serving(Twins(bench, stack, time_scale), stack, host)

        def tell(**said: Any) -> None:
            announce(json.dumps(said))

        for device in bench.devices.values():
            tell(device=device.name, **await serving.serve(device, port))
        tell(ready=True, time_scale=time_scale)
        await asyncio.Event().wait()


class Serving:
    """Serves the twins of one bench."""

    def __init__(self, twins: Twins, stack: AsyncExitStack, host: str) -> None:
        self._twins, self._stack, self._host = twins, stack, host

    async def serve(self, device: AnyDevice, port: int) -> dict[str, Any]:
        """Serve the twin of a device; return its announcement, the link first. ``port`` is that of the table."""
        of_kind: dict[str, Callable[[Any], Awaitable[dict[str, Any]]]] = {
            TABLE.name: lambda _: self.table(port),
            IMU.name: self.imu,
        }
        serve = of_kind.get(device.kind.name)
        return await (self.other(device) if serve is None else serve(device))

    async def table(self, port: int) -> dict[str, Any]:
        """Serve the twin of the table on a pseudo-terminal, Modbus TCP or TCP; return its announcement.

        ``port`` is that of TCP, 0 for a free one. The announcement has "link" first, "protocol", "watchdog_s", and the
        addresses by axis, as "unit_ids" on Modbus, whose protocol ends with -tcp or -rtu, else as "axes".
        """
        config, wire = self._twins.bench.table, self._twins.wire("table")
        addresses = {name: axis.address for name, axis in config.axes.items()}
        settings = {"protocol": config.protocol, "watchdog_s": self._twins.watchdog_s}
        if config.spec.opens_links:
            settings |= {"protocol": f"{config.protocol}-{'rtu' if wire == 'serial' else 'tcp'}", "unit_ids": addresses}
        else:
            settings["axes"] = addresses
        if wire == "serial":
            return {"link": await self._pty("table", self._twins.table_device), **settings}
        if config.spec.opens_links:
            server = await self._twins.serve_table((self._host, port))
            bound = server.transport.sockets[0].getsockname()
            return {"link": f"tcp://{bound[0]}:{bound[1]}", **settings}
        return {"link": await self._tcp("table", self._twins.table_device, port), **settings}

    async def imu(self, imu: ImuConfig) -> dict[str, Any]:
        """Serve a device under test; return its announcement: link, protocol and rate."""
        make = partial(self._twins.imu_device, imu)
        link = await (self._bus(imu) if imu.spec.on_can else self._bytes(imu.name, make))
        return {"link": link, "protocol": imu.protocol, "rate_hz": imu.rate_hz}

    async def other(self, device: Any) -> dict[str, Any]:
        """Serve a device of another kind."""
        link = await self._bytes(device.name, partial(self._twins.other_device, device))
        return {"link": link, "protocol": device.spec.name}

    async def _bytes(self, device: str, make: Callable[[Write], ByteDevice]) -> str:
        """Serve a device that speaks bytes; return its link."""
        return await (self._tcp(device, make, 0) if self._twins.wire(device) == "tcp" else self._pty(device, make))

    async def _bus(self, imu: ImuConfig) -> str:
        """Serve a device on its own CAN bus, of the kind that its wire has; return its link.

        udp_multicast gets a free port; any other wire that is no adapter's is the link itself. DeviceError if the bus
        cannot be opened.
        """
        wire = self._twins.wire(imu.name)
        if wire == "slcan":
            return await self._slcan(imu)
        if wire == "socketcand":
            return await self._socketcand(imu)
        # A port of its own, so that two stations on one machine do not receive each other's arrays.
        link = f"can:udp_multicast:{_MULTICAST}?port={_free_port()}&hop_limit=0" if wire == "udp_multicast" else wire
        interface, channel, options = can_address(link, imu.name)
        try:
            bus = can.Bus(channel, interface, **options)
        except Exception as error:  # interfaces raise any exception of their vendors' libraries
            raise DeviceError(f"{imu.name} twin", f"cannot open {link} ({error})") from None
        self._stack.callback(bus.shutdown)
        node = self._twins.bus_device(imu, partial(_Node, bus))
        asyncio.get_running_loop().add_reader(bus.fileno(), node.read)
        self._stack.callback(asyncio.get_running_loop().remove_reader, bus.fileno())
        return link

    async def _slcan(self, imu: ImuConfig) -> str:
        def adapter(write: Write) -> SlcanAdapter:
            made = partial(SlcanAdapter, write, clock=asyncio.get_running_loop().time)
            return self._twins.bus_device(imu, made)

        name = await self._stack.enter_async_context(on_pty(adapter))
        return f"can:slcan:{name}"

    async def _socketcand(self, imu: ImuConfig) -> str:
        server = self._twins.bus_device(imu, partial(SocketcandServer, _BUS))
        bound = await server.start(self._host)
        self._stack.push_async_callback(server.close)
        return f"can:socketcand:{_BUS}?host={bound[0]}&port={bound[1]}"

    async def _pty(self, device: str, make: Callable[[Write], ByteDevice]) -> str:
        plug = Plug()
        name = await self._stack.enter_async_context(on_pty(self._twins.faulty(device, make, plug), plug))
        return f"serial://{name}"

    async def _tcp(self, device: str, make: Callable[[Write], ByteDevice], port: int) -> str:
        """Serve a device on TCP with the faults of its wire; return its link.

        ``port`` is one of the host, 0 for a free one. DeviceError if it is taken.
        """
        plug = Plug()
        try:
            wire = on_tcp(self._twins.faulty(device, make, plug), self._host, port, plug)
            bound = await self._stack.enter_async_context(wire)
        except OSError as error:
            raise DeviceError("twin", f"cannot listen on {self._host}:{port} ({error}). Is the port free?") from None
        return f"tcp://{bound[0]}:{bound[1]}"


class _Node:
    """One end of a bus that may be down for a while; frames that cannot be sent are lost."""

    def __init__(self, bus: can.BusABC, hear: Callable[[can.Message], None]) -> None:
        self._bus, self._hear = bus, hear

    def send(self, msg: can.Message) -> None:
        with suppress(can.CanError):
            self._bus.send(msg)

    def read(self) -> None:
        with suppress(can.CanError):
            while (message := self._bus.recv(0)) is not None:
                self._hear(message)


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.bind(("", 0))
        return int(asked.getsockname()[1])
