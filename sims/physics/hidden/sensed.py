"""Effects that follow the motion: what a gyro senses beside its rate, and how its scale factor varies.

Each gives what it adds to the output, (n, m) in rad/s, before the gyro's own low pass.
"""

from abc import ABC, abstractmethod
from dataclasses import field
from typing import Any

import numpy as np

from drivers.types import Floats
from sims.physics.hidden.fields import Each, choice, each, given, hidden, whole
from sims.physics.hidden.scene import Scene

KINDS: dict[str, type[Any]] = {}
AXES = ("x", "y", "z")
_STILL_RPS = 1e-6  # rates come from differences of angles


class Sensed(ABC):
    """An effect that follows the motion."""

    @abstractmethod
    def output(self, scene: Scene) -> Floats:
        """Return what it adds (n, m), rad/s."""


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
    """A scale factor that differs between the directions by twice ``size``."""

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
    """What angular acceleration about the tilt axes j and k adds; rad/s per rad/s2."""

    j: Each = field(default=0.0, metadata=each("deg/s/(deg/s2)"))
    k: Each = field(default=0.0, metadata=each("deg/s/(deg/s2)"))

    def output(self, scene: Scene) -> Floats:
        mounting = scene.world.mounting
        return np.asarray(self.j * (scene.acceleration @ mounting.j.T) + self.k * (scene.acceleration @ mounting.k.T))


@hidden(KINDS, "table_harmonic")
class TableHarmonic(Sensed):
    """What goes round with an axis of the table: cosine and sine (rad/s) of ``order`` times its angle."""

    axis: str = field(metadata=choice(AXES))
    order: int = field(default=1, metadata=whole())
    cosine: Each = field(default=0.0, metadata=each("deg/s"))
    sine: Each = field(default=0.0, metadata=each("deg/s"))

    def output(self, scene: Scene) -> Floats:
        angle = self.order * scene.angle(self.axis)
        return np.asarray(self.cosine * np.cos(angle) + self.sine * np.sin(angle))


@hidden(KINDS, "motor_current_gain")
class MotorCurrentGain(Sensed):
    """A scale factor that follows the current of all motors: the supply gives way to it.

    A motor's current is that of its acceleration and of its friction, stated as the acceleration (rad/s2) that
    would need as much. ``size`` is the share per rad/s2.
    """

    size: Each = field(metadata=each("ppm/(deg/s2)"))
    friction: float = field(default=0.0, metadata=given("deg/s2"))

    def output(self, scene: Scene) -> Floats:
        rate, acceleration = scene.axes
        turning = np.where(np.abs(rate) > _STILL_RPS, np.sign(rate), 0.0)
        current = np.abs(acceleration + self.friction * turning).sum(axis=1, keepdims=True)
        return np.asarray(self.size * current * scene.u)
