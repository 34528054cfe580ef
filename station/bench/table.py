"""The [table] section of a bench file: which controller turns the axes, how it is reached, what it may be asked for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.tables.galil import language as galil
from drivers.tables.galil.table import VELOCITY_WINDOW_S
from drivers.tables.modbus.registers import DriveProfile, ProfileError, load_profile
from drivers.types import AxisLimits
from estimator.recordings.reference import TableUncertainty
from station.schema.tables import Table

TWIN = "twin:"
"""The link that leads to a twin in memory."""
_DIRECT_IDS = (0, 255)  # of a device that is at its address itself (Modbus Messaging on TCP/IP V1.0b, 4.4.1.2)
PROTOCOLS = ("modbus", "galil", "acutrol", "aerosmith")


@dataclass(frozen=True, slots=True)
class AxisConfig:
    """One axis of the table: its ``address`` at the controller, encoder counts a turn, limits.

    The address is a unit id on Modbus, a letter on a Galil, a number on an ACUTROL. ``link`` is that of a drive on
    Modbus with a link of its own, else empty; ``error_limit_rad`` the following error at which a Galil gives up.
    """

    address: int | str
    counts_per_turn: int
    limits: AxisLimits
    link: str = ""
    error_limit_rad: float | None = None


@dataclass(frozen=True, slots=True)
class TableConfig:
    """The turntable: protocol and link, gimbals outermost first, axes by name.

    ``profile`` is the register map of drives on Modbus; ``prefix`` the length of what an ACUTROL puts before replies;
    ``velocity_window_s`` the time that a Galil's velocity is the mean of; ``fault_mask`` the bits of an Aerosmith's
    status that mean a fault. ``read_time_s`` is what a reading of one axis takes, as ``station check`` measures it, for
    plans; 0 if it is not stated.
    """

    protocol: str
    link: str
    profile: DriveProfile | None
    prefix: int
    homing: str
    velocity_window_s: float
    fault_mask: int
    gimbals: tuple[str, ...]
    poll_rate_hz: float
    timeout_s: float
    axes: Mapping[str, AxisConfig]
    uncertainty: TableUncertainty | None
    read_time_s: float = 0.0

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


def read_table(table: Table, folder: Path) -> TableConfig:
    """Read the section; the table's error with line and key for what is wrong."""
    protocol = table.string("protocol", "modbus", one_of=PROTOCOLS)
    gimbals = table.value("gimbals", ["z", "y", "x"])
    if (
        not isinstance(gimbals, list)
        or not gimbals
        or len(set(map(str, gimbals))) != len(gimbals)
        or not all(g in ("x", "y", "z") for g in gimbals)
    ):
        raise table.fail("gimbals", f"must list different ones of x, y, z, outermost first; got {gimbals}")
    if protocol == "aerosmith" and len(gimbals) != 1:
        raise table.fail("gimbals", "an Aerosmith table (experimental) has one axis: list it alone")
    config = TableConfig(
        protocol=protocol,
        link=table.link("link", TWIN),
        profile=_profile(table, folder) if protocol == "modbus" else None,
        prefix=table.integer("reply_prefix", 8) if protocol == "acutrol" else 0,
        homing=table.string("homing", "HM", one_of=("HM", "FI")) if protocol == "galil" else "",
        velocity_window_s=(
            table.quantity("velocity_window", "time", VELOCITY_WINDOW_S, "above_zero")
            if protocol == "galil"
            else VELOCITY_WINDOW_S
        ),
        fault_mask=table.integer("fault_mask", 0) if protocol == "aerosmith" else 0,
        gimbals=tuple(gimbals),
        poll_rate_hz=table.quantity("poll_rate", "frequency", 20.0),
        timeout_s=table.quantity("timeout", "time", 0.2, "above_zero"),
        axes={axis: _axis(table.table(axis), protocol) for axis in gimbals},
        uncertainty=_uncertainty(table.table("uncertainty")) if table.has("uncertainty") else None,
        read_time_s=table.quantity("read_time", "time", 0.0),
    )
    if not 1 <= config.poll_rate_hz <= 1000:
        raise table.fail("poll_rate", f"{config.poll_rate_hz:g} Hz; give 1 Hz to 1000 Hz")
    if config.prefix < 0:
        raise table.fail("reply_prefix", "is a number of characters, 0 or more")
    if config.fault_mask < 0:
        raise table.fail("fault_mask", "is the sum of the bits that mean a fault, 0 or more")
    if config.link == TWIN and (own := [axis for axis in config.axes.values() if axis.link]):
        raise table.fail("link", f"must be given, too, where an axis has a link of its own ({own[0].link})")
    for axis in config.axes.values():
        link = axis.link or config.link
        if protocol == "modbus" and axis.address in _DIRECT_IDS and link != TWIN and not link.startswith("tcp:"):
            raise table.fail(None, f"unit id {axis.address} is for a drive with a TCP address: give 1 to 247 on {link}")
    addresses = [(axis.link or config.link, axis.address) for axis in config.axes.values()]
    if len(set(addresses)) != len(addresses):
        raise table.fail(None, f"two axes have the same address at the controller: {[a for _, a in addresses]}")
    table.done()
    return config


def _profile(table: Table, folder: Path) -> DriveProfile:
    try:
        name = table.string("profile", "kinco")
        return load_profile(str(folder / name) if name.endswith(".toml") else name)
    except ProfileError as error:
        raise table.fail("profile", str(error)) from None


def _uncertainty(table: Table) -> TableUncertainty:
    found = TableUncertainty(**table.declared("uncertainty"))
    table.done()
    return found


def _axis(table: Table, protocol: str) -> AxisConfig:
    axis = AxisConfig(
        address=_address(table, protocol),
        # Angles of an ACUTROL and an Aerosmith are in degrees; their encoder's counts matter to a twin alone.
        counts_per_turn=table.integer("counts_per_turn", None if protocol in ("modbus", "galil") else 3_600_000),
        limits=AxisLimits(**table.declared("axis"), travel_rad=_travel(table)),
        link=table.link("link", "") if protocol == "modbus" else "",
        error_limit_rad=(
            table.quantity("error_limit", "angle", bound="above_zero")
            if protocol == "galil" and table.has("error_limit")
            else None
        ),
    )
    if axis.counts_per_turn < 1:
        raise table.fail("counts_per_turn", "must be 1 or more")
    table.done()
    if protocol == "galil":
        step_rps2 = galil.ACCELERATION_STEP / axis.counts_per_turn * math.tau
        return replace(axis, limits=replace(axis.limits, acceleration_step_rps2=step_rps2))
    return axis


def _travel(table: Table) -> tuple[float, float] | None:
    if not table.has("travel"):
        return None
    low, high = table.quantities("travel", "angle", 2)
    if not low <= 0 <= high or low == high:
        raise table.fail("travel", 'is from below home to above it: ["-90 deg", "90 deg"]')
    return low, high


def _address(table: Table, protocol: str) -> int | str:
    if protocol == "galil":
        return table.string("letter", one_of="ABCDEFGH")
    if protocol == "aerosmith":
        return 1
    modbus = protocol == "modbus"
    key, most, what = ("unit_id", 247, "Modbus unit id") if modbus else ("number", 3, "axis number")
    address = table.integer(key)
    if not 1 <= address <= most and not (modbus and address in _DIRECT_IDS):
        raise table.fail(key, f"{address} is no {what}: give 1 to {most}{', on TCP also 0 or 255' if modbus else ''}")
    return address
