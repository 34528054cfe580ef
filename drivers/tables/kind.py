"""The table as a kind of device: it is brought to rest before anything else is made safe."""

from drivers.kind import DeviceKind
from drivers.tables.making_safe import make_safe
from drivers.tables.registry import TABLES

SPEC = DeviceKind(
    name="table",
    what="the table",
    protocols=TABLES,
    single=True,
    safe_order=0,
    make_safe=make_safe,
    made_safe="the table is at rest, its power off",
    wires=("tcp", "serial"),
)
