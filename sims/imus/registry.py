"""The twins of devices under test, by the protocol that they speak, or by its family: one entry each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drivers.specs import ImuSpec
from drivers.types import Floats
from sims.imus.aceinna import AceinnaDevice
from sims.imus.can_nodes import CanNodes
from sims.imus.described import DescribedDevice
from sims.imus.stim300 import Stim300Device
from sims.imus.vectornav import VectorNavDevice
from sims.imus.xsens import XsensDevice
from sims.physics.gyro import GyroArray
from sims.wires.frames import NodeFaults

_STANDARD_GRAVITY_MPS2 = 9.80665


@dataclass(frozen=True, slots=True)
class Ride:
    """A device under test as it stands on the simulated table.

    ``gyros`` were made for ``rate_hz``; ``up`` gives what its accelerometers sense (n, 3), in g, at instants (n,).
    ``options`` are the protocol's keys in the bench file, ``signals`` those of a DBC; ``faults`` are to be heeded.
    """

    gyros: GyroArray
    rate_hz: float
    up: Callable[[Floats], Floats]
    faults: NodeFaults
    options: Mapping[str, Any]
    signals: Any = None

    def force_mps2(self, t_s: Floats) -> Floats:
        """Return what its accelerometers sense (n, 3), in m/s2, at instants (n,)."""
        return self.up(t_s) * _STANDARD_GRAVITY_MPS2


def _can(ride: Ride, bus: Any) -> CanNodes:
    dbc, channels = ride.signals.dbc, ride.signals.channels
    return CanNodes(ride.gyros, bus, dbc, channels, ride.rate_hz, faults=ride.faults, specific_force=ride.force_mps2)


def _aceinna(ride: Ride, bus: Any) -> AceinnaDevice:
    own = {key: ride.options[key] for key in ("model", "address")}
    faults, force = ride.faults, ride.force_mps2
    return AceinnaDevice(ride.gyros, bus, ride.rate_hz, **own, faults=faults, specific_force=force)


TWINS: dict[str, Callable[[Ride, Any], Any]] = {
    "can": _can,
    "described": lambda r, w: DescribedDevice(
        r.gyros, w, r.rate_hz, r.signals, faults=r.faults, specific_force=r.force_mps2
    ),
    "j1939": _aceinna,
    "stim300": lambda r, w: Stim300Device(r.gyros, w, round(r.rate_hz), specific_force_g=r.up, faults=r.faults),
    "vectornav": lambda r, w: VectorNavDevice(r.gyros, w, rate_hz=r.rate_hz, up=r.up, faults=r.faults),
    "xsens": lambda r, w: XsensDevice(r.gyros, w, round(r.rate_hz), specific_force_g=r.up, faults=r.faults),
}
"""What makes a twin, given how it rides and what it writes bytes with, or its bus.

A twin has ``serve``, which sends until it is cancelled, and ``received`` for bytes or frames if it listens.
"""


def twin_of(spec: ImuSpec) -> Callable[[Ride, Any], Any]:
    """Return what makes the twin of a device."""
    return spec.twin or TWINS[spec.family or spec.name]
