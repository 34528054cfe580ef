"""The twins of devices under test, by the protocol that they speak, or by its family: one entry each."""

from collections.abc import Callable
from typing import Any

from drivers.plugins import PluginError
from drivers.specs import ImuSpec
from sims.imus.aceinna import AceinnaDevice
from sims.imus.can_nodes import CanNodes
from sims.imus.described import DescribedDevice
from sims.imus.stim300 import Stim300Device
from sims.imus.vectornav import VectorNavDevice
from sims.imus.xsens import XsensDevice
from sims.wires.frames import ImuTwinSetup as ImuTwinSetup

Ride = ImuTwinSetup  # the name until 0.5.0, which plug-ins may import

TWINS: dict[str, Callable[[ImuTwinSetup, Any], Any]] = {
    "can": CanNodes,
    "described": DescribedDevice,
    "j1939": AceinnaDevice,
    "stim300": Stim300Device,
    "vectornav": VectorNavDevice,
    "xsens": XsensDevice,
}
"""What makes a twin, given how it rides and what it writes bytes with, or its bus.

A twin has ``serve``, which sends until it is cancelled, and ``received`` for bytes or frames if it listens.
"""


def twin_of(spec: ImuSpec) -> Callable[[ImuTwinSetup, Any], Any]:
    """Return the maker of a device's twin; PluginError if there is none."""
    if (twin := spec.twin or TWINS.get(spec.family or spec.name)) is None:
        raise PluginError(f"{spec.name} has no twin: its SPEC needs one, or the bench file a link")
    return twin
