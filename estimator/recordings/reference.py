"""What says how the body moved: the readings of a table or another instrument, turns by known angles, or poses."""

from dataclasses import dataclass

import numpy as np

from estimator.recordings.motion.ramps import centred
from estimator.types import Floats, Stamps, runs_of

REST_RPS = float(np.radians(0.05))
"""Rates below this count as rest."""
REST_S = 5.0
"""Least length of a rest."""


@dataclass(frozen=True, slots=True)
class TableUncertainty:
    """Standard uncertainties of a table: rate (relative), wobble and orthogonality of its axes, time of readings.

    ``level_rad`` is that of its base from level about a horizontal axis, 0 if nobody states it.
    """

    rate: float = 0.0
    wobble_rad: float = 0.0
    orthogonality_rad: float = 0.0
    timing_s: float = 0.0
    level_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What says how the body moved: the base of all kinds of reference.

    A kind overrides what it can give. Code that needs something asks for it here, and never for the kind.
    """

    @property
    def table(self) -> "TableReadings | None":
        """The readings themselves if a table made them, with the axes and uncertainty that only a table has."""
        return None

    @property
    def turns(self) -> "Turns | None":
        """The reference itself if it is a list of turns by stated angles, which has no rates within a turn."""
        return None

    @property
    def poses(self) -> "Poses | None":
        """The reference itself if it is a list of rests whose direction up is known, with unknown turns between."""
        return None

    @property
    def attitude(self) -> "AttitudeReadings | None":
        """The readings themselves if another instrument measured attitudes."""
        return None

    def external_rates(self) -> "RateReadings | None":
        """Return the body rates (k, 3) of another instrument, measured or from its attitudes; else None."""
        return None

    @property
    def by_turns(self) -> bool:
        """Whether readings are compared by angles turned: those of instruments without a table's rates."""
        return False

    @property
    def at_rest(self) -> bool:
        """Whether another instrument never reports rotation faster than ``REST_RPS``; False if it reports no rates."""
        return False

    @property
    def instants_ns(self) -> Stamps | None:
        """The instants (k,) of the readings; None for turns and poses, which are spans."""
        return None

    @property
    def step_s(self) -> float:
        """The usual time between readings; 0 for turns and poses."""
        return 0.0 if self.instants_ns is None else float(np.median(np.diff(self.instants_ns))) * 1e-9

    @property
    def rests_ns(self) -> list[tuple[int, int]]:
        """The spans (first, last) of at least ``REST_S`` in which the reference says that the body rests."""
        return []


@dataclass(kw_only=True, frozen=True, slots=True, eq=False, weakref_slot=True)
class TableReadings(Reference):
    """Angles and rates (k, gimbals) reported by the table; columns as ``gimbals``, outermost first.

    ``half_width_ns`` (k,) is the largest error of a reading's instant, half of its round trip; None for zero. Rates are
    means over the ``rate_window_ns`` that ends at their instants; without ``own_rates`` they are slopes of the angles.
    """

    t_ns: Stamps
    angle_rad: Floats
    rate_rps: Floats
    gimbals: tuple[str, ...]
    uncertainty: TableUncertainty | None = None
    half_width_ns: Stamps | None = None
    rate_window_ns: int = 0
    own_rates: bool = True

    @property
    def centred_rps(self) -> Floats:
        """Rates (k, gimbals) at the instants, from means about these: wrong at corners of ramps only."""
        return centred(self.t_ns, self.t_ns, self.rate_rps, self.rate_window_ns)

    @property
    def table(self) -> "TableReadings":
        """The readings themselves."""
        return self

    @property
    def by_turns(self) -> bool:
        """Whether the table has a single axis."""
        return len(self.gimbals) == 1

    @property
    def instants_ns(self) -> Stamps:
        """The instants of the readings."""
        return self.t_ns

    @property
    def rests_ns(self) -> list[tuple[int, int]]:
        """The spans in which no axis of the table moves."""
        return _rests_ns(self.t_ns, self.centred_rps)

    @property
    def stands_ns(self) -> list[list[tuple[int, int]]]:
        """For each axis the spans in which it stands, whether or not others move."""
        rates_rps = self.centred_rps
        return [_rests_ns(self.t_ns, rates_rps[:, [column]]) for column in range(len(self.gimbals))]


