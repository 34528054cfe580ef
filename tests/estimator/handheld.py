"""Sessions of an IMU that hands lay in many poses, with the truth that they were made of. No code of the estimator."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

G = 9.81
"""Gravity of the sessions, in m/s2."""


@dataclass(frozen=True)
class Truth:
    """Errors of a device: rows of sense axes times scale (3, 3), biases in m/s2; of the gyros in rad/s."""

    accel: Array = field(default_factory=lambda: np.eye(3))
    bias: Array = field(default_factory=lambda: np.zeros(3))
    gyro: Array = field(default_factory=lambda: np.eye(3))
    gyro_bias: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def nine(self) -> Array:
        """Three scales, three biases, three angles between sense axes less a right angle, in rad (xy, xz, yz)."""
        size = np.sqrt((self.accel**2).sum(axis=1))
        x, y, z = self.accel / size[:, None]
        angles = [np.arccos(np.dot(a, b)) - np.pi / 2 for a, b in ((x, y), (x, z), (y, z))]
        return np.concatenate([size, self.bias, angles])


def device(rng: np.random.Generator) -> Truth:
    """Return a MEMS device with errors of usual size."""
    off = rng.normal(0.0, 0.01, (3, 3))
    np.fill_diagonal(off, rng.normal(0.0, 0.01, 3))
    turned = rng.normal(0.0, 0.01, (3, 3))
    np.fill_diagonal(turned, rng.normal(0.0, 0.02, 3))
    return Truth(
        accel=np.eye(3) + off,
        bias=rng.normal(0.0, 0.2, 3),
        gyro=np.eye(3) + turned,
        gyro_bias=rng.normal(0.0, 0.01, 3),
    )


@dataclass(frozen=True)
class Session:
    """What hands do: directions of up (poses, 3), lengths of rests, the noise of the device and their tremor."""

    up: Array
    rate_hz: float = 100.0
    noise: float = 0.03  # m/s2 of one sample
    instability: float = 0.0  # m/s2 from rest to rest
    tremor: float = 0.0  # m/s2
    shortest_s: float = 2.0
    longest_s: float = 5.0
    turn_s: float = 1.5
    gyro_noise: float = 0.003  # rad/s of one sample


@dataclass
class Log:
    """Samples at instants (n,): outputs of accelerometers (n, 3) and gyros (n, 3), and the rests (start, stop)."""

    t_s: Array
    accel: Array
    gyro: Array
    rests: list[tuple[int, int]]

    def write(self, path: Path) -> Path:
        """Write a text log with a heading; return its path."""
        heading = "t,ax,ay,az,gx,gy,gz"
        np.savetxt(path, np.column_stack([self.t_s, self.accel, self.gyro]), "%.9g", ",", header=heading, comments="")
        return path


def general_poses(rng: np.random.Generator, count: int) -> Array:
    """Return directions (count, 3) that are spread over the sphere by a spiral that is turned at random."""
    at = np.arange(count) + 0.5
    z = 1 - 2 * at / count
    phi = np.pi * (1 + 5**0.5) * at + rng.uniform(0, 2 * np.pi)
    flat = np.sqrt(1 - z**2)
    points = np.column_stack([flat * np.cos(phi), flat * np.sin(phi), z])
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return np.asarray(rng.permutation(points) @ q)


SIX = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
"""Up along each axis, both ways."""


def make(rng: np.random.Generator, truth: Truth, session: Session) -> Log:
    """Return the log of a session: a rest in each pose, and a turn by hand from each to the next."""
    f, w, rests = _moved(rng, session)
    return _sensed(rng, truth, session, f, w, rests)


def on_board(
    rng: np.random.Generator, truths: list[Truth], arms_m: Array, session: Session, limit_rps: float
) -> list[Log]:
    """Return the log of each IMU of a board: a session, and 30 s in which hands shake it; arms (m, 3) from a corner.

    Gyros put out no more than ``limit_rps``.
    """
    f, w, rests = _moved(rng, session)
    n = int(30 * session.rate_hz)
    t = np.arange(n) / session.rate_hz
    shake, change, push = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    for axis in range(3):
        for hz in rng.uniform(0.5, 3.0, 3):
            phase, size = rng.uniform(0, 2 * np.pi), rng.uniform(3, 7)
            omega = 2 * np.pi * hz
            shake[:, axis] += size * np.sin(omega * t + phase)
            change[:, axis] += size * omega * np.cos(omega * t + phase)
            push[:, axis] += rng.uniform(2, 6) * np.sin(omega * t + rng.uniform(0, 6))
    logs = []
    step_s = 1 / session.rate_hz
    slopes = np.vstack([np.gradient(w, step_s, axis=0), change])
    rates = np.vstack([w, shake])
    for truth, arm in zip(truths, arms_m, strict=True):
        at_arm = np.vstack([f, push]) + np.cross(slopes, arm) + np.cross(rates, np.cross(rates, arm))
        log = _sensed(rng, truth, session, at_arm, rates, rests)
        logs.append(replace(log, gyro=np.clip(log.gyro, -limit_rps, limit_rps)))
    return logs


def _moved(rng: np.random.Generator, session: Session) -> tuple[Array, Array, list[tuple[int, int]]]:
    """Return specific force and rate (n, 3) in the body, and the rests."""
    step_s = 1 / session.rate_hz
    force, rate, rests = [], [], []
    attitude = _to_up(session.up[0])
    rows = 0
    for number, up in enumerate(session.up):
        rest_rows = int(rng.uniform(session.shortest_s, session.longest_s) * session.rate_hz)
        own = np.tile(attitude @ [0, 0, G], (rest_rows, 1))
        own += session.instability * rng.normal(size=3)
        if session.tremor:
            t = np.arange(rest_rows) * step_s
            for axis in range(3):
                for hz in rng.uniform(6, 11, 4):
                    own[:, axis] += session.tremor * np.sin(2 * np.pi * (hz * t + rng.uniform())) / 2**0.5
        force.append(own)
        rate.append(np.zeros((rest_rows, 3)))
        rests.append((rows, rows + rest_rows))
        rows += rest_rows
        if number + 1 == len(session.up):
            break
        turn_rows = int(session.turn_s * session.rate_hz)
        shape = 1 - np.cos(2 * np.pi * (np.arange(turn_rows) + 0.5) / turn_rows)
        spin = rng.uniform(-0.5, 0.5)
        vector = _turn_to(attitude.T, _about_z(spin) @ _to_up(session.up[number + 1]).T)
        rates = np.outer(shape / shape.sum() / step_s, vector)
        for w in rates:
            half = _rotation(-w * step_s / 2)
            attitude = half @ attitude
            force.append((attitude @ [0, 0, G] + 3 * rng.normal(size=3) * abs(shape.max()) / 4)[None])
            attitude = half @ attitude
        rate.append(rates)
        rows += turn_rows
        del up
    return np.vstack(force), np.vstack(rate), rests


def _sensed(
    rng: np.random.Generator, truth: Truth, session: Session, f: Array, w: Array, rests: list[tuple[int, int]]
) -> Log:
    """Return what a device puts out under specific force and rate (n, 3)."""
    n = len(f)
    accel = f @ truth.accel.T + truth.bias + session.noise * rng.normal(size=(n, 3))
    gyro = w @ truth.gyro.T + truth.gyro_bias + session.gyro_noise * rng.normal(size=(n, 3))
    return Log(np.arange(n) / session.rate_hz, accel, gyro, rests)


def saturated(log: Log, limit: float) -> Log:
    """Return the log of a device that puts out no more than a limit."""
    return replace(log, accel=np.clip(log.accel, -limit, limit))


def bumped(log: Log, rest: int, by: Array) -> Log:
    """Return the log with a push by a hand in the second half of a rest, in m/s2."""
    start, stop = log.rests[rest]
    accel = log.accel.copy()
    accel[(start + stop) // 2 : stop] += by
    return replace(log, accel=accel)


def _rotation(vector: Array) -> Array:
    """Return the rotation by a vector in rad, by Rodrigues' formula."""
    angle = float(np.sqrt(vector @ vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


def _about_z(angle: float) -> Array:
    return _rotation(np.array([0.0, 0.0, angle]))


def _to_up(up: Array) -> Array:
    """Return an attitude, from the level frame to the body, in which the body's direction ``up`` points up."""
    up = up / np.sqrt(up @ up)
    other = np.eye(3)[int(np.argmin(np.abs(up)))]
    x = np.cross(other, up)
    x /= np.sqrt(x @ x)
    return np.column_stack([x, np.cross(up, x), up])


def _turn_to(now: Array, then: Array) -> Array:
    """Return the vector in body axes by which a body turns from one attitude (body to level) to another."""
    r = now.T @ then
    angle = float(np.arccos(np.clip((np.trace(r) - 1) / 2, -1, 1)))
    axis = np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    size = float(np.sqrt(axis @ axis))
    if size < 1e-9:
        return np.zeros(3) if angle < 1 else np.pi * np.linalg.svd(r + np.eye(3))[0][:, 0]
    return np.asarray(axis / size * angle)
