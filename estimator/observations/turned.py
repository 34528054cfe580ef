"""How far a body has turned, and the integral of its gyros, over the same intervals.

Another instrument's readings come at other instants than samples. Compared are the integral of the output over an
interval and the turn in the same interval; for an encoder that is a difference of angles, whose noise does not grow
with the rate of sampling. A delay between the two is a look at the same turn earlier.
"""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from estimator.geometry.kinematics import AXES, Site, into_body
from estimator.recordings.reference import Reference
from estimator.types import Floats

REST_RPS = 2e-3
"""Several times Earth rate: what turns no faster rests."""
_GAP_STEPS, _GAP_S = 3.5, 0.15  # between readings further apart than both, the motion is unknown
_BOX, _BOXES = 9, 3  # steps of the finer grid in a mean over two periods, and how often one is taken
_UNEVEN = 0.5  # of the usual step: the slope of a shorter one is inaccurate
_AT_ONCE_S = 1e-6  # instants nearer than this are one
_SLOPE_S = 0.02  # to each side of an instant, over which a turn gives its rate; never less than one reading


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """Integrals (k, c) of rates at increasing instants ``t_s`` (k,); ``gaps`` (k,) counts unknown intervals.

    Between instants they are linear, or given on a finer even grid ``smooth``: start, step, and integrals (f, c), each
    an average over ``reach_s`` to each side.
    """

    t_s: Floats
    integral: Floats
    gaps: Floats
    smooth: tuple[float, float, Floats] | None = None
    reach_s: float = 0.0

    @classmethod
    def of_increments(cls, t_s: Floats, increments: Floats, longest_s: float | None = None) -> Self:
        """Return the integral, at instants (k,), of ``increments`` (k - 1, c) from each instant to the next.

        An interval is unknown if any of its increments is not finite, or it is longer than ``longest_s``: by default
        3.5 median steps, but at least 0.15 s. Unknown ones add 0 to the integral and count as gaps.
        """
        unknown = np.asarray(~np.isfinite(increments).all(axis=1), dtype=np.bool_)
        steps = np.diff(t_s)
        if len(steps):
            unknown |= steps > (longest_s or max(_GAP_STEPS * float(np.median(steps)), _GAP_S))
        summed = np.cumsum(np.where(unknown[:, None], 0.0, increments), axis=0)
        zero = np.zeros((1, increments.shape[1]))
        return cls(t_s, np.vstack([zero, summed]), np.concatenate([[0.0], np.cumsum(unknown)]))

    @classmethod
    def of_rates(cls, t_ns: NDArray[np.int64], rate_rps: Floats, longest_s: float | None = None) -> Self:
        """Return the integral of sampled rates (k, c), by cubics; intervals beside NaN, or too long ones, are unknown.

        ``longest_s`` is as for ``of_increments``. Samples are put in order of time; of several at one instant the first
        counts.
        """
        order = np.argsort(t_ns, kind="stable")
        order = order[np.concatenate([[True], np.diff(t_ns[order]) > 0])]
        t_s, rate = np.asarray(t_ns[order] * 1e-9, dtype=np.float64), rate_rps[order]
        step_s = np.diff(t_s)[:, None]
        bend = np.diff(np.gradient(rate, t_s, axis=0), axis=0) if len(t_s) > 2 else 0.0  # error of trapezoids
        bend = np.where(np.isfinite(bend), bend, 0.0)
        return cls.of_increments(t_s, 0.5 * (rate[1:] + rate[:-1]) * step_s - bend * step_s**2 / 12, longest_s)

    @classmethod
    def of_reference(cls, reference: Reference, site: Site | None) -> Self:
        """Return how far the body turned, in rad about its three axes, from a reference with k instants.

        The reference is an attitude, rates, or a table, of which only the first axis counts: it must have a single one.
        Earth rate is added to the turn of a table if ``site`` is known; rates and attitudes are taken as they are. Lost
        attitudes or rates and long gaps are unknown, except that gaps between rates that are all below ``REST_RPS`` are
        rests. AssertionError for turns and poses, which give no motion at all instants.
        """
        attitude = reference.attitude
        rates = reference.external_rates()
        table = reference.table
        if attitude is not None and rates is not None:
            t_s = np.asarray(attitude.t_ns * 1e-9, dtype=np.float64)
            return cls.of_increments(t_s, rates.rate_rps * np.diff(t_s)[:, None])
        if rates is not None:
            still = np.nan_to_num(np.abs(rates.rate_rps)).max(initial=0.0) < REST_RPS
            return cls.of_rates(rates.t_ns, rates.rate_rps, np.inf if still else None)  # rests are stated whole
        assert table is not None, "turns and poses give no motion at all instants"
        t_s = np.asarray(table.t_ns * 1e-9, dtype=np.float64)
        angle = np.unwrap(table.angle_rad[:, 0])
        turn = np.zeros((len(t_s) - 1, 3))
        turn[:, AXES.index(table.gimbals[0])] = np.diff(angle)
        if site is not None:
            middle = 0.5 * (angle[1:] + angle[:-1])
            turn += into_body(site.earth_rate_rps(), middle[:, None], table.gimbals) * np.diff(t_s)[:, None]
        return cls.of_increments(t_s, turn)

    def smoothed(self, period_s: float) -> Self:
        """Return the integrals after three moving averages over two periods each.

        Mean rates within three periods of an end or a gap become unknown. Between two noisy readings linear
        interpolation halves their noise, so that any delay of half a period would seem to fit. Averages over whole
        periods have the same noise everywhere.
        """
        from scipy.interpolate import CubicHermiteSpline
        from scipy.ndimage import uniform_filter1d

        step_s = 2 * period_s / _BOX
        at_s = np.arange(self.t_s[0], self.t_s[-1], step_s)
        slopes = self._slopes()
        columns = list(CubicHermiteSpline(self.t_s, self.integral, slopes)(at_s).T)
        for _ in range(_BOXES):
            columns = [uniform_filter1d(column, _BOX, mode="nearest") for column in columns]
        grid = float(at_s[0]), step_s, np.column_stack(columns)
        return replace(self, smooth=grid, reach_s=_BOXES * period_s)

    def _slopes(self) -> Floats:
        """Return the slopes (k, c) of the integrals, over at least a usual step to each side, as stamps scatter.

        Gaps, where the integrals stand still, are not left out.
        """
        steps_s = np.diff(self.t_s)
        usual_s = float(np.median(steps_s))
        if not len(steps_s) or steps_s.min() > _UNEVEN * usual_s:
            return np.asarray(np.gradient(self.integral, self.t_s, axis=0))
        before = np.maximum(self.t_s - usual_s, self.t_s[0])
        after = np.minimum(self.t_s + usual_s, self.t_s[-1])
        turned = [np.interp(after, self.t_s, c) - np.interp(before, self.t_s, c) for c in self.integral.T]
        return np.asarray(np.column_stack(turned) / (after - before)[:, None])

    def means(self, first_s: Floats, last_s: Floats) -> Floats:
        """Return the mean rates (n, c) from ``first_s`` (n,) to ``last_s`` (n,), NaN where they are not known.

        That is so beyond the ends, over a gap, and where the smoothing reaches into either.
        """
        begin, end = first_s - self.reach_s, last_s + self.reach_s
        known = (begin >= self.t_s[0]) & (end <= self.t_s[-1])
        if self.gaps[-1]:
            known &= self._gaps(end, 1) == self._gaps(begin, -1)
        mean = self._at(last_s) - self._at(first_s)
        mean /= (last_s - first_s)[:, None]
        mean[~known] = np.nan
        return mean

    def known(self, at_s: Floats) -> NDArray[np.bool_]:
        """Return for each instant (n,) whether the motion of the body is known there."""
        inside = (at_s >= self.t_s[0]) & (at_s <= self.t_s[-1])
        return np.asarray(inside & (self._gaps(at_s + _AT_ONCE_S, 1) == self._gaps(at_s - _AT_ONCE_S, -1)))

    def rates(self, at_s: Floats) -> Floats:
        """Return the rates (n, c) at instants (n,), one for each column of the integrals; NaN outside and in gaps.

        A rate is the slope from one reading, or 20 ms if that is longer, before the instant to as much after it, cut
        off at the ends. Of smoothed integrals the rates next to the ends are NaN as well.
        """
        half_s = max(float(np.median(np.diff(self.t_s))), _SLOPE_S)
        inside = (at_s >= self.t_s[0]) & (at_s <= self.t_s[-1])
        rates = np.full((len(at_s), self.integral.shape[1]), np.nan)
        first_s, last_s = np.maximum(at_s - half_s, self.t_s[0]), np.minimum(at_s + half_s, self.t_s[-1])
        rates[inside] = self.means(first_s[inside], last_s[inside])
        return rates

    def _at(self, at_s: Floats) -> Floats:
        """Return the integrals (n, c) at instants, by the smooth grid if there is one; constant beyond both ends."""
        if self.smooth is not None:
            start_s, step_s, values = self.smooth
            place = np.minimum(np.maximum((at_s - start_s) / step_s, 0), len(values) - 1.000001)
            before = place.astype(np.intp)
            share = (place - before)[:, None]
            value = values.take(before, axis=0) * (1 - share)
            value += values.take(before + 1, axis=0) * share
            return value
        return np.column_stack([np.interp(at_s, self.t_s, column) for column in self.integral.T])

    def _gaps(self, at_s: Floats, side: int) -> Floats:
        """Return how many unknown intervals are over (or, ``side`` 1, have begun) at instants."""
        after = np.searchsorted(self.t_s, at_s, side="left" if side > 0 else "right")
        return np.asarray(self.gaps[np.clip(after if side > 0 else after - 1, 0, len(self.gaps) - 1)])
