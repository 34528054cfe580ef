"""An Ideal Aerosmith table, as a table of the station."""

from drivers.protocols import ByteLink, Turntable
from drivers.specs import TableSetup, TableSpec, described
from drivers.tables.aerosmith.table import AerosmithTable


def _make(setup: TableSetup, link: ByteLink) -> Turntable:
    (name, axis), *_ = setup.axes.items()
    return AerosmithTable("table", link, name, axis.limits, setup.timeout_s, **setup.options)


SPEC = described(TableSpec, __package__, make=_make)
