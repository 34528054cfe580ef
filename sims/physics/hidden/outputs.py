"""Effects on gyro outputs: of the motion beyond its rate, of time, and of temperature.

Each gives what it adds, (n, m) in rad/s. Times are those of the bench clock, which goes on from run to run.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import field, replace
from typing import Any, Self

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import WHOLE, Each, choice, each, given, hidden
from sims.physics.hidden.scene import Scene

KINDS: dict[str, type[Any]] = {}
AXES = ("x", "y", "z")
_STILL_RPS = 1e-6  # rates come from differences of angles
_KNOT_S = 0.1
_KNOTS_AT_ONCE = 4096


class Output(ABC):
    """An effect on the output."""

    @abstractmethod
    def output(self, scene: Scene) -> Floats:
        """Return the outputs (n, m) in rad/s that the effect adds."""


class Added(Output):
    """An effect of the electronics, which is there whether or not the gyro turns."""


class Sensed(Output):
    """An effect of the motion, before the low pass: a varying scale factor, or something sensed beside the rate."""


@hidden(KINDS, "thermal_bias")
class ThermalBias(Added):
    """A bias that follows the temperature; ``linear`` in rad/s/K, ``quadratic`` in rad/s/K2."""

    linear: Each = field(default=0.0, metadata=each("deg/s/degC"))
    quadratic: Each = field(default=0.0, metadata=each("deg/s/degC2"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.linear * scene.warmth + self.quadratic * scene.warmth**2)


@hidden(KINDS, "thermal_gradient")
class ThermalGradient(Added):
    """A bias that follows the rate of change of the temperature; ``size`` in rad/s per K/s."""

    size: Each = field(metadata=each("deg/s/(degC/s)"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size * scene.world.temperature.slope(scene.clock_s)[:, None])


@hidden(KINDS, "thermal_lag")
class ThermalLag(Added):
    """A bias that follows the temperature of the gyro, which lags behind the reported one."""

    linear: Each = field(metadata=each("deg/s/degC"))
    lag_s: float = field(default=40.0, metadata=given("s", least=1e-3))

    def output(self, scene: Scene) -> Floats:
        profile = scene.world.temperature
        return np.asarray(self.linear * (profile.lagged(scene.clock_s, self.lag_s) - profile.reference_c)[:, None])


@hidden(KINDS, "bias_drift")
class BiasDrift(Added):
    """A bias that grows linearly by ``size_rps`` in ``over_s``, and beyond."""

    size_rps: Each = field(metadata=each("deg/s"))
    over_s: float = field(default=3600.0, metadata=given("s", least=1e-3))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size_rps * (scene.clock_s / self.over_s)[:, None])


@hidden(KINDS, "warm_up")
class WarmUp(Added):
    """A bias that approaches ``size_rps`` with a time constant."""

    size_rps: Each = field(metadata=each("deg/s"))
    time_constant_s: float = field(metadata=given("s", least=1e-3))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size_rps * -np.expm1(-np.maximum(scene.clock_s, 0.0) / self.time_constant_s)[:, None])


@hidden(KINDS, "bias_step")
class BiasStep(Added):
    """A bias that is present from an instant on."""

    size_rps: Each = field(metadata=each("deg/s"))
    at_s: float = field(metadata=given("s"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size_rps * (scene.clock_s >= self.at_s)[:, None])


@hidden(KINDS, "bias_walk")
class BiasWalk(Added):
    """A rate random walk that starts at the bench clock's 0; ``size`` in rad/s/rts.

    The same ``seed`` gives the same walk in all runs of a bench clock; without one each run has its own.
    """

    size: Each = field(metadata=each("deg/h/rth"))
    seed: int = field(default=0, metadata=WHOLE)
    path: "WalkPath | None" = None

    def for_run(self, count: int, seed: tuple[int, ...]) -> Self:
        """Return the walk of ``count`` gyros of one device, which ``seed`` names in a run."""
        return replace(self, path=WalkPath(count, (self.seed, *seed[1:]) if self.seed else seed))

    def output(self, scene: Scene) -> Floats:
        if self.path is None:
            raise ValueError("a walk needs a path: for_run gives it one")
        return np.asarray(self.size * self.path.at(scene.clock_s))


@hidden(KINDS, "tone")
class Tone(Added):
    """A sine of the bench clock."""

    size_rps: Each = field(metadata=each("deg/s"))
    frequency_hz: float = field(metadata=given("Hz", least=1e-6))
    phase_rad: Each = field(default=0.0, metadata=each("deg"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(
            self.size_rps * np.sin(2 * math.pi * self.frequency_hz * scene.clock_s[:, None] + self.phase_rad)
        )


@hidden(KINDS, "thermal_scale")
class ThermalScale(Sensed):
    """A scale factor in proportion to temperature; ``linear`` in 1/K."""

    linear: Each = field(metadata=each("ppm/degC"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.linear * scene.warmth * scene.u)


@hidden(KINDS, "scale_step")
class ScaleStep(Sensed):
    """A scale factor that is larger by ``size`` from an instant of the bench clock on."""

    size: Each = field(metadata=each("ppm"))
    at_s: float = field(metadata=given("s"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size * scene.u * (scene.clock_s >= self.at_s)[:, None])


@hidden(KINDS, "alignment_step")
class AlignmentStep(Sensed):
    """A sense axis that is tilted further from an instant of the bench clock on: by ``sigma_j``, ``sigma_k``; rad."""

    at_s: float = field(metadata=given("s"))
    sigma_j: Each = field(default=0.0, metadata=each("deg"))
    sigma_k: Each = field(default=0.0, metadata=each("deg"))

    def output(self, scene: Scene) -> Floats:
        mounting, w_rps = scene.world.mounting, scene.world.body.rate_rps(scene.t_s)
        tilted = self.sigma_j * (w_rps @ mounting.k.T) - self.sigma_k * (w_rps @ mounting.j.T)
        return np.asarray(tilted * (scene.clock_s >= self.at_s)[:, None])


@hidden(KINDS, "scale_asymmetry")
class ScaleAsymmetry(Sensed):
    """A scale factor that differs between the two directions by twice ``size``."""

    size: Each = field(metadata=each("ppm"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size * np.abs(scene.u))


@hidden(KINDS, "scale_quadratic")
class ScaleQuadratic(Sensed):
    """An output that grows with the square of the rate; ``size`` in s/rad."""

    size: Each = field(metadata=each("ppm/(deg/s)"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size * scene.u**2)


@hidden(KINDS, "scale_cubic")
class ScaleCubic(Sensed):
    """An output that grows with the cube of the rate; ``size`` in (s/rad)^2."""

    size: Each = field(metadata=each("ppm/(deg/s)2"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(self.size * scene.u**3)


@hidden(KINDS, "g_sensitivity")
class GSensitivity(Sensed):
    """A bias from gravity along the axes of the body; rad/s per g."""

    x: Each = field(default=0.0, metadata=each("deg/s/g"))
    y: Each = field(default=0.0, metadata=each("deg/s/g"))
    z: Each = field(default=0.0, metadata=each("deg/s/g"))

    def output(self, scene: Scene) -> Floats:
        return np.asarray(scene.up @ np.array([self.x, self.y, self.z]))


@hidden(KINDS, "acceleration_sensitivity")
class AccelerationSensitivity(Sensed):
    """An output in proportion to angular acceleration about the tilt axes j and k; rad/s per rad/s2."""

    j: Each = field(default=0.0, metadata=each("deg/s/(deg/s2)"))
    k: Each = field(default=0.0, metadata=each("deg/s/(deg/s2)"))

    def output(self, scene: Scene) -> Floats:
        mounting = scene.world.mounting
        return np.asarray(self.j * (scene.acceleration @ mounting.j.T) + self.k * (scene.acceleration @ mounting.k.T))


@hidden(KINDS, "table_harmonic")
class TableHarmonic(Sensed):
    """An output periodic in the angle of a table axis: cosine and sine (rad/s) of ``order`` times the angle."""

    axis: str = field(metadata=choice(AXES))
    order: int = field(default=1, metadata=WHOLE)
    cosine: Each = field(default=0.0, metadata=each("deg/s"))
    sine: Each = field(default=0.0, metadata=each("deg/s"))

    def output(self, scene: Scene) -> Floats:
        angle = self.order * scene.angle(self.axis)
        return np.asarray(self.cosine * np.cos(angle) + self.sine * np.sin(angle))


@hidden(KINDS, "motor_current_gain")
class MotorCurrentGain(Sensed):
    """A scale factor that follows the current of all motors, which load the supply.

    The current of a motor is that of its acceleration and its friction; the latter is stated as the acceleration
    (rad/s2) that would need as much. ``size`` is the share per rad/s2.
    """

    size: Each = field(metadata=each("ppm/(deg/s2)"))
    friction: float = field(default=0.0, metadata=given("deg/s2"))

    def output(self, scene: Scene) -> Floats:
        rate, acceleration = scene.axes
        turning = np.where(np.abs(rate) > _STILL_RPS, np.sign(rate), 0.0)
        current = np.abs(acceleration + self.friction * turning).sum(axis=1, keepdims=True)
        return np.asarray(self.size * current * scene.u)


class WalkPath:
    """Wiener processes (m,) of unit size, computed as far as they are needed."""

    def __init__(self, count: int, seed: tuple[int, ...]) -> None:
        """Start at zero at the instant 0."""
        self._random = np.random.default_rng((*seed, 87))
        self._knots = np.zeros((1, count))

    def at(self, t_s: Floats) -> Floats:
        """Return the processes (n, m) at instants (n,), one or more, linear between knots; 0 before the instant 0."""
        at = np.maximum(t_s, 0.0) / _KNOT_S
        while len(self._knots) < at.max() + 2:
            steps = math.sqrt(_KNOT_S) * self._random.standard_normal((_KNOTS_AT_ONCE, self._knots.shape[1]))
            self._knots = np.vstack([self._knots, self._knots[-1] + np.cumsum(steps, axis=0)])
        before = at.astype(np.int64)
        share = (at - before)[:, None]
        return np.asarray((1 - share) * self._knots[before] + share * self._knots[before + 1])
