"""Recordings as the screen shows them."""

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Self, TypeAlias

from station.run.snapshot import GyroSnapshot
from station.screen.sessions.answers import InvestigationAnswer
from station.screen.sessions.live_run import Trend
from station.views.history import Move

File: TypeAlias = tuple[str, int, int]
"""Path of a file, when it was changed in nanoseconds since 1970, and its size in bytes."""
INVESTIGATION = "-investigation"
"""What is added to the name of a recording for the file of its investigation."""
_BY_CHANCE = 0.0027  # how often a run without any change is marked: as often as a value beyond three sigmas
NO_LIMITS: tuple[float, ...] = (math.inf,) * 4


@dataclass(frozen=True)
class Entry:
    """One recording of a folder. If it cannot be read, ``wrong`` says why and nothing else is known.

    ``foreign``: an HDF5 file that is not a recording. ``figures``: ``gyros`` as JSON, see there. ``nis_mean``: mean NIS
    of its calibration, None without one. ``units``: those chosen in its bench file.
    """

    file: str
    when_utc_s: float
    wrong: str = ""
    foreign: bool = False
    texts: Mapping[str, str] = field(default_factory=dict)
    devices: tuple[str, ...] = ()
    figures: bytes = b"[]"
    nis_mean: float | None = None
    units: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def path(self) -> Path:
        """Where it is."""
        return Path(self.file)

    @cached_property
    def gyros(self) -> tuple[GyroSnapshot, ...]:
        """The gyros of its calibration; parsed on first use, as ten thousand entries would take a while."""
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
        """Key that comparable runs share; None if it is comparable with none."""
        return series_of(self.texts, [(gyro.source, gyro.name) for gyro in self.gyros])

    @property
    def failed(self) -> bool:
        """Whether it failed: it is compared, but nothing is compared with it."""
        return self.texts.get("outcome") == "FAIL"

    def same_device(self, other: Self) -> bool:
        """Whether both are of one device: the same serial number or, where neither has one, the same gyros."""
        return self.serial == other.serial and bool(self.serial or self._same_gyros(other))

    def same_calibrated(self, other: Self) -> bool:
        """Whether the other is another recording of the device, with a calibration of the same gyros."""
        return self._same_gyros(other) and self.path != other.path and self.same_device(other)

    def _same_gyros(self, other: Self) -> bool:
        own, others = ({(gyro.source, gyro.name) for gyro in entry.gyros} for entry in (self, other))
        return bool(own) and own == others


@dataclass(kw_only=True, frozen=True, slots=True)
class Exceeded:
    """An exceeded limit in words: its subject, what was found, the bound, and by how much it was missed.

    ``bound`` and ``missed_by`` are empty if there is no estimate; ``found`` is the reason then. ``remedy`` is what
    usually helps, empty if nothing does. ``gyro`` and ``state`` are the numbers of both in the calibration, None if the
    limit is not about a gyro; ``of_sigma``: it is that of the state's standard uncertainty.
    """

    subject: str
    found: str
    bound: str
    missed_by: str
    remedy: str
    gyro: int | None
    state: int | None
    of_sigma: bool

    @property
    def cells(self) -> tuple[str, str, str, str]:
        """The texts of a row in a table of limits."""
        return self.subject, self.found, self.bound, self.missed_by


@dataclass(frozen=True, slots=True)
class ReadRecording:
    """A recording with everything that the result screen shows.

    ``sizes`` are the limits of the four states in SI, infinite where there is none, ``written`` the same as in the
    bench file, empty where not known; ``curves`` are the live estimates by gyro, ``investigation`` the newest one
    stored beside it. ``samples`` and ``lost`` are None without a calibration. ``noise`` is the mean angle
    random walk in rad/s/rtHz and the upper 95 % limit of the bias instability in rad/s, None if unknown. ``broken``
    lists the exceeded limits, ``because`` their possible causes. ``attributes`` are those of the file.
    """

    entry: Entry
    sizes: tuple[float, ...] = NO_LIMITS
    written: tuple[str, ...] = ("",) * len(NO_LIMITS)
    samples: int | None = None
    lost: int | None = None
    nis_mean: float = math.nan
    noise: tuple[float, float] | None = None
    notes: Sequence[str] = ()
    excluded: Sequence[str] = ()
    events: Sequence[tuple[float, str]] = ()
    curves: Mapping[str, Trend] = field(default_factory=dict)
    investigation: InvestigationAnswer | None = None
    broken: Sequence[Exceeded] = ()
    because: Sequence[str] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)


