"""The [table] section of a bench file: which controller turns the axes, how it is reached, what it may be asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.plugins import Registry
from drivers.specs import AxisSetup, TableSpec
from drivers.tables.registry import TABLES, USUAL_TABLE
from drivers.types import AxisLimits
from estimator.recordings.reference import TableUncertainty
from station.schema.tables import Table

TWIN = "twin:"
"""The link that leads to a twin in memory."""


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The turntable: protocol and link, gimbals outermost first, axes by name.

    ``options`` are the protocol's own keys. ``read_time_s`` is what a reading of one axis takes, as ``station check``
    measures it, for plans; 0 if it is not stated.
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

    def at(self, link: str) -> TableConfig:
        """Return the same table at another link, with all its axes."""
        axes = {name: replace(axis, link="") for name, axis in self.axes.items()}
        return replace(self, link=link, axes=axes)


def read_table(table: Table, folder: Path, known: Registry[TableSpec] = TABLES) -> TableConfig:
    """Read the section; the table's error with line and key for what is wrong."""
    spec = table.record("protocol", known, USUAL_TABLE)
    gimbals = table.value("gimbals", ["z", "y", "x"])
    if (
        not isinstance(gimbals, list)
        or not gimbals
        or len(set(map(str, gimbals))) != len(gimbals)
        or not all(g in ("x", "y", "z") for g in gimbals)
    ):
        raise table.fail("gimbals", f"must list different ones of x, y, z, outermost first; got {gimbals}")
    if len(gimbals) > spec.most_axes:
        most = "one axis: list it alone" if spec.most_axes == 1 else f"{spec.most_axes} axes: list no more"
        raise table.fail("gimbals", f"protocol {spec.name} has {most}")
    config = TableConfig(
        spec=spec,
        link=table.link("link", TWIN),
        options=table.options(spec.keys, folder),
        gimbals=tuple(gimbals),
        poll_rate_hz=table.quantity("poll_rate", "frequency", 20.0),
        timeout_s=table.quantity("timeout", "time", 0.2, "above_zero"),
        axes={axis: _axis(table.table(axis), spec, folder) for axis in gimbals},
        uncertainty=_uncertainty(table.table("uncertainty")) if table.has("uncertainty") else None,
        read_time_s=table.quantity("read_time", "time", 0.0),
    )
    if not 1 <= config.poll_rate_hz <= 1000:
        raise table.fail("poll_rate", f"{config.poll_rate_hz:g} Hz; give 1 Hz to 1000 Hz")
    if config.link == TWIN and (own := [axis for axis in config.axes.values() if axis.link]):
        raise table.fail("link", f"must be given, too, where an axis has a link of its own ({own[0].link})")
    for axis in config.axes.values():
        if refused := spec.refused(axis, axis.link or config.link):
            raise table.fail(None, refused)
    addresses = [(axis.link or config.link, axis.address) for axis in config.axes.values()]
    if spec.address is not None and len(set(addresses)) != len(addresses):
        raise table.fail(None, f"two axes have the same address at the controller: {[a for _, a in addresses]}")
    table.done()
    return config


def _uncertainty(table: Table) -> TableUncertainty:
    found = TableUncertainty(**table.declared("uncertainty"))
    table.done()
    return found


def _axis(table: Table, spec: TableSpec, folder: Path) -> AxisSetup:
    # Where angles are told in degrees, the encoder's counts matter to a twin alone.
    counts = table.integer("counts_per_turn", None if spec.proposed_counts else 3_600_000)
    if counts < 1:
        raise table.fail("counts_per_turn", "must be 1 or more")
    step_rps2 = spec.acceleration_step / counts * math.tau
    axis = AxisSetup(
        address=table.option(spec.address) if spec.address is not None else 1,
        counts_per_turn=counts,
        limits=AxisLimits(**table.declared("axis"), travel_rad=_travel(table), acceleration_step_rps2=step_rps2),
        link=table.link("link", "") if spec.opens_links else "",
        options=table.options(spec.axis_keys, folder),
    )
    table.done()
    return axis


def _travel(table: Table) -> tuple[float, float] | None:
    if not table.has("travel"):
        return None
    low, high = table.quantities("travel", "angle", 2)
    if not low <= 0 <= high or low == high:
        raise table.fail("travel", 'is from below home to above it: ["-90 deg", "90 deg"]')
    return low, high
