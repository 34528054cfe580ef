"""The twins of a bench: one table, the controller that turns it, gyros that ride on it and the devices they are in."""

import asyncio
import itertools
import logging
import math
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from pymodbus.transport import NULLMODEM_HOST

from drivers.errors import DeviceError
from drivers.links.can_link import CanLink
from drivers.links.can_memory import MemoryBus
from drivers.plugins import PluginError
from drivers.protocols import ByteLink, FrameLink
from drivers.specs import DeviceSetup
from drivers.types import Floats
from estimator.geometry.kinematics import Site
from estimator.strict_toml import not_one_of
from sims.imus.registry import ImuTwinSetup, twin_of
from sims.physics.accelerometer import Accelerometers, AccelerometerTruth
from sims.physics.body import Body
from sims.physics.geometry import MOUNTS_DEG, Mounting, along, mounted, remounted
from sims.physics.gyro import GyroArray, GyroTruth
from sims.physics.hidden import Hidden, HiddenError
from sims.physics.hidden.table import TableFaults
from sims.physics.table import AxisData, TableModel
from sims.tables.modbus import FaultyModbus, modbus_server, pull_plug
from sims.tables.registry import TableTwinSetup, twin_of as twin_of_table
from sims.wires.faults import Exchanged, FaultyFrames, faulty_device
from sims.wires.frames import STANDARD_GRAVITY_MPS2, FrameSink, NodeFaults
from sims.wires.wires import ByteDevice, Plug, Write, in_memory
from station.bench.bench import Bench
from station.bench.device import DeviceConfig
from station.bench.imu import ImuConfig
from station.errors import BenchError
from station.opening.faults import read_faults, turn_knobs
from station.schema.tables import Table

_log = logging.getLogger(__name__)
_wires = itertools.count(1)
Bus = TypeVar("Bus", bound=FrameSink)
_APART = 0.005  # scale factors of two devices of a kind
_OF_FORCE = 85  # a seed of their own


