"""What the bench file says is wrong with twins and their wires: [twin.fault] and [twin.NAME.fault]."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from sims.imus.stim300 import Stim300Device
from sims.imus.vectornav import VectorNavDevice
from sims.imus.xsens import XsensDevice
from sims.physics.hidden import HiddenError
from sims.wires.faults import DeviceFaults, TableFault, WireFaults, device_faults, table_faults
from sims.wires.frames import NodeFaults
from station.bench.bench import Bench
from station.errors import BenchError
from station.schema.tables import Table

_RANGE_RPS, _LITTLE_RPS = math.radians(2000.0), math.radians(10.0)  # the VN-100's range is that of all its gyros


@dataclass(frozen=True, slots=True)
class BenchFaults:
    """Faults of the table, of devices by name, of wires by device or "table"."""

    table: TableFault | None
    devices: Mapping[str, DeviceFaults]
    wires: Mapping[str, WireFaults]


def read_faults(truths: Table, bench: Bench) -> BenchFaults:
    """Read them; BenchError for what cannot be."""
    try:
        fault, wire = table_faults(truths.value("fault", {}), bench.table.gimbals, "twin.fault")
        devices, wires = {}, {"table": wire}
        for imu in bench.imus:
            said = truths.again().table(imu.name, optional=True).value("fault", {})
            devices[imu.name], wires[imu.name] = device_faults(said, len(imu.array), f"twin.{imu.name}.fault")
    except HiddenError as error:
        raise BenchError(str(error)) from None
    return BenchFaults(fault, devices, wires)


def turn_knobs(device: Stim300Device | XsensDevice | VectorNavDevice, faults: DeviceFaults, on: bool) -> None:
    """Turn the knobs of a device on a byte link."""
    stuck, saturated = (number - 1 if on and number else None for number in (faults.stuck, faults.saturated))
    dropped, doubled = (share if on else 0.0 for share in (faults.dropped, faults.doubled))
    if isinstance(device, VectorNavDevice):
        device.stuck_gyros = set() if stuck is None else {stuck}
        device.range_rps = _RANGE_RPS if saturated is None else _LITTLE_RPS
        device.loss, device.doubling = dropped, doubled
    else:
        device.stuck_gyro, device.saturated_gyro = stuck, saturated
        device.drop_share, device.double_share = dropped, doubled


def turn_node_knobs(knobs: NodeFaults, faults: DeviceFaults, on: bool) -> None:
    """Turn the knobs of a device on CAN."""
    knobs.stuck = {faults.stuck - 1} if on and faults.stuck else set()
    knobs.saturated = {faults.saturated - 1} if on and faults.saturated else set()
    knobs.dropped, knobs.doubled = (share if on else 0.0 for share in (faults.dropped, faults.doubled))
