"""Motion of a body, and what gyros, accelerometers and other instruments make of it. Nothing of the estimator is in it.

A motion is three angles over time (rotations about z, then y, then x); body rates are differences of attitudes half a
millisecond apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

Floats = np.ndarray

G_MPS2 = 9.80665
_GRID_HZ = 500.0
_HALF_S = 5e-4


@dataclass(frozen=True)
class Motion:
    """Angles (rad) about z, y, x over ``seconds``; before and after that the body goes on as the splines do."""

    angles: CubicSpline
    seconds: float

    def attitude(self, t_s: Floats) -> Rotation:
        """Return the rotations, body to base, at some instants."""
        inside = np.clip(t_s, 0.0, self.seconds)
        return Rotation.from_euler("ZYX", self.angles(inside))

    def rate(self, t_s: Floats) -> Floats:
        """Return body rates (n, 3) in deg/s."""
        before, after = self.attitude(t_s - _HALF_S), self.attitude(t_s + _HALF_S)
        return np.degrees((before.inv() * after).as_rotvec()) / (2 * _HALF_S)

    def up(self, t_s: Floats) -> Floats:
        """Return directions up (n, 3) in body axes."""
        return self.attitude(t_s).inv().apply([0.0, 0.0, 1.0])


def of_rates(rates_dps: Floats) -> Motion:
    """Return the motion of Euler angles whose rates (n, 3) about z, y, x are given on an even grid of 500 Hz."""
    angles = np.radians(np.cumsum(rates_dps, axis=0) / _GRID_HZ)
    t_s = np.arange(len(angles)) / _GRID_HZ
    return Motion(CubicSpline(t_s, angles), float(t_s[-1]))


def by_hand(random: np.random.Generator, seconds: float, fastest_dps: float) -> Motion:
    """Return what hands do: swings of 0.15 to 1.1 Hz about all axes that come and go, with short rests between."""
    t_s = np.arange(0.0, seconds, 1 / _GRID_HZ)
    rates = np.zeros((len(t_s), 3))
    for axis in range(3):
        for hz in random.uniform(0.15, 1.1, 4):
            rates[:, axis] += random.uniform(0.4, 1.0) * np.sin(2 * np.pi * (hz * t_s + random.uniform()))
    course = np.clip(1.4 * np.sin(2 * np.pi * (t_s / random.uniform(17, 23) + random.uniform())) + 0.6, 0.0, 1.0)
    rates *= course[:, None]
    rates[: round(2 * _GRID_HZ)] = 0.0
    rates = uniform_filter1d(rates, round(0.1 * _GRID_HZ), axis=0)
    return of_rates(rates * fastest_dps / np.abs(rates).max())


def by_robot(random: np.random.Generator, seconds: float, fastest_dps: float) -> Motion:
    """Return joints that move one after the other or together: ramps, steady rates, stops; corners last 60 ms."""
    n = round(seconds * _GRID_HZ)
    rates = np.zeros((n, 3))
    for axis in range(3):
        at = round(random.uniform(2, 4) * _GRID_HZ)
        turned_deg = 0.0
        while at < n - 8 * _GRID_HZ:
            top = random.uniform(0.3, 1.0) * fastest_dps
            ramp_s, steady_s = top / random.uniform(120, 300), random.uniform(0.3, 1.5)
            way = -np.sign(turned_deg) if abs(turned_deg) > 40 else random.choice([-1.0, 1.0])
            length = 2 * ramp_s + steady_s
            inside_s = np.arange(round(length * _GRID_HZ)) / _GRID_HZ
            shape = np.interp(inside_s, [0, ramp_s, ramp_s + steady_s, length], [0, 1, 1, 0])
            rates[at : at + len(shape), axis] = way * top * shape
            turned_deg += way * top * (ramp_s + steady_s)
            at += len(shape) + round(random.uniform(0.3, 2.0) * _GRID_HZ)
    return of_rates(uniform_filter1d(rates, round(0.06 * _GRID_HZ), axis=0))


def on_spindle(random: np.random.Generator, rates_dps: tuple[float, ...], each_s: float = 8.0) -> Motion:
    """Return turns about z at steady rates, one after the other with ramps of 0.5 s and rests between."""
    corners_s, values = [0.0, 5.0], [0.0, 0.0]
    for rate in rates_dps:
        start = corners_s[-1] + random.uniform(2, 3)
        corners_s += [start, start + 0.5, start + 0.5 + each_s, start + 1.0 + each_s]
        values += [0.0, rate, rate, 0.0]
    end_s = corners_s[-1] + 5.0
    t_s = np.arange(0.0, end_s, 1 / _GRID_HZ)
    rates = np.zeros((len(t_s), 3))
    rates[:, 0] = np.interp(t_s, corners_s, values)
    return of_rates(uniform_filter1d(rates, round(0.04 * _GRID_HZ), axis=0))


def by_stepper(random: np.random.Generator, seconds: float, fastest_dps: float) -> Motion:
    """Return a shaft that a stepper turns to and fro over about 180 deg without rests."""
    t_s = np.arange(0.0, seconds, 1 / _GRID_HZ)
    period_s = 2 * 180 / fastest_dps + 0.6
    rates = np.zeros((len(t_s), 3))
    rates[:, 0] = fastest_dps * np.clip(3 * np.sin(2 * np.pi * t_s / period_s), -1, 1)
    rates[:, 0] *= 1 + 0.02 * np.sin(2 * np.pi * t_s / 31.0)
    return of_rates(uniform_filter1d(rates, round(0.05 * _GRID_HZ), axis=0))


@dataclass(frozen=True)
class Unit:
    """Three gyros along x, y, z: ``k`` (3,), biases ``b`` (3,) in deg/s; each is tilted by ``skew`` (3, 3).

    The output is ``(1 - k) (row + skew) . w - b``, with white noise of ``arw`` (deg/s/rtHz).
    """

    k: Floats
    b_dps: Floats
    skew: Floats
    arw: float

    @classmethod
    def of(cls, random: np.random.Generator, arw: float = 0.01) -> Unit:
        """Return one of errors of 0.5 %, 0.4 deg/s and 3 mrad."""
        skew = 3e-3 * random.standard_normal((3, 3)) * (1 - np.eye(3))
        return cls(5e-3 * random.standard_normal(3), 0.4 * random.standard_normal(3), skew, arw)

    def output(self, rate_dps: Floats, hz: float, random: np.random.Generator) -> Floats:
        """Return what the gyros put out (n, 3) in deg/s at body rates (n, 3), sampled at this frequency."""
        noise = self.arw * np.sqrt(hz) * random.standard_normal(rate_dps.shape)
        return (1 - self.k) * (rate_dps @ (np.eye(3) + self.skew).T) - self.b_dps + noise

    def states(self) -> dict[str, tuple[float, float]]:
        """Return k and b (deg/s) by name of the gyro."""
        return {name: (float(self.k[i]), float(self.b_dps[i])) for i, name in enumerate("xyz")}


def walk(random: np.random.Generator, n: int, hz: float, dps_rts: float) -> Floats:
    """Return a random walk (n, 3) of so many deg/s per root second."""
    return np.cumsum(random.standard_normal((n, 3)), axis=0) * dps_rts / np.sqrt(hz)


def quaternions(attitude: Rotation) -> Floats:
    """Return w x y z (n, 4)."""
    return np.roll(attitude.as_quat(), 1, axis=1)
