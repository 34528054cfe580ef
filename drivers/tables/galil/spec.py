"""A Galil DMC, as a table of the station."""

from drivers.protocols import ByteLink, Turntable
from drivers.specs import TableSetup, TableSpec, described
from drivers.tables.galil.language import ACCELERATION_STEP
from drivers.tables.galil.table import VELOCITY_WINDOW_S, GalilAxis, GalilTable


def _make(setup: TableSetup, link: ByteLink) -> Turntable:
    homing, window_s = setup.options["homing"], setup.options["velocity_window"]
    axes = {
        name: GalilAxis(str(axis.address), axis.counts_per_turn, axis.limits, axis.options["error_limit"])
        for name, axis in setup.axes.items()
    }
    return GalilTable("table", link, axes, setup.timeout_s, homing=homing, velocity_window_s=window_s)


_KEYS = {"velocity_window": {"default": f"{VELOCITY_WINDOW_S:g} s"}}
SPEC = described(TableSpec, __package__, _KEYS, make=_make, acceleration_step=ACCELERATION_STEP)
