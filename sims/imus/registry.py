"""The twins of devices under test, by the protocol that they speak: one line each."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol

from drivers.specs import ImuSpec
from drivers.types import Floats
from sims.physics.gyro import GyroArray
from sims.wires.frames import NodeFaults

_STANDARD_GRAVITY_MPS2 = 9.80665

TWINS = {
    "can": "sims.imus.can_nodes",
    "described": "sims.imus.described",
    "j1939": "sims.imus.aceinna",
    "stim300": "sims.imus.stim300",
    "vectornav": "sims.imus.vectornav",
    "xsens": "sims.imus.xsens",
}
"""Modules by protocol, or by family of protocols; each has a function ``twin``."""


class Twin(Protocol):
    """A device on a wire. If it listens, it has ``received`` too, for bytes or frames."""

    async def serve(self) -> None:
        """Send until cancelled."""


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


def twin_of(spec: ImuSpec) -> Callable[[Ride, Any], Twin]:
    """Return what makes the twin of a device on its wire, which is a function that writes bytes, or a bus."""
    if spec.twin is not None:
        return spec.twin
    made: Callable[[Ride, Any], Twin] = import_module(TWINS[spec.family or spec.name]).twin
    return made
