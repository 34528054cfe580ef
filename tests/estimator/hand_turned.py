"""Units turned by hand: against stops, by angles that are known, and from pose to pose, with gravity as the witness.

Written before what is to cope with them. Each function makes a recording of three gyros at 100 Hz from what they truly
did; errors are given by the caller and known to nothing else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.geometry.array import sensor_array
from estimator.geometry.kinematics import EARTH_RATE_RPS, Site
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, Turns

RATE_HZ = 100.0
ARW = np.radians(0.005)  # rad/s/rtHz
G_MPS2 = 9.80665
NAMES = ("x", "y", "z")

Errors = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""What the outputs (n, 3) gain beside the states: of directions up (n, 3), s (n,), body rates (n, 3), degC (n,)."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Three gyros: matrix (3, 3) and bias (3,) of outputs ``matrix @ w - bias``."""

    matrix: np.ndarray
    bias_rps: np.ndarray

    @classmethod
    def of(cls, random: np.random.Generator) -> Unit:
        """Return one with errors of 1 %, half a degree and half a degree per second."""
        matrix = np.eye(3) + np.diag(0.01 * random.standard_normal(3))
        matrix += np.radians(0.5) * random.standard_normal((3, 3)) * (1 - np.eye(3))
        return cls(matrix, np.radians(0.5) * random.standard_normal(3))

    def rate_rps(self, w: np.ndarray, further: np.ndarray | float, random: np.random.Generator) -> np.ndarray:
        """Return what they put out (n, 3), with what they have beside their states."""
        noise = ARW * np.sqrt(RATE_HZ) * random.standard_normal(w.shape)
        return w @ self.matrix.T - self.bias_rps + noise + further

    def states(self) -> np.ndarray:
        """Return k, b, sigma_j, sigma_k of each gyro (3, 4)."""
        array = sensor_array(np.eye(3), names=NAMES)
        k = 1 - np.einsum("ij,ij->i", self.matrix, array.p)
        j, other = (np.einsum("ij,ij->i", self.matrix, axes) / (1 - k) for axes in (array.k, -array.j))
        return np.column_stack([k, self.bias_rps, j, other])


def by_known_angles(
    seed: int,
    errors: Errors | None = None,
    *,
    each: int = 4,
    stop_deg: float = 0.3,
    angles_deg: tuple[float, ...] = (360.0, -360.0),
    seconds: tuple[float, ...] = (2.5, 6.0),
    temperature_c: tuple[float, float] = (25.0, 25.0),
    accelerometer: bool = False,
) -> tuple[Recording, Unit]:
    """Return turns about x, y, z against a stop, ``each`` of every angle and duration, in random order, rests between.

    A hand does not turn evenly; at the stop it is right to ``stop_deg``. The temperature goes there and back. With an
    ``accelerometer`` the axis of each turn is vertical, either end up.
    """
    random = np.random.default_rng([seed, 131])
    unit = Unit.of(random)
    plan = [(axis, angle, s) for axis in range(3) for angle in angles_deg for s in seconds for _ in range(each)]
    rows, ups, spans = [], [], []
    at = 0
    for number in random.permutation(len(plan)):
        axis, angle, length_s = plan[number]
        length_s *= random.uniform(0.8, 1.25)
        up = random.choice([-1.0, 1.0]) * np.eye(3)[axis]
        for turned in (False, True):  # a rest, then the turn
            n = int((length_s if turned else 3.0) * RATE_HZ)
            w = np.zeros((n, 3))
            if turned:
                s = (np.arange(n) + 0.5) / n
                shape = np.sin(np.pi * s) ** 2 * (1 + 0.3 * np.sin(2 * np.pi * (2 * s + random.uniform())))
                true = np.radians(angle) + np.radians(stop_deg) * random.standard_normal()
                w[:, axis] = shape / shape.mean() * true / (n / RATE_HZ)
            rows.append(w)
            ups.append(np.tile(up, (n, 1)))
            vector = np.zeros(3)
            vector[axis] = np.radians(angle) if turned else 0.0
            spans.append((at, at + n - 1, vector, np.radians(stop_deg if turned else 0.02)))
            at += n
    w, up = np.vstack(rows), np.vstack(ups)
    t_s = np.arange(len(w)) / RATE_HZ
    warmth = np.interp(t_s / t_s[-1], [0, 0.5, 1], [*temperature_c, temperature_c[0]])
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    rate = unit.rate_rps(w, errors(up, t_s, w, warmth) if errors else 0.0, random)
    warm = None if temperature_c[0] == temperature_c[1] else warmth
    accel = G_MPS2 * up + 0.02 * random.standard_normal(up.shape) if accelerometer else None
    data = ImuData(sensor_array(np.eye(3), names=NAMES), t_ns, rate, temperature_c=warm, accel_mps2=accel)
    first, last = (t_ns[[span[end] for span in spans]] for end in (0, 1))
    turns = Turns(first, last, np.array([span[2] for span in spans]), np.array([span[3] for span in spans]))
    return Recording({"imu": data}, turns), unit