@dataclass(frozen=True, slots=True, eq=False)
class RateReadings(Reference):
    """Body rates (k, 3) measured by another instrument."""

    t_ns: Stamps
    rate_rps: Floats

    def external_rates(self) -> "RateReadings":
        """Return the readings themselves."""
        return self

    @property
    def by_turns(self) -> bool:
        """True: another instrument."""
        return True

    @property
    def at_rest(self) -> bool:
        """Whether there are known rates, and all of them are below ``REST_RPS``."""
        rate = self.rate_rps[np.isfinite(self.rate_rps).all(axis=1)]
        return bool(len(rate) and (np.abs(rate) < REST_RPS).all())

    @property
    def instants_ns(self) -> Stamps:
        """The instants of the readings."""
        return self.t_ns

    @property
    def rests_ns(self) -> list[tuple[int, int]]:
        """The spans in which the body turns about no axis."""
        return _rests_ns(self.t_ns, self.rate_rps)


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReadings(Reference):
    """Attitudes (k, 4), unit quaternions w x y z that turn body vectors into a frame at rest; NaN where lost."""

    t_ns: Stamps
    attitude_wxyz: Floats

    @property
    def attitude(self) -> "AttitudeReadings":
        """The readings themselves."""
        return self

    @property
    def by_turns(self) -> bool:
        """True: another instrument."""
        return True

    def external_rates(self) -> RateReadings:
        """Return mean body rates (k - 1, 3) between successive attitudes, stamped in the middle.

        NaN beside a lost attitude, and over gaps of more than three usual steps.
        """
        q = self.attitude_wxyz
        w0, v0, w1, v1 = q[:-1, :1], q[:-1, 1:], q[1:, :1], q[1:, 1:]
        scalar = w0 * w1 + np.sum(v0 * v1, axis=1, keepdims=True)
        vector = w0 * v1 - w1 * v0 - np.cross(v0, v1)
        sign = np.where(scalar < 0, -1.0, 1.0)  # q and -q are one attitude: take the short way
        length = np.linalg.norm(vector, axis=1, keepdims=True)
        angle = 2 * np.arctan2(length, sign * scalar)
        turn = sign * vector * np.where(length > 1e-12, angle / np.where(length > 1e-12, length, 1.0), 2.0)
        step_s = np.diff(self.t_ns)[:, None] * 1e-9
        step_s = np.where(step_s > 3 * np.median(step_s), np.nan, step_s)
        return RateReadings((self.t_ns[:-1] + np.diff(self.t_ns) // 2), turn / step_s)

    @property
    def instants_ns(self) -> Stamps:
        """The instants of the readings."""
        return self.t_ns


@dataclass(frozen=True, slots=True, eq=False)
class Turns(Reference):
    """Time spans with the angle turned in each, about body axes (k, 3), and its standard uncertainty (k,)."""

    t_start_ns: Stamps
    t_end_ns: Stamps
    turn_rad: Floats
    sd_rad: Floats

    @property
    def turns(self) -> "Turns":
        """The reference itself."""
        return self

    @property
    def mean_rates_rps(self) -> Floats:
        """The mean body rate (k, 3) of each turn."""
        seconds = np.maximum((self.t_end_ns - self.t_start_ns) * 1e-9, 1e-9)
        return np.asarray(self.turn_rad / seconds[:, None])


@dataclass(frozen=True, slots=True, eq=False)
class Poses(Reference):
    """Time spans of rest with the direction up in each, in body axes (k, 3), and its uncertainty (k,).

    Between them the body is turned by hand. ``shifts`` (q, k, 3): what a sigma of each shared error does to them.
    """

    t_start_ns: Stamps
    t_end_ns: Stamps
    up: Floats
    sd_rad: Floats
    shifts: Floats

    @property
    def poses(self) -> "Poses":
        """The reference itself."""
        return self

    @property
    def rests_ns(self) -> list[tuple[int, int]]:
        """The poses that last long enough."""
        pairs = zip(self.t_start_ns.tolist(), self.t_end_ns.tolist(), strict=True)
        return [(first, last) for first, last in pairs if last - first >= REST_S * 1e9]


def _rests_ns(t_ns: Stamps, rate_rps: Floats) -> list[tuple[int, int]]:
    """Return the spans (first, last) of at least ``REST_S`` in which all rates (k, axes) are below ``REST_RPS``."""
    still = np.asarray((np.abs(rate_rps) < REST_RPS).all(axis=1))
    spans = [(int(t_ns[start]), int(t_ns[stop - 1])) for start, stop in runs_of(still)]
    return [(first, last) for first, last in spans if last - first >= REST_S * 1e9]
