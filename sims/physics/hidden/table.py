"""Effects of the table: encoders that differ from the true angles, and axes that are not at right angles.

A servo follows its encoder, so what the drives report is what they were told, and the body is what is off. But for
readings on their way to the host: there the body does what it was told, and what is reported is off.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import FLAG, WHOLE, HiddenError, choice, given, hidden

KINDS: dict[str, type[Any]] = {}
ALL = "all"
_NEWTON_STEPS = 3
_UNIT = dict(zip("xyz", np.eye(3), strict=True))
Motion = Callable[[float], tuple[float, float]]
"""Angle (rad) and rate (rad/s) of an axis at an instant (s) of the motion."""
Angles = Callable[[Floats], Floats]
"""Angles (n,) of an axis at instants (n,), rad and s."""


class OfTable:
    """An effect of the table, common to all that is mounted on it."""

    def true_angle(self, axis: str, angle_rad: Floats) -> Floats:
        """Return the true angle of an axis whose encoder stands at ``angle_rad`` (n,)."""
        return angle_rad

    def tilt(self, axis: str) -> Floats:
        """Return the change of the direction (3,) of an axis at home."""
        return np.zeros(3)


@hidden(KINDS, "table_axes")
class TableAxes(OfTable):
    """Axes tilted towards others, as they stand at home; rad."""

    x_towards_y: float = field(default=0.0, metadata=given("arcsec"))
    x_towards_z: float = field(default=0.0, metadata=given("arcsec"))
    y_towards_x: float = field(default=0.0, metadata=given("arcsec"))
    y_towards_z: float = field(default=0.0, metadata=given("arcsec"))
    z_towards_x: float = field(default=0.0, metadata=given("arcsec"))
    z_towards_y: float = field(default=0.0, metadata=given("arcsec"))

    def tilt(self, axis: str) -> Floats:
        tilts = [getattr(self, f"{axis}_towards_{other}") * _UNIT[other] for other in "xyz" if other != axis]
        return np.asarray(np.sum(tilts, axis=0))


@hidden(KINDS, "table_rate")
class TableRate(OfTable):
    """Axes that turn further than their encoders indicate, by a share, because of gears or counts per turn."""

    x: float = field(default=0.0, metadata=given("ppm"))
    y: float = field(default=0.0, metadata=given("ppm"))
    z: float = field(default=0.0, metadata=given("ppm"))

    def true_angle(self, axis: str, angle_rad: Floats) -> Floats:
        return np.asarray((1 + getattr(self, axis)) * angle_rad)


@hidden(KINDS, "encoder_eccentricity")
class EncoderEccentricity(OfTable):
    """An encoder that indicates ``size_rad`` sin(order times the true angle + phase) more than the true angle.

    It is zeroed at home, so its error there is subtracted.
    """

    size_rad: float = field(metadata=given("deg"))
    order: int = field(default=3, metadata=WHOLE)
    phase_rad: float = field(default=0.0, metadata=given("deg"))
    axis: str = field(default=ALL, metadata=choice((*_UNIT, ALL)))

    def __post_init__(self) -> None:
        """Refuse an encoder that would go backwards."""
        if abs(self.order * self.size_rad) > 0.1:
            raise HiddenError("encoder_eccentricity: size times order is beyond 0.1 rad")

    def true_angle(self, axis: str, angle_rad: Floats) -> Floats:
        """Return the true angles (n,) at encoder angles ``angle_rad`` (n,), by Newton's method.

        They are returned unchanged for an axis without the error, which may be of one axis or of all.
        """
        if self.axis not in (axis, ALL):
            return angle_rad
        true = angle_rad
        for _ in range(_NEWTON_STEPS):
            wave = self.order * true + self.phase_rad
            reported = true + self.size_rad * (np.sin(wave) - np.sin(self.phase_rad))
            true = true - (reported - angle_rad) / (1 + self.order * self.size_rad * np.cos(wave))
        return np.asarray(true)


@hidden(KINDS, "table_reading")
class TableReading(OfTable):
    """Readings of one axis that are wrong between two instants of the bench clock.

    The angle gains the share ``angle`` of the motion since ``from_s`` and creeps by ``creep_rps``; both stay
    afterwards. It is off by ``jump_rad``, or ``frozen``. The rate gains the share ``rate`` (-200 %: opposite sign), or
    is ``stale``. The axis follows its commands; if ``followed`` by its servo, the readings follow the commands instead,
    and the body is off by the gain and the creep.
    """

    axis: str = field(metadata=choice(tuple(_UNIT)))
    from_s: float = field(default=0.0, metadata=given("s"))
    until_s: float = field(default=math.inf, metadata=given("s"))
    angle: float = field(default=0.0, metadata=given("%"))
    rate: float = field(default=0.0, metadata=given("%"))
    jump_rad: float = field(default=0.0, metadata=given("deg"))
    creep_rps: float = field(default=0.0, metadata=given("deg/s"))
    frozen: bool = field(default=False, metadata=FLAG)
    stale: bool = field(default=False, metadata=FLAG)
    followed: bool = field(default=False, metadata=FLAG)

    def shift(self, angles: Angles, started_s: float) -> Angles:
        """Return a function that gives how far the angle has gained and crept at instants (n,), in rad.

        It is 0 before the error begins, and stays at its last value after the end. ``angles`` gives the true motion at
        instants (n,); ``started_s`` is the bench clock at the instant 0.
        """
        first_s, last_s = self.from_s - started_s, self.until_s - started_s
        at = cache(lambda t_s: float(angles(np.array([t_s]))[0]))  # an axis forgets old segments

        def shift(t_s: Floats) -> Floats:
            if not (t_s >= first_s).any():
                return np.zeros(len(t_s))
            way = np.where(t_s < last_s, angles(t_s), at(last_s) if (t_s >= last_s).any() else 0.0) - at(first_s)
            gained = self.angle * way + self.creep_rps * (np.minimum(t_s, last_s) - first_s)
            return np.where(t_s >= first_s, gained, 0.0)

        return shift

    def read(self, motion: Motion, started_s: float) -> Motion:
        """Return a function that gives the faulty (angle, rate) at an instant; ``motion`` gives them without the error.

        ``started_s`` is the bench clock at the instant 0. Gain and creep act always, but are left out if the table
        follows them in its motion; the other faults act within their time span.
        """
        first_s, last_s = self.from_s - started_s, self.until_s - started_s
        before = cache(motion)
        shift = self.shift(lambda t_s: np.array([motion(t)[0] for t in t_s.tolist()]), started_s)

        def read(t_s: float) -> tuple[float, float]:
            """Return the angle and rate as the faulty table reports them.

            The angle has gain and creep at any time, unless the servo follows them. In the span it also jumps or is
            frozen at its value from the beginning, and the rate is off in scale or stale.
            """
            angle, rate = motion(t_s)
            if not self.followed:
                angle += float(shift(np.array([t_s]))[0])
            if not first_s <= t_s < last_s:
                return angle, rate
            angle = before(first_s)[0] if self.frozen else angle + self.jump_rad
            return angle, before(first_s)[1] if self.stale else (1 + self.rate) * rate

        return read


@dataclass(frozen=True, slots=True, eq=False)
class TableFaults:
    """All effects of a table together."""

    effects: tuple[OfTable, ...] = ()

    def true_angle(self, axis: str, angle_rad: Floats) -> Floats:
        """Return the true angle of an axis whose encoder stands at ``angle_rad`` (n,), whenever that is."""
        for effect in self.effects:
            angle_rad = effect.true_angle(axis, angle_rad)
        return angle_rad

    def true_angles(self, axis: str, angles: Angles, started_s: float) -> Angles:
        """Return a function that gives the true angles (n,) of an axis at instants (n,), by those of its encoder.

        ``angles`` gives the latter; ``started_s`` is the bench clock at the instant 0. Faulty readings that the servo
        follows move the axis the other way.
        """
        effects = [e for e in self.effects if isinstance(e, TableReading) and e.axis == axis and e.followed]
        shifts = [effect.shift(angles, started_s) for effect in effects]

        def true(t_s: Floats) -> Floats:
            angle_rad = self.true_angle(axis, angles(t_s))
            for shift in shifts:
                angle_rad = angle_rad - shift(t_s)
            return angle_rad

        return true

    def directions(self, gimbals: Sequence[str]) -> Mapping[str, Floats]:
        """Return the unit vectors (3,), by name, of those axes alone that at home are not where they should be."""
        tilts = {axis: np.sum([effect.tilt(axis) for effect in self.effects], 0) for axis in gimbals if self.effects}
        tilted = {axis: _UNIT[axis] + tilt for axis, tilt in tilts.items() if np.any(tilt)}
        return {axis: direction / np.linalg.norm(direction) for axis, direction in tilted.items()}

    def read(self, axis: str, motion: Motion, started_s: float) -> Motion:
        """Return the motion of an axis as it is read; its instant 0 is ``started_s`` of the bench clock."""
        for effect in self.effects:
            if isinstance(effect, TableReading) and effect.axis == axis:
                motion = effect.read(motion, started_s)
        return motion