class Twins:
    """The twins of a bench: one table model, the gyros on it, and the tasks that serve them."""

    def __init__(self, bench: Bench, stack: AsyncExitStack, time_scale: float) -> None:
        """Build the table model and read all truths and faults of the bench file; BenchError if one is invalid.

        ``time_scale`` above 1 lengthens the watchdog alone. Without a site the table stands at 45 deg latitude, heading
        0. Needs a running loop. Tasks and timers, as of a fault of the table, end with ``stack``.
        """
        self.bench, self._stack = bench, stack
        self.watchdog_s = bench.twin.watchdog_s * max(time_scale, 1.0)  # it waits for a host
        loop = asyncio.get_running_loop()
        truths = bench.twin.truths.again()
        settings = truths.read("bench.power_on", list_length=len(bench.table.gimbals))
        axes = {
            name: AxisData(axis.limits.rate_rps, axis.limits.acceleration_rps2, axis.counts_per_turn, angle)
            for (name, axis), angle in zip(bench.table.axes.items(), settings["start"], strict=True)
        }
        self._hidden = hidden_of(bench)
        faults = self._hidden.table if self._hidden is not None else TableFaults()
        self.table = TableModel(axes, loop.time, faults, bench.twin.started_s)
        site = bench.site
        latitude, heading = (site.latitude_rad, site.heading_rad) if site else (math.pi / 4, 0.0)
        self._body = Body(
            gimbals=bench.table.gimbals,
            angles=self.table.angles,
            revision=self.table.revision,
            latitude_rad=latitude,
            heading_rad=heading,
            directions=faults.directions(bench.table.gimbals),
        )
        self._wires = self._read_wires(settings["wires"])
        self._faults = read_faults(settings["fault"], truths, bench)
        self._forces = {imu.name: force_truth_of(truths, imu, site) for imu in bench.imus}
        self._mounts = {imu.name: mounting_of(truths, imu) for imu in bench.imus}
        self._truths = {imu.name: truth_of(truths, imu) for imu in bench.imus}
        truths.done()
        if (fault := self._faults.table) is not None:
            self._later(fault.at_s, partial(fault.strike, self.table, limits_trip=bench.table.spec.limits_trip))

    async def serve_table(self, address: tuple[str, int]) -> Any:
        """Serve the table's controller on Modbus TCP at a host and port, with the faults of its wire.

        Returns pymodbus's server, which ends with the bench. DeviceError if the port is taken.
        """
        faults = self._faults.wires["table"]
        wire = FaultyModbus(faults, self._seed("table")) if faults.any else None
        server = modbus_server(self._table_setup(), address, wire)
        try:
            await server.serve_forever(background=True)
        except RuntimeError:
            where = f"{address[0]}:{address[1]}"
            raise DeviceError("table twin", f"cannot listen on {where}. Is the port free?") from None
        self._stack.push_async_callback(server.shutdown)
        plug = Plug()

        def put_back() -> None:
            self.run(server.listen())

        plug.attach(partial(pull_plug, server), put_back)
        self._stack.callback(plug.detach)
        plug.schedule(faults.unplug_s, faults.replug_s)
        return server

    def _table_setup(self) -> TableTwinSetup:
        config = self.bench.table
        addresses = {name: axis.address for name, axis in config.axes.items()}
        return TableTwinSetup(
            self.table, addresses, config.options, self.watchdog_s, cycle_s=self.bench.twin.drive_cycle_s
        )

    def table_device(self, write: Write) -> ByteDevice:
        """Return the table's controller, or the drives on a serial line, which answers by calling ``write(data)``.

        A fault may replace it later by another one; the axes are then stopped.
        """
        put_there, setup = twin_of_table(self.bench.table.spec), self._table_setup()
        end = Exchanged(put_there(setup, write))

        def exchange() -> None:
            for axis in self.bench.table.axes:
                self.table.stop(axis)  # its brakes close while there is no controller
            end.device = put_there(replace(setup, number=1), write)

        self._later(self._faults.wires["table"].another_s, exchange)
        return end

    async def table_in_memory(self) -> Any:
        """Return the near end of a wire to the controller, or where it is served in memory."""
        if not self.bench.table.spec.opens_links:
            return self._in_memory("table", self.table_device)
        address = (NULLMODEM_HOST, next(_wires))
        await self.serve_table(address)
        return address

    def imu_device(self, imu: ImuConfig, out: Write | FrameSink) -> Any:
        """Return the twin of an IMU, which sends to ``out`` from now on: bytes to a function, frames to a bus.

        The faults of the bench begin and end at their times, and at that of ``another_s`` another twin takes its place.
        Its tasks end with the bench.
        """
        faults = self._faults.devices[imu.name]
        knobs = NodeFaults(clock_ppm=faults.clock_ppm, seed=self.bench.twin.seed)
        self._later(faults.from_s, partial(turn_knobs, knobs, faults, True))
        self._later(faults.until_s, partial(turn_knobs, knobs, faults, False))

        def put_there(number: int) -> tuple[Any, asyncio.Task[Any]]:
            """Return the device twin number ``number`` of an IMU, and the task in which it is served."""
            setup = ImuTwinSetup(
                gyros=self.gyros(imu, number),
                rate_hz=imu.rate_hz,
                up=self._up(imu),
                faults=knobs,
                options=imu.options,
                signals=imu.can,
                number=number,
            )
            setup.gyros.thermometer = not faults.no_temperature
            device = twin_of(imu.spec)(setup, out)
            return device, self.run(device.serve())

        device, serving = put_there(0)
        end = Exchanged(device)

        def exchange() -> None:
            serving.cancel()
            end.device = put_there(1)[0]

        self._later(self._faults.wires[imu.name].another_s, exchange)
        return end

    def imu_in_memory(self, imu: ImuConfig) -> ByteLink:
        """Return the near end of a wire to a device that speaks bytes."""
        return self._in_memory(imu.name, lambda write: self.imu_device(imu, write))

    def bus_device(self, imu: ImuConfig, make: Callable[[Callable[[Any], None]], Bus]) -> Bus:
        """Put a device twin on the bus that ``make`` creates with the receiver of host frames; return the bus."""
        wire, bus = self._faults.wires[imu.name], make(lambda message: ear(message))
        device = self.imu_device(imu, FaultyFrames(bus, wire, self._seed(imu.name)) if wire.any else bus)
        ear = FaultyFrames(device.received, wire.to_device, (*self._seed(imu.name), 1)) if wire.any else device.received
        return bus

    def bus_in_memory(self, imu: ImuConfig) -> FrameLink:
        """Return the link to a bus in memory with the device on it."""
        channel = f"wire{next(_wires)}"
        self._stack.callback(self.bus_device(imu, partial(MemoryBus, channel)).shutdown)
        return CanLink(imu.name, "memory", channel, {})

    def other_device(self, config: DeviceConfig, write: Write) -> ByteDevice:
        """Return the twin of a device of another kind; PluginError if its record has none."""
        if config.spec.twin is None:
            raise PluginError(f"{config.spec.name} has no twin: its SPEC needs one, or the bench file a link")
        setup = DeviceSetup(
            name=config.name, timeout_s=config.timeout_s, options=config.options, settings=config.settings
        )
        device: ByteDevice = config.spec.twin(setup, write)
        return device

    def other_in_memory(self, config: DeviceConfig) -> ByteLink:
        """Return the near end of a wire to a device of another kind."""
        return self._in_memory(config.name, partial(self.other_device, config))

    def gyros(self, imu: ImuConfig, number: int = 0) -> GyroArray:
        """Return the gyros of a device on the table; BenchError if the hidden effects do not fit them.

        ``number`` counts devices of its kind, of which each has different scale factors and noise; 0 has those stated.
        """
        index = [other.name for other in self.bench.imus].index(imu.name)
        twin, truth = self.bench.twin, self._truths[imu.name]
        try:
            return GyroArray(
                mounting=self._mounts[imu.name],
                truth=replace(truth, k=truth.k + _APART * number),
                body=self._body,
                rate_hz=imu.rate_hz,
                seed=(twin.seed, index, number) if number else (twin.seed, index),
                hidden=self._hidden.of_device(imu.name) if self._hidden is not None else None,
                started_s=twin.started_s,
            )
        except HiddenError as error:
            raise BenchError(f"{twin.hidden}: {imu.name}: {error}") from None

    def run(self, twin: Coroutine[Any, Any, Any]) -> asyncio.Task[Any]:
        """Start a task for a twin, which is cancelled when the bench is closed; an error in it is then logged."""
        task = asyncio.get_running_loop().create_task(twin)

        async def end() -> None:
            task.cancel()
            await asyncio.wait({task})
            if not task.cancelled() and (error := task.exception()) is not None:
                _log.error("a twin has ended unexpectedly: %r", error)

        self._stack.push_async_callback(end)
        return task

    def wire(self, device: str) -> str:
        """Return the kind of wire on which a device is served."""
        return self._wires[device]

    def _read_wires(self, table: Table) -> dict[str, str]:
        """Return by device, the table included, the kind of link to serve it on, from [twin.wires] or by default.

        Defaults are "tcp" for the table, "udp_multicast" or "serial" for an IMU, the first of its kind for others. One
        on CAN may have any link that begins with "can:". The table's error for an unknown kind.
        """
        wires = {"table": table.string("table", "tcp", one_of=("tcp", "serial"))}
        for imu in self.bench.imus:
            known = ("udp_multicast", "slcan", "socketcand") if imu.spec.on_can else ("serial", "tcp")
            wires[imu.name] = wire = table.string(imu.name, known[0])
            if wire not in known and not (imu.spec.on_can and wire.startswith("can:")):
                raise table.fail(imu.name, not_one_of(wire, known))
        for device in self.bench.others:
            served = tuple(device.kind.wires)
            wires[device.name] = table.string(device.name, served[0], one_of=served)
        table.done()
        return wires

    def _up(self, imu: ImuConfig) -> Callable[[Floats], Floats]:
        """Return a function of instants (n,) in s: the direction up (n, 3) along the first three gyros of a device.

        If the bench states errors of its accelerometers, their outputs in standard g take its place. Each call must
        then ask for the sampling instants that follow those of the last one; without errors it is only faster that way.
        """
        mounting = self._mounts[imu.name]
        p = mounting.p[:3]
        stated = self._forces[imu.name]
        if stated is not None:
            return self._felt(imu, *stated)
        up = self._body.up_in_turn(1 / imu.rate_hz)
        return lambda t_s: up(t_s) @ p.T

    def _felt(self, imu: ImuConfig, truth: AccelerometerTruth, gravity_mps2: float) -> Callable[[Floats], Floats]:
        """Return a function of instants (n,) in s: the outputs (n, 3), in standard g, of a device's accelerometers.

        They lie along its first three gyros. ``gravity_mps2`` is the gravity that acts on them. Each call must ask for
        the sampling instants that follow those of the last one.
        """
        mounting = self._mounts[imu.name]
        twin = self.bench.twin
        index = [other.name for other in self.bench.imus].index(imu.name)
        accelerometers = Accelerometers(
            mounting=Mounting(mounting.p[:3], mounting.j[:3], mounting.k[:3]),
            truth=truth,
            body=self._body,
            rate_hz=imu.rate_hz,
            seed=(twin.seed, index, _OF_FORCE),
            gravity_mps2=gravity_mps2,
        )
        return lambda t_s: accelerometers.sample(t_s) / STANDARD_GRAVITY_MPS2

    def faulty(self, device: str, make: Callable[[Write], ByteDevice], plug: Plug) -> Callable[[Write], ByteDevice]:
        """Return ``make`` with the wire faults of this device in the bench file."""
        return faulty_device(make, self._faults.wires[device], self._seed(device), plug)

    def _in_memory(self, device: str, make: Callable[[Write], ByteDevice]) -> ByteLink:
        plug = Plug()
        return self._stack.enter_context(in_memory(device, self.faulty(device, make, plug), plug))

    def _seed(self, device: str) -> tuple[int, int]:
        return self.bench.twin.seed, 1000 + list(self._faults.wires).index(device)

    def _later(self, at_s: float, act: Callable[[], None]) -> None:
        """Let something happen at this time, infinite for never, unless the bench is closed before."""
        if math.isfinite(at_s):
            self._stack.callback(asyncio.get_running_loop().call_later(at_s, act).cancel)


