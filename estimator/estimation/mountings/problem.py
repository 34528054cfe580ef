"""The states of one device, from what several runs in different mountings show of them.

A run gives the states of each sensor in the frame in which the table turned the device: those of the device, turned by
the error of its mounting, with the biases that it had then. All are estimated together: the states of the device; for
each run a small rotation and a change of each bias; for each place an error of gravity, which its runs have in common.
How much biases change from run to run is found from the runs.

States are x = [k, b, s_j, s_k] (``estimator.geometry.model``), in which the sensitivity of a sensor is linear.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import accumulate

import numpy as np

from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.sensors.gyros import GYRO
from estimator.sensors.kind import SensorKind
from estimator.types import Floats

_CHANGES = np.logspace(-6, 0, 13)
"""Sizes of the changes of biases to choose among, of what the data sheet expects of a bias."""
_SEEN = 10.0
"""Information of a run about a combination of states, in that of the prior, below which it counts for nothing.

Covariances hold more than the estimate was weighted with, such as doubt about the noise. Where the prior has a part in
an estimate, it could then not be taken out of it.
"""
_STEP = 1e-4  # of derivatives, in standard deviations of the prior
_MOST_STEPS = 20
_SETTLED = 1e-3  # of a standard deviation


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class DeviceSensor:
    """A sensor of the device: nominal axes (3,) in the device's frame, and the prior of its states x (4,)."""

    kind: SensorKind
    source: str
    name: str
    p: Floats
    j: Floats
    k: Floats
    prior_sd: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class RunStates:
    """What a run shows of some sensors of the device, without the prior.

    ``sensors`` are their numbers. ``information`` (4 s, 4 s) and ``vector`` (4 s,) are the information matrix of the
    states x and that times the states, both in standard deviations of the prior. ``count`` is the number of
    combinations of states that the run shows. ``mounting_sd_rad`` is what is expected of the mounting error.
    ``place`` is the number of the place, whose gravity the run has.
    """

    sensors: tuple[int, ...]
    information: Floats
    vector: Floats
    count: int
    mounting_sd_rad: float
    place: int = 0


def run_states(
    sensors: Sequence[int], x: Floats, covariance: Floats, prior_sd: Floats, mounting_sd_rad: float, *, place: int = 0
) -> RunStates:
    """Return what a run shows of the s ``sensors``, numbers in the device.

    ``x`` (4 s,) and ``covariance`` (4 s, 4 s) are its estimate under independent priors ``prior_sd`` (4 s,).
    Combinations of states that the run hardly shows are left out. ``mounting_sd_rad`` is the uncertainty of its
    mounting, ``place`` the number of the place where it was made.
    """
    scaled = covariance / np.outer(prior_sd, prior_sd)
    variance, directions = np.linalg.eigh(0.5 * (scaled + scaled.T))
    precision = 1 / np.maximum(variance, 1e-18)
    seen = precision > 1 + _SEEN
    gained = np.where(seen, precision - 1, 0.0)
    mean = directions.T @ (x / prior_sd)
    return RunStates(
        sensors=tuple(sensors),
        information=(directions * gained) @ directions.T,
        vector=directions @ np.where(seen, precision * mean, 0.0),
        count=int(seen.sum()),
        mounting_sd_rad=mounting_sd_rad,
        place=place,
    )


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class JoinedStates:
    """The states of the device in the frame of its gyros, in which these have no misalignment in common.

    ``states`` (s, 4) are decoded, ``covariance`` (4 s, 4 s) is theirs, ``lines`` are its parts by name.
    ``mounting_rad`` (r, 3) are the mounting errors of the runs about the device's axes, with ``mounting_sd_rad``.
    ``bias_change`` are the expected changes of biases by kind, in units of what the data sheet expects of a bias.
    ``misfit`` is the sum of squares that the runs leave, of which ``misfit_count`` are expected.
    """

    states: Floats
    covariance: Floats
    lines: dict[str, Floats]
    mounting_rad: Floats
    mounting_sd_rad: Floats
    bias_change: dict[SensorKind, float]
    misfit: float
    misfit_count: int


def join(sensors: Sequence[DeviceSensor], runs: Sequence[RunStates], gravity_sd: Sequence[float]) -> JoinedStates:
    """Return the states of a device that all runs together show.

    ``gravity_sd`` are the relative standard uncertainties of gravity, by place.
    """
    return _Problem(sensors, runs, gravity_sd).solved()