def series_of(texts: Mapping[str, str], gyros: Sequence[tuple[str, str]]) -> tuple[object, ...] | None:
    """Return what comparable runs have in common, in this order: serial number, bench, script, ``gyros``.

    ``texts`` are attributes of the recording by name ("device_serial", "station", "script", "outcome"), ``gyros``
    source and name of each. None if the run is compared with none: no serial number, no calibration, driven by hand,
    aborted or ended by a fault.
    """
    serial = texts.get("device_serial", "")
    if not serial or not gyros or texts.get("outcome") in ("MANUAL", "ABORTED", "FAULT"):
        return None
    return (serial, texts.get("station"), texts.get("script"), tuple(gyros))


def last_comparable(run: Entry, entries: Iterable[Entry]) -> Entry | None:
    """Return the newest earlier run of the same series that did not fail; None if there is none, or no series.

    Runs of the same instant are not earlier, so ``run`` itself may be among ``entries``. Entries with a value that is
    not finite are left out.
    """
    earlier = [
        other
        for runs in comparable(entries)
        for other in runs
        if other.series == run.series and not other.failed and other.when_utc_s < run.when_utc_s
    ]
    return max(earlier, key=lambda other: other.when_utc_s, default=None)


def comparable(entries: Iterable[Entry], ignored: int = 0) -> list[list[Entry]]:
    """Return the groups of comparable runs, each oldest first, in the order of their oldest runs.

    Runs are comparable if their ``series`` agree, apart from the first ``ignored`` parts: with 1 the serial number may
    differ, with 2 also the bench. Entries without a series, or with a value that is not finite, are left out.
    """
    found = defaultdict(list)
    for entry in sorted(entries, key=lambda entry: entry.when_utc_s):
        if (series := entry.series) is not None and math.isfinite(sum(sum(g.values + g.sds) for g in entry.gyros)):
            found[series[ignored:]].append(entry)
    return list(found.values())


def moves(entries: Iterable[Entry]) -> dict[str, list[Move]]:
    """Return, for the file of each comparable run, the states that moved by more than chance explains.

    A run, failed or not, is compared with the last run before it in its group of comparable runs that did not fail. The
    list is empty for the first run of a group, and while all runs before it failed; runs that are not comparable (see
    ``comparable``) have none. A copy, a comparable run of the same instant, gets the same list. Moves are in sigmas of
    both runs together, with their sign. The limit allows for the number of gyros and states; a state whose sigmas are
    both 0 never moves.
    """
    from statistics import NormalDist  # as numpy takes a while to load, and few look at a second run

    from estimator.geometry.model import STATES

    found, last = dict[str, list[Move]](), None
    for run in (run for runs in comparable(entries) for run in runs):
        last = last if last is not None and last.series == run.series else run
        if run is not last and run.when_utc_s == last.when_utc_s:  # a copy
            found[run.file] = found[last.file]
            continue
        since = last.path.name
        since_when = last.when
        limit = NormalDist().inv_cdf(1 - _BY_CHANCE / 2 / (len(run.gyros) * len(STATES)))
        found[run.file] = [
            Move(
                gyro=new.full_name,
                state=state,
                sigmas=(x - before) / sigma,
                since=since,
                since_when=since_when,
            )
            for old, new in zip(last.gyros, run.gyros, strict=True)
            for state, before, x, *sds in zip(STATES, old.values, new.values, old.sds, new.sds, strict=True)
            if not last.failed and abs(x - before) > limit * (sigma := math.hypot(*sds)) > 0
        ]
        last = run if last.failed or not run.failed else last
    return found
