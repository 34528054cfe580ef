"""Recordings as the screen shows them."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any

from station.run.snapshot import GyroSnapshot
from station.screen.sessions.live_run import Trend

INVESTIGATION = "-investigation"
"""What is added to the name of a recording for the file of its investigation."""
NO_LIMITS: tuple[float, ...] = (math.inf,) * 4


@dataclass(frozen=True)
class Entry:
    """One recording of a folder. ``wrong`` says why it cannot be read, and then nothing else is known of it.

    ``foreign``: it is no recording at all, but some other HDF5 file. ``figures``: ``gyros`` as JSON, see there.
    """

    path: Path
    when_utc_s: float
    wrong: str = ""
    foreign: bool = False
    texts: Mapping[str, str] = field(default_factory=dict)
    devices: tuple[str, ...] = ()
    figures: str = "[]"

    @cached_property
    def gyros(self) -> tuple[GyroSnapshot, ...]:
        """The gyros of its calibration; not read before they are asked for, ten thousand would take a while."""
        found = json.loads(self.figures)
        return tuple(GyroSnapshot(name, source, tuple(x), tuple(sd)) for name, source, x, sd in found)

    @property
    def when(self) -> str:
        """Date and time of day here."""
        return f"{datetime.fromtimestamp(self.when_utc_s):%Y-%m-%d %H:%M}"

    @property
    def serial(self) -> str:
        """Serial number of the device under test, as the operator gave it."""
        return self.texts.get("device_serial", "")

    @property
    def device(self) -> str:
        """What identifies the device: its serial number, or else the names of the devices of the bench."""
        return self.serial or ", ".join(device for device in self.devices if device)

    @property
    def series(self) -> tuple[object, ...] | None:
        """What comparable runs have in common; None for what is compared with none."""
        if not self.serial or not self.gyros or self.texts.get("outcome") in ("ABORTED", "FAULT"):
            return None
        gyros = tuple((gyro.source, gyro.name) for gyro in self.gyros)
        return (self.serial, self.texts.get("station"), self.texts.get("script"), gyros)

    def same_device(self, other: Entry) -> bool:
        """Whether both are of one device: the same serial number or, where neither has one, the same gyros."""
        if self.serial or other.serial:
            return self.serial == other.serial
        return self._same_gyros(other)

    def same_calibrated(self, other: Entry) -> bool:
        """Whether the other is another recording of the device, with a calibration of the same gyros."""
        return self._same_gyros(other) and self.path != other.path and self.same_device(other)

    def _same_gyros(self, other: Entry) -> bool:
        own, others = ({(gyro.source, gyro.name) for gyro in entry.gyros} for entry in (self, other))
        return bool(own) and own == others


@dataclass(frozen=True, slots=True)
class Whole:
    """A recording opened: its entry and everything that the result screen shows of it.

    ``sizes`` are the limits of the four states in SI, infinite where there is none; ``curves`` the live estimates by
    gyro, ``investigation`` the newest that is kept beside it, as JSON. ``samples`` and ``lost`` are None without a
    calibration. ``attributes`` are those of the file.
    """

    entry: Entry
    sizes: tuple[float, ...] = NO_LIMITS
    samples: int | None = None
    lost: int | None = None
    nis_mean: float = math.nan
    notes: Sequence[str] = ()
    excluded: Sequence[str] = ()
    events: Sequence[tuple[float, str]] = ()
    curves: Mapping[str, Trend] = field(default_factory=dict)
    investigation: Mapping[str, Any] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)


def last_before(entry: Entry, others: Sequence[Entry]) -> Entry | None:
    """Return the last of the others before this one."""
    earlier = [other for other in others if other.when_utc_s < entry.when_utc_s]
    return max(earlier, key=lambda other: other.when_utc_s, default=None)
