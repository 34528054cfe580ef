"""The Cramér-Rao bound of a whole IMU on a table, from the physics alone: nothing of the estimator is used.

It is that of an estimator which knows the motion and the noise of the twins, where noise is white and a wandering bias
made of four Gauss-Markov processes (``sims.physics.wander``). Known beforehand are gravity and level as far as a
station knows them; all else comes from the samples. (Kay, Fundamentals of Statistical Signal Processing I, ch. 3.)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from sims.physics.motion import AxisMotion
from station.scripts.script import Script

WANDERS_S = np.array([1.0, 10.0, 100.0, 1000.0])
WANDER_SHARE = 0.664 / 0.775  # of the bias instability is the standard deviation of each process
TOGETHER = 10  # samples between two steps of the wandering bias
GRAVITY_SD, LEVEL_SD_RAD = 5e-5, math.radians(0.05)
COUNT_RAD = 2 * math.pi / 65536
SIDEREAL_DAY_S = 86164.0905
_NO_LIMIT = 1e3
_STEP_S = 2e-4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sensors:
    """Three gyros or accelerometers: axes (3, 3) each, true states (3, 4), places (3, 3) in m.

    ``delay_s`` is by how much the outputs are late.
    """

    p: np.ndarray
    j: np.ndarray
    k: np.ndarray
    states: np.ndarray
    places_m: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    delay_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Bound:
    """Standard deviations at the bound: states (3, 4), places (3, 3) of accelerometers in m, delay in s."""

    states: np.ndarray
    places_m: np.ndarray | None
    delay_s: float


class Motion:
    """The motion of a three-axis table under a script, at any instant; gimbals are outermost first."""

    def __init__(
        self, script: Script, *, rate_hz: float, gimbals: tuple[str, ...], latitude_rad: float, heading_rad: float
    ) -> None:
        """Carry out the moves of a script from home; samples are at whole multiples of ``1 / rate_hz``."""
        self.gimbals = gimbals
        self.axes = {axis: AxisMotion(0.0, _NO_LIMIT, _NO_LIMIT) for axis in gimbals}
        moving_s = []
        for motion in self.axes.values():
            motion.keep_all()
        for timed in script.timeline():
            for start_s, turn in timed.turns():
                self.axes[turn.axis].move(start_s, turn.to_rad, abs(turn.rate_rps), turn.acceleration_rps2)
                moving_s.append(start_s)
        self.rate_hz = rate_hz
        groups = round(script.least_s * rate_hz) // TOGETHER
        self.t_s = np.arange(1, groups * TOGETHER + 1) / rate_hz
        north, up = math.cos(latitude_rad), math.sin(latitude_rad)
        pole = [north * math.cos(heading_rad), north * math.sin(heading_rad), up]
        self.earth_rps = 2 * math.pi / SIDEREAL_DAY_S * np.array(pole)

    def angles(self, t_s: np.ndarray) -> dict[str, np.ndarray]:
        """Return the angle (n,) of each axis."""
        return {axis: motion.angles(t_s) for axis, motion in self.axes.items()}

    def in_body(self, vectors: np.ndarray, angles: dict[str, np.ndarray]) -> np.ndarray:
        """Return vectors of the base (3,) or (n, 3) in the axes of the body (n, 3)."""
        n = len(angles[self.gimbals[0]])
        out = np.broadcast_to(vectors, (n, 3))
        for axis in self.gimbals:
            out = seen_from_turned(axis, angles[axis], out)
        return out

    def rate_rps(self, t_s: np.ndarray, earth_rps: np.ndarray) -> np.ndarray:
        """Return the rate of the body (n, 3) in its own axes: of the Earth and of each gimbal, carried inwards."""
        out = np.broadcast_to(earth_rps, (len(t_s), 3))
        for axis in self.gimbals:
            out = seen_from_turned(axis, self.axes[axis].angles(t_s), out).copy()
            out[:, "xyz".index(axis)] += self.axes[axis].rates(t_s)
        return out

    def turning(self, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rate of the body against the base and its derivative, each (n, 1, 3), in its own axes."""
        none = np.zeros(3)
        before, rate, after = (self.rate_rps(t_s + step, none)[:, None] for step in (-_STEP_S, 0.0, _STEP_S))
        return rate, (after - before) / (2 * _STEP_S)

    def stands(self, axis: str) -> np.ndarray:
        """Return for each sample (n,) which stand of an axis it belongs to, -1 while the axis turns."""
        still = np.abs(self.axes[axis].rates(self.t_s)) < 1e-9
        return np.where(still, np.cumsum(np.diff(still.astype(int), prepend=0) > 0) - 1, -1)