def hidden_of(bench: Bench) -> Hidden | None:
    """Return the hidden effects of a bench, None if it has none.

    BenchError for an invalid file, or one that names a device the bench does not have.
    """
    if bench.twin.hidden is None:
        return None
    top = Table.load(bench.twin.hidden, BenchError)
    try:
        hidden = Hidden.of({name: top.value(name) for name in top.remaining()})
    except HiddenError as error:
        raise top.fail_at(str(error)) from None
    names = [imu.name for imu in bench.imus]
    for unknown in set(hidden.devices or ()).difference(names):
        raise top.fail_at(f"devices: {not_one_of(unknown, names)}")
    return hidden


def truth_of(truths: Table, imu: ImuConfig) -> GyroTruth:
    """Return the true errors of a device's gyros from its table in ``truths``.

    The angle random walk is by default that of its data sheet. The table's error for an invalid key.
    """
    table = truths.table(imu.name, optional=True)
    own = table.read_all("bench.truth", list_length=len(imu.array))
    del own["fault"]  # read by read_faults
    del own["accelerometers"]  # read by force_truth_of
    del own["mounting_error"]  # read by mounting_of
    own = {key: np.array(value) if isinstance(value, tuple) else value for key, value in own.items()}
    return GyroTruth(**{**own, "arw_rps_rthz": imu.noise.arw if own["arw_rps_rthz"] is None else own["arw_rps_rthz"]})