@dataclass(eq=False)
class _Problem:
    """Parameters u in units of their priors: states (4 s), rotations (3 r), changes of biases (r s), gravities."""

    sensors: Sequence[DeviceSensor]
    runs: Sequence[RunStates]
    gravity_sd: Sequence[float]

    def __post_init__(self) -> None:
        self.p = np.array([one.p for one in self.sensors])
        self.j = np.array([one.j for one in self.sensors])
        self.k = np.array([one.k for one in self.sensors])
        self.prior_sd = np.array([one.prior_sd for one in self.sensors])
        self.felt = np.array([one.kind is ACCELEROMETER for one in self.sensors])

    @cached_property
    def edges(self) -> list[int]:
        """Where states, rotations, changes of biases and gravity begin, and where they end."""
        count, runs = len(self.sensors), len(self.runs)
        return list(accumulate([0, 4 * count, 3 * runs, runs * count, len(self.gravity_sd)]))

    def predicted(self, u: Floats, number: int) -> Floats:
        """Return the states x (4 s,) of the sensors of run ``number``, in standard deviations of their prior.

        They are those of the device turned by the run's mounting, with the biases of the run, and for accelerometers
        the gravity of its place.
        """
        run = self.runs[number]
        of_run = list(run.sensors)
        x = u[: self.edges[1]].reshape(-1, 4) * self.prior_sd
        turn = _rotation(u[self.edges[1] :][3 * number : 3 * number + 3] * run.mounting_sd_rad)
        rows = self.rows(x) @ turn.T
        rows[self.felt] *= 1 + u[self.edges[3] + run.place] * self.gravity_sd[run.place]
        changes = u[self.edges[2] : self.edges[3]].reshape(len(self.runs), -1)[number]
        bias = x[:, 1] + changes * self.prior_sd[:, 1]
        return np.asarray((self.encoded(rows, bias) / self.prior_sd)[of_run].ravel())

    def rows(self, x: Floats) -> Floats:
        """Return the sensitivities (s, 3) along the axes of the device, of states x (s, 4)."""
        return np.asarray((1 - x[:, :1]) * self.p - x[:, 3:] * self.j + x[:, 2:3] * self.k)

    def encoded(self, rows: Floats, bias: Floats) -> Floats:
        """Return the states x (s, 4) of sensitivities (s, 3) and biases (s,)."""
        along, across_j, across_k = ((rows * axes).sum(axis=1) for axes in (self.p, self.j, self.k))
        return np.column_stack([1 - along, bias, across_k, -across_j])

    def precision(self, gyros: float, accelerometers: float) -> Floats:
        """Return the prior precision of all parameters, for changes of biases of these sizes."""
        sizes = np.tile(np.where(self.felt, accelerometers, gyros), len(self.runs))
        return np.concatenate([np.ones(self.edges[2]), 1 / sizes**2, np.ones(len(self.gravity_sd))])

    def solved(self) -> JoinedStates:
        """Return the estimate: linearised about itself, and averaged over the sizes of the changes of biases by
        evidence.

        Gyros and accelerometers have sizes of their own if the device has both. It ends after ``_MOST_STEPS`` at the
        latest.
        """
        u = np.zeros(self.edges[-1])
        sizes = [(gyros, forces) for gyros in _CHANGES.tolist() for forces in _CHANGES.tolist()]
        if not self.felt.any() or self.felt.all():
            sizes = [(size, size) for size in _CHANGES.tolist()]
        for _ in range(_MOST_STEPS):
            information, vector = self._linear(u)
            found = [self._estimate(information, vector, self.precision(*size)) for size in sizes]
            logs = np.array([log for log, _, _ in found])
            weights = np.exp(logs - logs.max())
            weights /= weights.sum()
            means = np.array([mean for _, mean, _ in found])
            mean = weights @ means
            spread = means - mean
            covariance = np.einsum("n,nij->ij", weights, np.array([own for _, _, own in found]))
            covariance += np.einsum("n,ni,nj->ij", weights, spread, spread)
            moved = np.abs(mean - u) / np.sqrt(np.diag(covariance))
            u = mean
            if moved.max() < _SETTLED:
                break
        likeliest = int(np.argmax(weights))
        changes = np.sqrt(weights @ np.array(sizes) ** 2).tolist()
        return self._result(u, covariance, means[likeliest], self.precision(*sizes[likeliest]), changes)

    def _linear(self, u: Floats) -> tuple[Floats, Floats]:
        """Return the information (c, c) of all runs about the parameters, and its vector (c,), linearised about u."""
        information = np.zeros((len(u), len(u)))
        vector = np.zeros(len(u))
        for number, run in enumerate(self.runs):
            jacobian = _derivatives(partial(self.predicted, number=number), u)
            weighed = jacobian.T @ run.information
            information += weighed @ jacobian
            at = self.predicted(u, number)
            vector += jacobian.T @ run.vector - weighed @ (at - jacobian @ u)
        return information, vector

    def _estimate(self, information: Floats, vector: Floats, precision: Floats) -> tuple[float, Floats, Floats]:
        """Return the log evidence of a prior, and mean (c,) and covariance (c, c) of the parameters under it.

        ``information`` (c, c) and ``vector`` (c,) are those of the data, ``precision`` (c,) is that of the prior about
        zero.
        """
        scale = 1 / np.sqrt(precision)  # changes of biases that cannot be are as well conditioned as all others
        scaled = information * np.outer(scale, scale) + np.eye(len(scale))
        root = np.linalg.cholesky(scaled)
        inverse = np.linalg.inv(root)
        half = inverse @ (vector * scale)
        log = 0.5 * float(half @ half) - float(np.log(np.diag(root)).sum())
        return log, scale * (inverse.T @ half), inverse.T @ inverse * np.outer(scale, scale)

    def _result(
        self, u: Floats, covariance: Floats, likeliest: Floats, precision: Floats, changes: Sequence[float]
    ) -> JoinedStates:
        """Return the result for the parameters u and their covariance.

        ``likeliest`` are the parameters for the likeliest sizes of the changes of biases, ``precision`` is the prior
        precision under these, and ``changes`` are the mean sizes of gyros and of accelerometers.
        """
        jacobian = _derivatives(self.output, u)
        output = self.output(u)
        count = len(self.sensors)
        of_states = jacobian[: 4 * count]
        of_mountings = jacobian[4 * count :]
        whole = of_states @ covariance @ of_states.T
        _, edge, change, gravity, end = self.edges
        through = of_states @ covariance
        lines = {
            name: (through[:, first:last] * precision[first:last]) @ through[:, first:last].T
            for name, first, last in (("mounting", edge, change), ("gravity", gravity, end))
        }
        lines["runs"] = whole - lines["mounting"] - lines["gravity"]
        mounting_variance = np.diag(of_mountings @ covariance @ of_mountings.T).reshape(-1, 3)
        return JoinedStates(
            states=output[: 4 * count].reshape(-1, 4),
            covariance=whole,
            lines=lines,
            mounting_rad=output[4 * count :].reshape(-1, 3),
            mounting_sd_rad=np.sqrt(mounting_variance),
            bias_change={GYRO: changes[0], ACCELEROMETER: changes[1]},
            misfit=self._misfit(likeliest, precision),
            misfit_count=sum(run.count for run in self.runs),
        )

    def output(self, u: Floats) -> Floats:
        """Return the decoded states (4 s,) in the frame of the gyros, and the mounting errors (3 r,) from it."""
        x = u[: self.edges[1]].reshape(-1, 4) * self.prior_sd
        rows = self.rows(x)
        frame = self._frame(rows)
        turned = self.encoded(rows @ frame.T, x[:, 1])
        gain = 1 - turned[:, :1]
        states = np.hstack([turned[:, :2], turned[:, 2:] / gain])
        parts = [states.ravel()]
        for number, run in enumerate(self.runs):
            own = _rotation(u[self.edges[1] :][3 * number : 3 * number + 3] * run.mounting_sd_rad)
            parts.append(_rotation_vector(own @ frame.T))
        return np.concatenate(parts)

    def _frame(self, rows: Floats) -> Floats:
        """Return the rotation (3, 3) of sensitivities after which the gyros have the least misalignments.

        ``rows`` (s, 3) are the sensitivities of all sensors. Without gyros the rotation is that of the accelerometers.
        """
        framing = ~self.felt if not self.felt.all() else self.felt
        frame = np.eye(3)
        for _ in range(_MOST_STEPS):
            at = (rows @ frame.T)[framing]
            across = np.vstack([self.j[framing], self.k[framing]])
            both = np.vstack([at, at])
            # (rho x g) . j = rho . (g x j)
            step = np.linalg.lstsq(np.cross(both, across), -(both * across).sum(axis=1), rcond=1e-9)[0]
            frame = _rotation(step) @ frame
            if np.abs(step).max() < 1e-13:
                break
        return frame

    def _misfit(self, u: Floats, precision: Floats) -> float:
        """Return the sum of squares that runs and priors leave at the parameters u."""
        total = float(precision @ u**2)
        for number, run in enumerate(self.runs):
            # With x the states that the run shows: (x - h)' I (x - h), in which I x is the vector.
            at = self.predicted(u, number)
            shown = np.linalg.lstsq(run.information, run.vector, rcond=1e-14)[0]
            total += float((shown - at) @ run.information @ (shown - at))
        return total


def _rotation(vector_rad: Floats) -> Floats:
    """Return the rotation matrix (3, 3) about a vector (3,) by its length."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(vector_rad).as_matrix())


def _rotation_vector(matrix: Floats) -> Floats:
    """Return the vector (3,) of a rotation."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def _derivatives(function: Callable[[Floats], Floats], at: Floats) -> Floats:
    """Return the derivatives (n, c) of a smooth function by its parameters (c,)."""
    steps = np.eye(len(at)) * _STEP
    return np.column_stack([(function(at + step) - function(at - step)) / (2 * _STEP) for step in steps])