def seen_from_turned(axis: str, angle_rad: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) in a frame that is turned by angles (n,) about one of its axes."""
    first, second = [("xyz".index(axis) + step) % 3 for step in (1, 2)]
    out = np.array(vectors)
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    out[:, first] = cos * vectors[:, first] + sin * vectors[:, second]
    out[:, second] = cos * vectors[:, second] - sin * vectors[:, first]
    return out


class Whitening:
    """The Kalman filter of white noise and a wandering bias, whose gains are those of every run of this length."""

    def __init__(self, *, white: float, instability: float, rate_hz: float, groups: int) -> None:
        """Prepare the gains for group means; ``white`` is a density, ``instability`` that of the bias."""
        self.sample_sd = white * math.sqrt(rate_hz)
        self._keep = np.exp(-TOGETHER / rate_hz / WANDERS_S)
        stationary = np.full(len(WANDERS_S), (WANDER_SHARE * instability) ** 2)
        push = np.diag(stationary * (1 - self._keep**2))
        covariance = np.diag(stationary)
        self._gains = np.empty((groups, len(WANDERS_S)))
        self._sd = np.empty(groups)
        for n in range(groups):
            across = covariance.sum(axis=1)
            variance = across.sum() + self.sample_sd**2 / TOGETHER
            gain = across / variance
            self._gains[n], self._sd[n] = gain, math.sqrt(variance)
            covariance = covariance - np.outer(gain, across)
            covariance = self._keep[:, None] * covariance * self._keep + push

    def of_means(self, means: np.ndarray) -> np.ndarray:
        """Return columns of group means (g, c) as rows whose noise is white with variance one."""
        state = np.zeros((len(WANDERS_S), means.shape[1]))
        out = np.empty_like(means)
        for n, row in enumerate(means):
            left = row - state.sum(axis=0)
            out[n] = left / self._sd[n]
            state = self._keep[:, None] * (state + self._gains[n][:, None] * left)
        return out

    def information(self, columns: np.ndarray) -> np.ndarray:
        """Return the Fisher information of columns (n, c) by sample.

        The bias is the same in all samples of a group: differences within it have white noise, means the rest.
        """
        grouped = columns.reshape(-1, TOGETHER, columns.shape[1])
        means = grouped.mean(axis=1)
        within = (grouped - means[:, None]).reshape(columns.shape)
        rows = self.of_means(means)
        return np.asarray(rows.T @ rows + within.T @ within / self.sample_sd**2)


def gyro_bound(motion: Motion, gyros: Sensors, noise: Whitening) -> Bound:
    """Return the bound for gyros, whose delay against the table is not known either."""

    def inputs(one: Sensors) -> np.ndarray:
        rate = motion.rate_rps(motion.t_s - one.delay_s, motion.earth_rps)
        return np.repeat(rate[:, None], 3, axis=1)

    columns = [*by_states(gyros, inputs(gyros)), derivative(inputs, gyros, "delay_s")]
    whole = np.zeros((13, 13))
    for number in range(3):
        own = [*range(4 * number, 4 * number + 4), 12]
        whole[np.ix_(own, own)] += noise.information(np.column_stack([c[:, number] for c in columns]))
    sd = sds(whole)
    return Bound(states=sd[:12].reshape(3, 4), places_m=None, delay_s=float(sd[12]))


def force_bounds(
    motion: Motion, accelerometers: Sensors, noise: Whitening, *, gravity_mps2: float
) -> tuple[Bound, Bound]:
    """Return the bounds for accelerometers beside gravity and level: with angles known exactly, and with axes that
    stand anywhere within the count of the encoder that is read.
    """

    def inputs(one: Sensors, tilt: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
        t_s = motion.t_s - one.delay_s
        up = gravity_mps2 * np.array([tilt[1], -tilt[0], 1.0])
        return motion.in_body(up, motion.angles(t_s))[:, None] + moved_at(*motion.turning(t_s), one.places_m)

    force, rate, small = inputs(accelerometers), motion.turning(motion.t_s - accelerometers.delay_s), 1e-4
    own = by_states(accelerometers, force)
    own += [without_bias(accelerometers, moved_at(*rate, unit)) for unit in np.eye(3)]
    moves = [(inputs(accelerometers, tilt) - force) / small for tilt in ((small, 0.0), (0.0, small))]
    heavier = force - moved_at(*rate, accelerometers.places_m)
    shared = [derivative(inputs, accelerometers, "delay_s")]
    shared += [without_bias(accelerometers, change) for change in (heavier, *moves)]
    counts = counted_angles(motion, accelerometers, gravity_mps2)
    known = [0.0, 1 / GRAVITY_SD**2, *(2 * [1 / LEVEL_SD_RAD**2]), *([12 / COUNT_RAD**2] * counts.shape[2])]
    whole = np.diag(np.concatenate([np.zeros(21), known]))
    for number in range(3):
        places = [*range(7 * number, 7 * number + 7), *range(21, len(whole))]
        seen = np.column_stack([column[:, number] for column in (*own, *shared)])
        whole[np.ix_(places, places)] += noise.information(np.hstack([seen, counts[number]]))
    exact, counted = sds(whole[:25, :25]), sds(whole)
    return _force_bound(exact), _force_bound(counted)


def _force_bound(sd: np.ndarray) -> Bound:
    """Return the bound out of standard deviations, of which the first are those of each accelerometer, then delay."""
    by_sensor = sd[:21].reshape(3, 7)
    return Bound(states=by_sensor[:, :4], places_m=by_sensor[:, 4:], delay_s=float(sd[21]))


def without_bias(one: Sensors, true: np.ndarray) -> np.ndarray:
    """Return the outputs (n, 3) of sensors less their bias, for inputs (n, 3, 3), without noise."""
    k, _, sigma_j, sigma_k = one.states.T
    sense = one.p - sigma_k[:, None] * one.j + sigma_j[:, None] * one.k
    return np.asarray((1 - k) * np.einsum("nsi,si->ns", true, sense))


def by_states(one: Sensors, true: np.ndarray) -> list[np.ndarray]:
    """Return the derivatives (n, 3) of the outputs by k, b, sigma_j and sigma_k of each sensor."""
    gain = 1 - one.states[:, 0]
    along_j, along_k = (np.einsum("nsi,si->ns", true, axes) for axes in (one.j, one.k))
    return [-without_bias(one, true) / gain, np.full(along_j.shape, -1.0), gain * along_k, -gain * along_j]


def moved_at(rate_rps: np.ndarray, change_rps2: np.ndarray, places_m: np.ndarray) -> np.ndarray:
    """Return the force (n, 1 or 3, 3) of tangential and centripetal acceleration at places (3,) or (3, 3) of the body.

    ``rate_rps`` and ``change_rps2`` (n, 1, 3) are its rate and the derivative of that.
    """
    return np.asarray(np.cross(change_rps2, places_m) + np.cross(rate_rps, np.cross(rate_rps, places_m)))


def counted_angles(motion: Motion, accelerometers: Sensors, gravity_mps2: float) -> np.ndarray:
    """Return the change (3, n, angles) of the outputs by the angle of each axis in each of its stands."""
    t_s = motion.t_s - accelerometers.delay_s
    angles = motion.angles(t_s)
    up = np.array([0.0, 0.0, gravity_mps2])
    small = 1e-5
    columns = []
    for axis in motion.gimbals[1:]:  # the outermost turns about the plumb line
        change = (motion.in_body(up, {**angles, axis: angles[axis] + small}) - motion.in_body(up, angles)) / small
        seen, stands = change @ accelerometers.p.T, motion.stands(axis)
        columns += [np.where((stands == stand)[:, None], seen, 0.0) for stand in range(stands.max() + 1)]
    return np.stack(columns, axis=2).transpose(1, 0, 2)


def derivative(inputs: Callable[[Sensors], np.ndarray], one: Sensors, name: str) -> np.ndarray:
    """Return the derivative (n, 3) of the outputs by a number that is the same for all sensors."""
    small = 1e-5
    more, less = (inputs(replace(one, **{name: getattr(one, name) + step})) for step in (small, -small))
    return without_bias(one, (more - less) / (2 * small))


def sds(information: np.ndarray) -> np.ndarray:
    """Return the standard deviations at the bound; the information is scaled first, as its units differ."""
    size = 1 / np.sqrt(np.diag(information))
    return np.asarray(size * np.sqrt(np.diag(np.linalg.inv(information * np.outer(size, size)))))
