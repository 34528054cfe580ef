"""A run as known from its messages: the data of every screen that shows a run."""

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import Enum
from itertools import pairwise
from pathlib import Path
from typing import Any

from estimator.errors import MISSHAPEN
from station.run.snapshot import EventKind, Phase, Snapshot, snapshot_of
from station.screen.sessions.greeting import Greeting, RunEnd, SentLimits

SILENCE_S = 3.0
"""After so long without a word from a session, what is shown of it is old."""
_MOST_EVENTS = 500
_MOST_POINTS = 1200
_MOVING, _ENDING = (Phase.HOMING, Phase.RUNNING), (Phase.STOPPING, Phase.ESTIMATING)


class Stage(Enum):
    """The stage of a run as seen from the screen."""

    STARTING = "starting"
    RUNNING = "running"
    LOST = "link lost"
    ENDED = "ended"


@dataclass(slots=True)
class Trend:
    """The course of one sensor's states: instants, values and sigmas of the four states."""

    times_s: list[float] = field(default_factory=list)
    values: list[tuple[float, ...]] = field(default_factory=list)
    sds: list[tuple[float, ...]] = field(default_factory=list)

    def add(self, t_s: float, values: tuple[float, ...], sds: tuple[float, ...]) -> None:
        """Add an estimate of the four states with their sigmas, in SI.

        Ignored if its time is not after the last, or its values are the last ones. Beyond 1200 points every other one
        is dropped.
        """
        if self.values and (self.values[-1] == values or t_s <= self.times_s[-1]):
            return
        self.times_s.append(t_s)
        self.values.append(values)
        self.sds.append(sds)
        if len(self.times_s) > _MOST_POINTS:
            for series in (self.times_s, self.values, self.sds):
                del series[1::2]