def force_truth_of(truths: Table, imu: ImuConfig, site: Site | None) -> tuple[AccelerometerTruth, float] | None:
    """Return the true errors of the accelerometers of a device, and its true gravity in m/s2.

    None if the bench states none. Gravity is by default that of the site, else the standard one. The table's error for
    an invalid key.
    """
    section = truths.again().table(imu.name, optional=True).value("accelerometers", None)
    if section is None:
        return None
    table = truths.again().table(imu.name, optional=True).table("accelerometers")
    own = table.read_all("bench.force_truth", list_length=3)
    stated_mps2 = own.pop("gravity_mps2")
    values: dict[str, Any] = {key: np.array(v) if isinstance(v, tuple) else v for key, v in own.items()}
    middle, apart = values.pop("arm_m"), values.pop("apart_m")
    places = middle + apart[:, None] * mounting_of(truths, imu).p[:3]
    if stated_mps2 is None:
        stated_mps2 = STANDARD_GRAVITY_MPS2 if site is None else site.local_gravity_mps2
    return AccelerometerTruth(places_m=places, **values), stated_mps2


def mounting_of(truths: Table, imu: ImuConfig) -> Mounting:
    """Return how the gyros of a device lie on the table, with the mounting of the bench file and the error of its twin.

    Sense axes are those of the twins for a kind of array that they know, else those of the bench file. The table's
    error for an invalid key of the mounting error.
    """
    own = imu.own_array
    if imu.array_name in MOUNTS_DEG:
        placed = mounted(MOUNTS_DEG[imu.array_name])
    elif imu.array_name == "explicit":
        # Explicit axes are those of the bench file, for the twin as for the estimator.
        placed = Mounting(own.p, own.j, own.k)
    else:
        placed = along(own.p.tolist())
    table = truths.again().table(imu.name, optional=True).table("mounting_error", optional=True)
    turns_rad = table.read_all("bench.mounting_error")
    return remounted(placed, imu.mounting.axes, list(turns_rad.values()))