@dataclass(frozen=True, slots=True)
class Laid:
    """A session of rests with turns by hand between them: outputs at ``t_s``, and what was true."""

    t_s: np.ndarray
    rate_rps: np.ndarray
    accel_mps2: np.ndarray
    unit: Unit
    limits_s: tuple[tuple[float, float], ...]

    def csv(self) -> str:
        """Return it as a log."""
        columns = np.column_stack([self.t_s, np.degrees(self.rate_rps), self.accel_mps2])
        return "t,gx,gy,gz,ax,ay,az\n" + "\n".join(",".join(f"{v:.7g}" for v in row) for row in columns) + "\n"


def from_pose_to_pose(
    seed: int,
    errors: Errors | None = None,
    *,
    poses: int = 30,
    rest_s: float = 6.0,
    accelerometer: float = 1.0,
    turn_s: float = 2.5,
) -> Laid:
    """Return a unit that is laid in random poses by hand (Tedaldi, Pretto, Menegatti 2014).

    ``accelerometer`` scales the errors of the accelerometer: half a per cent, 0.03 m/s2 of bias, 2 mrad between axes;
    the body axes are those of the accelerometer, x along its x, y in the plane of its x and y.
    """
    random = np.random.default_rng([seed, 177])
    unit = Unit.of(random)
    attitude = Rotation.random(random_state=int(random.integers(2**31)))
    w_rows, up_rows, limits = [], [], []
    at = 0
    for number in range(poses):
        n = int(rest_s * random.uniform(0.8, 1.4) * RATE_HZ)
        w_rows.append(np.zeros((n, 3)))
        up_rows.append(np.tile(attitude.inv().apply([0, 0, 1.0]), (n, 1)))
        limits.append((at / RATE_HZ, (at + n - 1) / RATE_HZ))
        at += n
        if number + 1 == poses:
            break
        n = int(turn_s * random.uniform(0.7, 1.6) * RATE_HZ)
        s = (np.arange(n) + 0.5) / n
        axis = random.standard_normal(3)
        axis *= np.radians(random.uniform(60, 170)) / np.linalg.norm(axis)
        wander = np.radians(30) * random.standard_normal((3, 3))
        w = np.sin(np.pi * s)[:, None] ** 2 * 2 * axis * RATE_HZ / n
        for m in range(3):
            w += np.sin(np.pi * s)[:, None] ** 2 * np.sin(2 * np.pi * (m + 1) * s)[:, None] * wander[m]
        ups = []
        for step in w:
            attitude = attitude * Rotation.from_rotvec(step / RATE_HZ)
            ups.append(attitude.inv().apply([0, 0, 1.0]))
        w_rows.append(w)
        up_rows.append(np.array(ups))
        at += n
    w, up = np.vstack(w_rows), np.vstack(up_rows)
    t_s = np.arange(len(w)) / RATE_HZ
    skew = np.tril(2e-3 * random.standard_normal((3, 3)), -1)
    matrix = np.eye(3) + accelerometer * (np.diag(5e-3 * random.standard_normal(3)) + skew)
    accel = G_MPS2 * up @ matrix.T + accelerometer * 0.03 * random.standard_normal(3)
    accel = accel + 0.02 * random.standard_normal(accel.shape)
    rate = unit.rate_rps(w, errors(up, t_s, w, np.full(len(t_s), 25.0)) if errors else 0.0, random)
    return Laid(t_s, rate, accel, unit, tuple(limits))


def fine_rests(
    seed: int, per_g_dph: float, *, latitude_deg: float = 48.0, arw_dps: float = 0.0005, site: bool = False
) -> Recording:
    """Return 12 rests of 20 s of gyros that feel the Earth, in poses and headings that hands gave them.

    Nobody notes the headings; with a ``site`` the latitude is known, and what points up is taken off.
    """
    random = np.random.default_rng([seed, 7])
    latitude, rests, hz = np.radians(latitude_deg), 12, 10.0
    attitudes = Rotation.random(rests, random_state=seed)
    n = int(24 * hz)  # so long at rest, four seconds in the hand
    each = np.arange(rests * n)
    still = each % n < 20 * hz
    up = np.repeat(attitudes.inv().apply([0, 0, 1.0]), n, axis=0)
    earth = attitudes.inv().apply(EARTH_RATE_RPS * np.array([np.cos(latitude), 0.0, np.sin(latitude)]))
    matrix = np.radians(per_g_dph / 3600) * random.standard_normal((3, 3))
    rate = np.repeat(earth, n, axis=0) + np.radians(0.1) * random.standard_normal(3) + up @ matrix.T
    rate += np.radians(arw_dps) * np.sqrt(hz) * random.standard_normal(up.shape)
    rate += np.where(still, 0.0, np.radians(30))[:, None] * np.sin(each[:, None] / hz * [3.0, 4.0, 5.0])
    known = EARTH_RATE_RPS * np.sin(latitude) * up if site else np.zeros(up.shape)
    t_ns = np.round(each * 1e9 / hz).astype(np.int64)
    accel = G_MPS2 * up + 0.01 * random.standard_normal(up.shape)
    data = ImuData(sensor_array(np.eye(3), names=NAMES), t_ns, rate, accel_mps2=accel)
    sure = still & (each % n >= 0.5 * hz) & (each % n < 19.5 * hz)  # an import leaves out where a motion may begin
    reference = RateReadings(t_ns, np.where(sure[:, None], known, np.nan))
    return Recording({"imu": data}, reference, Site(latitude, 0.0) if site else None)
