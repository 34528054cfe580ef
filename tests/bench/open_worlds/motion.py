"""The motion of a body through a script, at the instants of samples, by kinematics of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.geometry.kinematics import Site
from sims.physics.motion import AxisMotion
from station.scripts.loop_scripts import (
    RAMP_RPS2,
    between_rests,
    exploration_script,
    there_and_back,
    verification_script,
)
from station.scripts.script import Move, Rest, Script, Step, paper_script

Floats = NDArray[np.float64]

GIMBALS = "zyx"
"""Axes of the table, outermost first."""
DEG = float(np.pi / 180)
SITE = Site(float(np.pi / 4), 0.0)
_UNLIMITED = 1e3
_STEP_S = 1e-4


@dataclass(frozen=True, eq=False)
class Motion:
    """Angles, rates and accelerations (n, 3) of the axes z, y, x at instants (n,); what the body feels follows."""

    t_s: Floats
    angle_rad: Floats
    rate_rps: Floats
    acceleration_rps2: Floats

    @cached_property
    def attitude(self) -> Floats:
        """Rotations (n, 3, 3) that take body vectors to the base: R = Rz Ry Rx."""
        return np.asarray(Rotation.from_euler("ZYX", self.angle_rad).as_matrix())

    @cached_property
    def axes(self) -> Floats:
        """Unit vectors (n, 3, 3) along the axes z, y, x of the table, in body axes."""
        x = self.angle_rad[:, 2]
        y_axis = np.column_stack([np.zeros_like(x), np.cos(x), -np.sin(x)])
        x_axis = np.tile([1.0, 0.0, 0.0], (len(x), 1))
        return np.stack([self.attitude[:, 2], y_axis, x_axis], axis=1)

    @cached_property
    def w_rps(self) -> Floats:
        """Rate of the body against the base (n, 3), body axes."""
        return np.asarray(np.einsum("ng,ngi->ni", self.rate_rps, self.axes))

    @cached_property
    def wdot_rps2(self) -> Floats:
        """Its derivative in body axes (n, 3): each axis' acceleration, and how the outer axes turn in the body.

        An axis that is fixed in an outer gimbal turns in the body with minus the rate of all gimbals within it.
        """
        out = np.einsum("ng,ngi->ni", self.acceleration_rps2, self.axes)
        for outer in range(2):
            inner = np.einsum("ng,ngi->ni", self.rate_rps[:, outer + 1 :], self.axes[:, outer + 1 :])
            out = out - self.rate_rps[:, outer : outer + 1] * np.cross(inner, self.axes[:, outer])
        return np.asarray(out)

    @cached_property
    def up(self) -> Floats:
        """Specific force at rest (n, 3) in body axes, g."""
        return self.attitude[:, 2]

    def into_body(self, base: Floats) -> Floats:
        """Return a vector of the base (3,) in body axes (n, 3)."""
        return np.asarray(np.einsum("nji,j->ni", self.attitude, base))

    @cached_property
    def inertial_rps(self) -> Floats:
        """Rate of the body in inertial space (n, 3), body axes."""
        return self.w_rps + self.into_body(SITE.earth_rate_rps())


@lru_cache(maxsize=8)
def motion_of(name: str, rate_hz: float = 100.0) -> Motion:
    """Return the motion through a script of ``SCRIPTS``."""
    script = SCRIPTS[name]
    motions = {axis: AxisMotion(0.0, _UNLIMITED, _UNLIMITED) for axis in GIMBALS}
    for motion in motions.values():
        motion.keep_all()
    angles = dict.fromkeys(GIMBALS, 0.0)
    at_s = 0.0
    for step, span in zip(script.steps, script.spans(), strict=True):
        if not isinstance(step, Rest):
            angles[step.axis] = step.angle_rad if isinstance(step, Move) else angles[step.axis] + step.turn_rad
            motions[step.axis].move(at_s, angles[step.axis], abs(step.rate_rps), step.acceleration_rps2)
        at_s += span.least_s
    t_s = np.arange(1, round(script.least_s * rate_hz) + 1) / rate_hz
    angle = np.column_stack([motions[a].angles(t_s) for a in GIMBALS])
    rate = np.column_stack([motions[a].rates(t_s) for a in GIMBALS])
    before, after = (np.column_stack([motions[a].rates(t_s + step) for a in GIMBALS]) for step in (-_STEP_S, _STEP_S))
    return Motion(t_s, angle, rate, (after - before) / (2 * _STEP_S))


def _tilted(name: str, tilt_deg: tuple[float, float], rates_dps: tuple[float, float]) -> Script:
    """Return turns of one axis while another stands tilted, which shows what depends on two angles or two rates."""
    x_deg, y_deg = tilt_deg
    slow, fast = rates_dps
    steps: list[Step] = [
        _to("x", x_deg),
        *there_and_back("z", slow),
        *there_and_back("y", fast),
        _to("x", 0.0),
        _to("y", y_deg),
        *there_and_back("z", fast),
        *there_and_back("x", slow),
        _to("x", -x_deg),
        *there_and_back("z", slow),
        _to("x", 0.0),
        _to("y", 0.0),
        *there_and_back("x", fast),
    ]
    return between_rests(name, steps)


def _spindle(name: str, rates_dps: Sequence[float]) -> Script:
    """Return turns of z alone, as on a spindle with an encoder."""
    return between_rests(name, [turn for rate in rates_dps for turn in there_and_back("z", rate)])


def _poses(name: str, seed: int, count: int = 24) -> Script:
    """Return rests of ten seconds in poses that differ in the angles of x and y."""
    random = np.random.default_rng(seed)
    steps: list[Step] = [Rest(10.0)]
    for i in range(count):
        steps += [_to("xy"[i % 2], 15.0 * float(random.integers(-11, 12))), Rest(10.0)]
    return Script(name, tuple(steps))


def _to(axis: str, angle_deg: float) -> Move:
    return Move(axis, angle_deg * DEG, 20 * DEG, RAMP_RPS2, f"{axis} to {angle_deg:g} deg")


SCRIPTS = {
    "calibration": paper_script(),
    "exploration": exploration_script(),
    "verification": verification_script(),
    "tilted exploration": _tilted("tilted exploration", (40.0, 50.0), (12.0, 30.0)),
    "tilted verification": _tilted("tilted verification", (-55.0, 35.0), (-20.0, 25.0)),
    "spindle calibration": _spindle("spindle calibration", (10.0, 20.0, 40.0, -15.0, 35.0)),
    "spindle exploration": _spindle("spindle exploration", (5.0, 12.0, 30.0, 60.0, -25.0)),
    "spindle verification": _spindle("spindle verification", (-45.0, 8.0, 22.0, 50.0)),
    "poses calibration": _poses("poses calibration", 1),
    "poses exploration": _poses("poses exploration", 2, 36),
    "poses verification": _poses("poses verification", 3),
}