class LiveRun:
    """The known state of a run: its greeting, events, newest snapshot, trends, and result."""

    def __init__(self, recording: Path | None = None, script: str = "") -> None:
        """Start without messages; ``recording`` and ``script`` are those it was started with, until its greeting states
        them.
        """
        self.stage = Stage.STARTING
        self.hello: Greeting | None = None
        self.snapshot: Snapshot | None = None
        self.result: RunEnd | None = None
        self.events: deque[tuple[float, str]] = deque(maxlen=_MOST_EVENTS)
        self.trends: dict[str, Trend] = {}
        """By full name of a gyro or accelerometer."""
        self.seen: list[Snapshot] = []
        """Snapshots since the script began, as time went on; of a long run every other, and so on."""
        self.trouble = ""
        self.refusals: deque[str] = deque(maxlen=20)
        """What the session refused, and nobody has been told yet."""
        self.at_rest = False
        """Whether the session said that the table is at rest after the script."""
        self.moved = False
        """Whether the table was homed or driven."""
        self.unconfirmed = False
        """Whether the session said that it could not see the table come to rest."""
        self.recording, self.script = recording, script
        self._heard_s = time.monotonic()
        self._stop_asked_s = math.nan

    @property
    def active(self) -> bool:
        """Whether a table may be moving."""
        return self.stage in (Stage.STARTING, Stage.RUNNING, Stage.LOST)

    @property
    def by_hand(self) -> bool:
        """Whether the table is driven by hand."""
        return self.hello is not None and self.hello.manual

    @property
    def limits(self) -> SentLimits:
        """The limits of the bench, none before the greeting."""
        return self.hello.limits if self.hello is not None else SentLimits()

    @property
    def settled(self) -> bool:
        """Whether the run has ended, and the table is at rest or never moved: nothing of it is left to watch."""
        return self.stage is Stage.ENDED and (self.at_rest or not (self.moved or self.unconfirmed))

    @property
    def steps_begin_s(self) -> list[float]:
        """The beginnings of steps (s): by plan if all durations are known in advance, else as seen so far.

        Empty before the greeting.
        """
        if self.hello is None:
            return []
        if self.hello.steps_begin_s is not None:
            return list(self.hello.steps_begin_s)
        labels = [""] + [snapshot.label for snapshot in self.seen]
        pairs = zip(self.seen, pairwise(labels), strict=True)
        return [snapshot.elapsed_s for snapshot, (before, now) in pairs if now != before]

    @property
    def stop_asked(self) -> bool:
        return not math.isnan(self._stop_asked_s)

    @property
    def stop_age_s(self) -> float:
        """How long ago STOP was first pressed, by the wall's clock; NaN if it was not."""
        return time.monotonic() - self._stop_asked_s

    @property
    def stop_heard(self) -> bool:
        """Whether the session is known to be stopping the table, or has ended."""
        ending = self.snapshot is not None and self.snapshot.phase in _ENDING
        return ending or self.at_rest or self.stage is Stage.ENDED

    @property
    def silent_s(self) -> float:
        """How long a connected session, which sends ten messages a second, has been silent."""
        return time.monotonic() - self._heard_s if self.stage is Stage.RUNNING else 0.0

    @property
    def outcome(self) -> str:
        """PASS, FAIL, ABORTED, FAULT, or nothing while it is not known."""
        return self.result.outcome if self.result is not None else ""

    def ask_to_stop(self) -> None:
        if not self.stop_asked:
            self._stop_asked_s = time.monotonic()

    def greet(self, hello: Mapping[str, Any]) -> None:
        """Take the greeting of a first or later connection; past events will be sent again, so they are cleared.

        The stage becomes RUNNING; recording and script are those of the greeting. KeyError, TypeError or ValueError for
        an object that is no greeting.
        """
        self.hello = Greeting.read(hello)
        self.recording = self.hello.recording_path
        self.script = self.hello.script
        self.stage = Stage.RUNNING
        self.trouble = ""
        self.events.clear()
        self._heard_s = time.monotonic()

    def take(self, message: Mapping[str, Any]) -> None:
        """Update the state from a message: snapshot, event, course, refused, or result, which ends the run.

        Malformed messages and unknown kinds change nothing, but show that the session is alive.
        """
        self._heard_s = time.monotonic()
        kind = message.get("kind")
        with suppress(*MISSHAPEN):
            if kind == "snapshot":
                self._take_snapshot(snapshot_of(message))
            elif kind == "event":
                about = EventKind(message["event"])
                self.events.append((float(message["t_s"]), str(message["text"])))
                self.at_rest = self.at_rest or about is EventKind.AT_REST
                self.unconfirmed = self.unconfirmed or about is EventKind.NOT_AT_REST
            elif kind == "course":
                self._take_course(message["points"])
            elif kind == "result":
                self.result = RunEnd.read(message)
                self.stage = Stage.ENDED
            elif kind == "refused":
                self.refusals.append(str(message["reason"]))

    def leave(self, stage: Stage, why: str) -> None:
        """Set the stage and reason after a broken connection, or a process that ended without a result."""
        if self.stage is not Stage.ENDED:
            self.stage, self.trouble = stage, why

    def _take_course(self, points: Sequence[Mapping[str, Any]]) -> None:
        """Prepend earlier estimates to the trends; a sensor with a null in a point is skipped there.

        ``points``, oldest first, have "t_s" and "sensors", by full name the values and the sigmas of the four states.
        Malformed ones raise before any trend is changed.
        """
        found: dict[str, Trend] = {}
        for point in points:
            for name, (values, sds) in point["sensors"].items():
                if None not in (*values, *sds):
                    found.setdefault(name, Trend()).add(float(point["t_s"]), tuple(values), tuple(sds))
        for name, trend in found.items():
            later = self.trends.get(name) or Trend()
            for at in zip(later.times_s, later.values, later.sds, strict=True):
                trend.add(*at)
            self.trends[name] = trend

    def _take_snapshot(self, snapshot: Snapshot) -> None:
        """Make a snapshot the newest; if time has advanced, add it to the history, and its estimates to the trends.

        Of a history of more than 1200 every other snapshot is dropped, but not the first and the last. Sensors with
        estimates that are not finite are left out. Also notes whether the table has moved.
        """
        self.snapshot = snapshot
        self.moved = self.moved or snapshot.phase in _MOVING or snapshot.elapsed_s > 0
        if not self.seen or snapshot.elapsed_s > self.seen[-1].elapsed_s:
            self.seen.append(snapshot)
            if len(self.seen) > _MOST_POINTS:
                del self.seen[1:-1:2]
        for one in snapshot.sensors:
            if all(map(math.isfinite, one.values)) and all(map(math.isfinite, one.sds)):
                self.trends.setdefault(one.full_name, Trend()).add(snapshot.elapsed_s, one.values, one.sds)
