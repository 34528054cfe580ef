"""Outputs compared with a reference: channels that are dead, stick, end at a limit, or have a dead zone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimator.geometry.kinematics import Site
from estimator.geometry.noise import SD_OF_MEDIAN
from estimator.observations.alignment import Following
from estimator.observations.defects.limits import Limit, limits_of
from estimator.observations.defects.turned_limits import limits_by_turns
from estimator.observations.defects.zones import dead_zone_rps
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import Reference
from estimator.types import Floats, Stamps

_MOST = 60000  # means of neighbouring samples, at most, for a long recording
_GAP_STEPS = 3.5  # usual steps: samples that lie further apart are no neighbours
_DEAD = 0.1  # length of a row of the line, one for a gyro: less does not follow
_ALIVE = 0.5  # that of another gyro, which shows that it is not the reference that is dead
_MOVED = 10.0  # standard deviations of the scatter by which a body must turn for a channel to be called dead
_CHANGED = 8.0  # the same, by which outputs should have changed while one stuck


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceComparison:
    """Mean outputs (n, m) of a source at instants (n,) in s, and their expected values (n, m), NaN where unknown.

    ``scatter_rps`` (m,) is their deviation, one sigma; ``turned_rps`` (m,) the rms of the rate about each sense axis as
    far as it is known. ``slopes`` (m,) are those of all outputs over that rate. ``line`` is how the outputs follow the
    reference, None for turns and rests. ``table``: the reference is a table.
    """

    t_s: Floats
    outputs: Floats
    expected: Floats
    scatter_rps: Floats
    turned_rps: Floats
    slopes: Floats
    line: Following | None
    limits: Sequence[Sequence[Limit]]
    table: bool

    @classmethod
    def of(
        cls, data: ImuData, reference: Reference, site: Site | None, line: Following | None
    ) -> "ReferenceComparison":
        """Return the comparison for a source in order of time; ``line`` is how it follows the reference.

        Without a line the expected outputs are NaN, scatter and slopes infinite, and limits are known only from turns.
        """
        t_s, outputs = _thinned(data)
        m = len(data.array)
        limits: Sequence[Sequence[Limit]]
        if line is None:
            expected = np.full(outputs.shape, np.nan)
            scatter = slopes = np.full(m, np.inf)
            turned_rps = _turned(data, reference)
            limits = [[] for _ in range(m)] if reference.turns is None else limits_by_turns(data, reference.turns)
        else:
            expected = line.expected_rps(t_s)
            left = np.abs(outputs - expected)
            scatter = np.maximum([SD_OF_MEDIAN * _median(own) for own in left.T], 1e-9)
            turned = line.turned.rates(t_s - line.delay_s) @ data.array.p.T
            known = np.isfinite(turned).all(axis=1)
            turned_rps = np.sqrt(np.mean(turned[known] ** 2, axis=0)) if known.any() else np.zeros(m)
            slopes = _slopes(outputs, turned)
            limits = [limits_of(*each) for each in zip(outputs.T, expected.T, scatter.tolist(), strict=True)]
        return cls(
            t_s=t_s,
            outputs=outputs,
            expected=expected,
            scatter_rps=scatter,
            turned_rps=turned_rps,
            slopes=slopes,
            line=line,
            limits=limits,
            table=reference.table is not None,
        )

    def turns(self, gyro: int) -> bool:
        """Return whether a gyro should have sensed rotation, so that a constant output means that it is dead."""
        return bool(self.turned_rps[gyro] > 0)

    def dead(self, gyro: int) -> bool:
        """Return whether an output is independent of the rate while that of another gyro follows it.

        False without a line, or if the body hardly turned about the axis of the gyro.
        """
        if self.line is None:
            return False
        size = np.linalg.norm(self.line.rows[1:], axis=0)
        others = np.delete(size, gyro)
        seen = self.turned_rps[gyro] > _MOVED * self.scatter_rps[gyro] * _DEAD
        lost = size[gyro] < _DEAD and abs(self.slopes[gyro]) < _DEAD
        return bool(lost and seen and (others > _ALIVE).any())

    def dead_zone_rps(self, gyro: int) -> float | None:
        """Return the rate below which an output is exactly zero; None without such a zone."""
        return dead_zone_rps(self.outputs[:, gyro], self.expected[:, gyro])

    def expected_at(self, t_ns: Stamps, gyro: int) -> Floats:
        """Return the expected output (n,) at some instants, NaN where unknown."""
        if self.line is None:
            return np.full(len(t_ns), np.nan)
        return self.line.expected_rps(np.asarray(t_ns * 1e-9, dtype=np.float64))[:, gyro]

    def changed(self, t_ns: Stamps, gyro: int) -> bool | None:
        """Return whether an output should have changed in a span of instants; None if unknown."""
        ought = self.expected_at(t_ns, gyro)
        ought = ought[np.isfinite(ought)]
        if len(ought) < 2:
            return None
        return bool(np.ptp(ought) > _CHANGED * self.scatter_rps[gyro])


def _slopes(outputs: Floats, turned: Floats) -> Floats:
    """Return the slope (m,) of each output (n, m) over the rate about its sense axis (n, m); 0 without rotation.

    Only rows in which both are finite count.
    """
    slopes = np.zeros(outputs.shape[1])
    for gyro, (output, rate) in enumerate(zip(outputs.T, turned.T, strict=True)):
        known = np.isfinite(output) & np.isfinite(rate)
        if not known.any():
            continue
        about = rate[known] - rate[known].mean()
        squares = float(about @ about)
        if squares > 0:
            slopes[gyro] = float(about @ output[known]) / squares
    return slopes


def _median(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else np.inf


def _thinned(data: ImuData) -> tuple[Floats, Floats]:
    """Return instants (n,) in s and outputs (n, m), averaged over neighbours to a limited number of rows.

    Means across a gap, and samples at the end that fill none, are left out. A short recording is not averaged.
    """
    t_s = np.asarray(data.t_ns * 1e-9, dtype=np.float64)
    width = -(-len(t_s) // _MOST)
    if width <= 1:
        return t_s, data.rate_rps
    count = len(t_s) // width
    each_s = t_s[: count * width].reshape(count, width)
    near = np.ptp(each_s, axis=1) < _GAP_STEPS * width * float(np.median(np.diff(t_s)))
    means = data.rate_rps[: count * width].reshape(count, width, -1).mean(axis=1)
    return np.asarray(each_s.mean(axis=1)[near]), np.asarray(means[near])


def _turned(data: ImuData, reference: Reference) -> Floats:
    """Return the rms (m,) of the rate about each sense axis in turns; 0 if unknown.

    For rests with turns by hand it is the largest standard deviation of any output, for all alike.
    """
    if reference.turns is not None:
        return np.asarray(np.sqrt(np.mean((reference.turns.mean_rates_rps @ data.array.p.T) ** 2, axis=0)))
    if reference.poses is not None:  # hands turn about all axes
        spread = np.nanstd(data.rate_rps, axis=0)
        return np.full(len(spread), float(np.nanmax(spread, initial=0.0)))
    return np.zeros(len(data.array))
