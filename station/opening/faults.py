"""Faults of twins and their wires in the bench file: [twin.fault] and [twin.NAME.fault]."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sims.physics.hidden import HiddenError
from sims.wires.faults import DeviceFaults, TableFault, WireFaults, device_faults, table_faults, wire_faults
from sims.wires.frames import NodeFaults
from station.bench.bench import Bench
from station.schema.tables import Table


@dataclass(frozen=True, slots=True)
class BenchFaults:
    """Faults of the table, of devices by name, and of wires by device or "table"."""

    table: TableFault | None
    devices: Mapping[str, DeviceFaults]
    wires: Mapping[str, WireFaults]


def read_faults(of_table: Any, truths: Table, bench: Bench) -> BenchFaults:
    """Return the faults from [twin.fault], given as ``of_table``, and [twin.NAME.fault]; BenchError if one is invalid.

    ``truths`` is the table [twin]. A device without a section has no faults.
    """
    try:
        fault, wire = table_faults(of_table, bench.table.gimbals, "twin.fault")
        devices, wires = {}, {"table": wire}
        for imu in bench.imus:
            stated = truths.again().table(imu.name, optional=True).value("fault", {})
            devices[imu.name], wires[imu.name] = device_faults(stated, len(imu.array), f"twin.{imu.name}.fault")
        for other in bench.others:
            section = truths.table(other.name, optional=True)
            wires[other.name] = wire_faults(section.value("fault", {}), f"twin.{other.name}.fault")
            section.done()
    except HiddenError as error:
        raise truths.fail_at(str(error)) from None
    return BenchFaults(fault, devices, wires)


def turn_knobs(knobs: NodeFaults, faults: DeviceFaults, on: bool) -> None:
    """Set the knobs of a device to its stated faults, or, unless ``on``, to none."""
    knobs.stuck = {faults.stuck - 1} if on and faults.stuck else set()
    knobs.saturated = {faults.saturated - 1} if on and faults.saturated else set()
    shares = (faults.dropped, faults.doubled, faults.huge)
    knobs.dropped, knobs.doubled, knobs.huge = (share if on else 0.0 for share in shares)
