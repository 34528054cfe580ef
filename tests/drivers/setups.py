"""What a bench would say of a table or an IMU, for a driver in a test."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from drivers.imus.registry import IMUS
from drivers.specs import AxisSetup, ImuSetup, Key, TableSetup
from drivers.tables.registry import TABLES
from sims.physics.table import TableModel
from sims.tables.registry import TWINS, TableTwinSetup
from station.errors import BenchError
from station.schema.tables import Table


def setup_of(protocol: str, axes: Mapping[str, AxisSetup], timeout_s: float, **options: Any) -> TableSetup:
    """Return it; options that are not given are as in a bench file that does not give them."""
    return TableSetup(axes, timeout_s, _all(TABLES[protocol].keys, options))


def twin_on(
    protocol: str,
    table: TableModel,
    write: Callable[[bytes], None],
    addresses: Mapping[str, Any],
    *,
    watchdog_s: float = 0.0,
    **more: Any,
) -> Any:
    """Return the twin of a controller; ``more`` are options of the bench file and knobs of the twin."""
    options = setup_of(protocol, {}, 0.0).options
    seat = TableTwinSetup(
        table, addresses, {name: more.pop(name, value) for name, value in options.items()}, watchdog_s
    )
    return TWINS[protocol](seat, write, **more)


def imu_setup(protocol: str, name: str, rate_hz: float, timeout_s: float = 0.5, **options: Any) -> ImuSetup:
    """Return what it would say of an IMU."""
    return ImuSetup(name, rate_hz, timeout_s, _all(IMUS[protocol].keys, options))


def _all(keys: Iterable[Key], options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options with those that a bench file does not give, as its reader has them."""
    empty = Table.parse("", "no bench", BenchError)
    return {**empty.options((key for key in keys if key.name not in options), Path()), **options}
