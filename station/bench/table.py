"""The [table] section of a bench file: the controller, its link, and the limits of its axes."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from drivers.kind import DeviceKind
from drivers.plugins import Registry
from drivers.specs import AxisSetup, TableSpec
from drivers.tables.kind import SPEC as TABLE
from drivers.tables.registry import TABLES
from drivers.types import AxisLimits
from estimator.recordings.reference import TableUncertainty
from station.schema.tables import Table, known_in

TWIN = "twin:"
"""The link that leads to a twin in memory."""


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The turntable: protocol and link, gimbals outermost first, axes by name.

    ``options`` are the values of the protocol's keys. ``read_time_s`` is the time to read one axis, as measured by
    ``station check``, for plans; 0 if not given.
    """

    spec: TableSpec
    link: str
    gimbals: tuple[str, ...]
    poll_rate_hz: float
    timeout_s: float
    axes: Mapping[str, AxisSetup]
    options: Mapping[str, Any]
    uncertainty: TableUncertainty | None
    read_time_s: float = 0.0

    @property
    def name(self) -> str:
        """Its name on the bench."""
        return self.kind.name

    @property
    def kind(self) -> DeviceKind:
        """Its kind."""
        return TABLE

    @property
    def used(self) -> bool:
        """Whether a run drives it."""
        return True

    @property
    def settings(self) -> Mapping[str, Any]:
        """Nothing: its section is read by the station."""
        return {}

    @property
    def protocol(self) -> str:
        """Name of its protocol."""
        return self.spec.name

    @property
    def limits(self) -> dict[str, AxisLimits]:
        """Limits by axis."""
        return {name: axis.limits for name, axis in self.axes.items()}

    @property
    def links(self) -> tuple[str, ...]:
        """The links of all axes, each once."""
        return tuple(dict.fromkeys(axis.link or self.link for axis in self.axes.values()))

    def at(self, link: str) -> Self:
        """Return the same table at another link, with all its axes."""
        axes = {name: replace(axis, link="") for name, axis in self.axes.items()}
        return replace(self, link=link, axes=axes)


def read_table(table: Table, folder: Path, known: Registry[TableSpec] = TABLES) -> TableConfig:
    """Return the table of the section [table]; the table's error with line and key if it is invalid.

    Its protocol is one of ``known``; paths count from ``folder``. Checked are the number of axes, their links, which no
    axis of a twin may have, and that no two have the same address at the same link.
    """
    own = table.read("bench.table", folder, protocol=known_in(known))
    spec, gimbals, sheet = own["spec"], own.pop("gimbals"), own.pop("uncertainty")
    if len(gimbals) > spec.most_axes:
        most = "one axis: list it alone" if spec.most_axes == 1 else f"{spec.most_axes} axes: list no more"
        raise table.fail("gimbals", f"protocol {spec.name} has {most}")
    config = TableConfig(
        gimbals=gimbals,
        options=table.options(spec.keys, folder),
        axes={axis: _axis(table.table(axis), spec, folder) for axis in gimbals},
        uncertainty=TableUncertainty(**sheet.read_all("bench.uncertainty")) if sheet else None,
        **own,
    )
    if config.link == TWIN and (linked := [axis.link for axis in config.axes.values() if axis.link]):
        raise table.fail("link", f"must also be given if an axis has its own link ({linked[0]})")
    for axis in config.axes.values():
        if refused := spec.refused(axis, axis.link or config.link):
            raise table.fail(None, refused)
    addresses = [(axis.link or config.link, axis.address) for axis in config.axes.values()]
    if spec.address is not None and len(set(addresses)) != len(addresses):
        raise table.fail(None, f"two axes have the same address at the controller: {[a for _, a in addresses]}")
    table.done()
    return config


def _axis(table: Table, spec: TableSpec, folder: Path) -> AxisSetup:
    """Return the setup of one axis; the table's error if its travel does not include home or its counts are missing.

    A protocol in degrees needs no counts: they matter to a twin alone, and are 3 600 000 by default. Resolution and
    step of acceleration follow from them. The address is 1 where the protocol has none.
    """
    limits, counts = table.read("bench.axis", list_length=2), table.read("bench.encoder")["counts_per_turn"]
    low, high = limits["travel_rad"] or (-math.inf, math.inf)
    if not low <= 0 <= high or low == high:
        raise table.fail("travel", 'must go from a negative to a positive angle: ["-90 deg", "90 deg"]')
    if counts is None:  # where angles are in degrees, they matter to a twin alone
        if spec.proposed_counts:
            raise table.fail(None, "counts_per_turn is missing")
        counts = 3_600_000
    axis = AxisSetup(
        address=table.option(spec.address) if spec.address is not None else 1,
        counts_per_turn=counts,
        limits=AxisLimits(
            **limits,
            acceleration_step_rps2=spec.acceleration_step / counts * math.tau,
            resolution_rad=math.tau / counts,
        ),
        options=table.options(spec.axis_keys, folder),
        **(table.read("bench.own_link") if spec.opens_links else {}),
    )
    table.done()
    return axis
