"""An ACUTROL, as a table of the station."""

from drivers.protocols import ByteLink, Turntable
from drivers.specs import TableSetup, TableSpec, described
from drivers.tables.acutrol.table import AcutrolAxis, AcutrolTable


def _make(setup: TableSetup, link: ByteLink) -> Turntable:
    axes = {name: AcutrolAxis(int(axis.address), axis.limits) for name, axis in setup.axes.items()}
    return AcutrolTable("table", link, axes, setup.timeout_s, prefix_length=setup.options["reply_prefix"])


SPEC = described(TableSpec, __package__, make=_make)
