"""The twins of a bench: in memory at the far end of a link, or served on real ports."""

from __future__ import annotations

import asyncio
import itertools
import json
import math
import os
import tty
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack, suppress
from typing import Any

import can
import numpy as np
from pymodbus.transport import NULLMODEM_HOST

from drivers.can_imu import BUILT_IN_DBC
from drivers.errors import DeviceError
from sims.body import Body
from sims.can_nodes import CanNodes
from sims.geometry import MOUNTS_DEG, Mounting, along, mounted
from sims.gyro import GyroArray, GyroTruth
from sims.hidden import Hidden, HiddenError
from sims.hidden.table import TableFaults
from sims.modbus import modbus_server
from sims.stim300_device import Stim300Device
from sims.table import AxisData, TableModel
from station.bench import Bench, ImuConfig
from station.errors import BenchError
from station.tables import Table

wires = itertools.count(1)
"""Names of wires in memory, one each within a process."""


class Twins:
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
        self._hidden = hidden_of(bench)
        faults = self._hidden.table if self._hidden is not None else TableFaults()
        self.table = TableModel(axes, loop.time, faults)
        site = bench.site
        latitude, heading = (site.latitude_rad, site.heading_rad) if site else (math.pi / 4, 0.0)
        self._body = Body(
            bench.table.gimbals,
            self.table.angles,
            self.table.revision,
            latitude,
            heading,
            directions=faults.directions(bench.table.gimbals),
        )
        self._truths = {imu.name: truth_of(truths, imu) for imu in bench.imus}
        self._read_faults(truths)
        truths.done()

    async def serve_table_in_memory(self) -> tuple[str, int]:
        address = (NULLMODEM_HOST, next(wires))
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
        twin = self._bench.twin
        try:
            return GyroArray(
                mounting_of(imu),
                self._truths[imu.name],
                self._body,
                imu.rate_hz,
                (twin.seed, index),
                self._hidden.of_device(imu.name) if self._hidden is not None else None,
                twin.started_s,
            )
        except HiddenError as error:
            raise BenchError(f"{twin.hidden}: {imu.name}: {error}") from None

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


def hidden_of(bench: Bench) -> Hidden | None:
    """Return what is wrong with the twins of a bench; BenchError for a file that cannot be right."""
    if bench.twin.hidden is None:
        return None
    try:
        return Hidden.load(bench.twin.hidden)
    except HiddenError as error:
        raise BenchError(str(error)) from None


def truth_of(truths: Table, imu: ImuConfig) -> GyroTruth:
    table = truths.table(imu.name, optional=True)
    n = len(imu.array)
    truth = GyroTruth(
        k=np.array(table.quantities("k", "ratio", n, 0.0)),
        b_rps=np.array(table.quantities("b", "rate", n, 0.0)),
        sigma_j_rad=np.array(table.quantities("sigma_j", "angle", n, 0.0)),
        sigma_k_rad=np.array(table.quantities("sigma_k", "angle", n, 0.0)),
        arw_rps_rthz=table.quantity("arw", "angle random walk", imu.arw_rps_rthz),
        bias_instability_rps=table.quantity("bias_instability", "rate", 0.0),
        rate_random_walk_rps_rts=table.quantity("rate_random_walk", "rate random walk", 0.0),
        temperature_c=table.quantity("temperature", "temperature", 25.0),
    )
    table.done()
    return truth


def mounting_of(imu: ImuConfig) -> Mounting:
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
        twins = Twins(bench, stack)
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


def _serve_on_pty(twins: Twins, imu: ImuConfig, stack: AsyncExitStack) -> str:
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
