"""A device's clock against the host's, from nothing but arrivals.

Arrivals go one way, so a constant delay cannot be seen in them: host time here is true time plus the least delay
that a sample can have. Delays above it are one-sided, as those of a USB poll or a busy host are: a sample comes
late, never early. The earliest arrivals of each second then lie close to the line wanted, closer the sharper the
edge. Delays without an edge (a sum of many small ones, to both sides of their mean) have earliest arrivals that
scatter more than the mean does: then the line keeps its distance from the mean of each second instead.
"""

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from drivers.types import Alignment, Flags, Floats, Stamps

_BUCKET_S = 1.0
_BUCKETS = 120  # two minutes: short against the drift of a quartz that warms up
_FEWEST = 3  # buckets to put a line through; before, the earliest arrival of all counts
_DRIFT_SD = 100e-6  # of common quartzes: the assumed drift until arrivals determine it
_MOST_DRIFT = 0.05  # an oscillator without a quartz
_SLEW = 1e-3  # how fast the line may move: 1 ms a second,
_SETTLE_S, _SETTLE_AT_FIRST_S = 3.0, 0.5  # or as fast as needed to arrive within so many seconds,
_AT_FIRST = 10  # the shorter time in so many buckets,
_SLEW_AT_MOST = 0.02  # but no faster
_SLEW_AT_ONCE = 0.5  # the fastest that lets no time run backwards
_SWITCH = 0.5  # the mean must be known this much better than the earliest to be preferred, and back
_OUTLIER = 4.0  # in standard deviations


@dataclass(slots=True)
class _Bucket:
    """One second of arrivals. Excess (s) is arrival time minus device time."""

    end_s: float
    count: int = 0
    sum_at_s: float = 0.0
    sum_excess: float = 0.0
    sum_squares: float = 0.0
    earliest: tuple[float, float] = (0.0, math.inf)  # device time and excess
    trusted: tuple[float, float] | None = None

    def add(self, at_s: Floats, excess: Floats) -> None:
        self.earliest = min(self.earliest, _earliest(at_s, excess), key=lambda point: point[1])
        self.count += len(excess)
        self.sum_at_s += float(at_s.sum())
        self.sum_excess += float(excess.sum())
        self.sum_squares += float(excess @ excess)

    def trust(self, at_s: Floats, excess: Floats) -> None:
        self.trusted = min(self.trusted or (0.0, math.inf), _earliest(at_s, excess), key=lambda point: point[1])

    @property
    def least(self) -> tuple[float, float]:
        return self.trusted or self.earliest

    @property
    def mean(self) -> tuple[float, float]:
        return self.sum_at_s / self.count, self.sum_excess / self.count

    @property
    def variance(self) -> float:
        return max(self.sum_squares / self.count - (self.sum_excess / self.count) ** 2, 0.0)


def median(values: Floats) -> float:
    """Return the median of values (n,); a tenth of the cost of numpy's, which counts for a few values."""
    ordered = np.sort(values)
    middle = len(ordered) // 2
    return float(ordered[middle]) if len(ordered) % 2 else float(ordered[middle - 1] + ordered[middle]) / 2


def _earliest(at_s: Floats, excess: Floats) -> tuple[float, float]:
    best = int(excess.argmin())
    return float(at_s[best]), float(excess[best])


@dataclass(kw_only=True, frozen=True, slots=True)
class _Line:
    """A straight line fitted to points; ``scatter`` is the standard deviation of a single point about it."""

    at_s: float
    value: float
    slope: float
    sd_value: float
    sd_slope: float
    scatter: float

    def at(self, t_s: float) -> float:
        return self.value + self.slope * (t_s - self.at_s)

    def sd_at(self, t_s: float) -> float:
        return math.hypot(self.sd_value, self.sd_slope * (t_s - self.at_s))


class HostFit:
    """Fitted line from device time (s) to host time (ns), corrected so slowly that times neither jump nor run
    backwards.
    """

    def __init__(self) -> None:
        """Start without data: no line, no alignment, drift limited to ``most_drift``."""
        self.most_drift = _MOST_DRIFT
        """What a drift is never taken to be above."""
        self._origin_ns: int | None = None
        self._seen_s = 0.0  # device time up to which times have been given
        # The line in use: the line wanted, plus the remaining difference to the line before.
        self._at_s, self._value, self._slope = 0.0, 0.0, 0.0
        self._rest, self._rest_from_s, self._rest_lasts_s = 0.0, 0.0, 1.0
        self._drifted, self._drifted_at_s = 0.0, 0.0
        self._started = False
        self._bucket: _Bucket | None = None
        self._buckets: deque[_Bucket] = deque(maxlen=_BUCKETS)
        self._above_mean: float | None = None  # how far the line runs from the mean, where it follows that
        self._fitted: _Line | None = None
        self._known_jitter_s = math.nan  # by the buckets and the line of the last fit
        self._alignment: Alignment | None = None

    @property
    def known(self) -> bool:
        """Whether any arrival has been added."""
        return self._origin_ns is not None

    @property
    def alignment(self) -> Alignment | None:
        """The line in use with its uncertainty; None before three seconds of arrivals.

        One frozen value, put in place whole by ``add``: any thread may read it while another adds.
        """
        return self._alignment

    def _aligned(self, fitted: _Line) -> Alignment:
        """Return the alignment at the newest sample, from the line in use and the uncertainties of ``fitted``.

        The jitter is that of the last fit. Nothing changes.
        """
        return Alignment(
            offset_s=(self._origin_ns or 0) * 1e-9 + self._line(self._seen_s),
            drift_ppm=self._slope * 1e6,
            sd_offset_s=fitted.sd_at(self._seen_s),
            sd_drift_ppm=fitted.sd_slope * 1e6,
            jitter_rms_s=self._known_jitter_s,
        )

    @property
    def _jitter_s(self) -> float:
        # The change by drift within a second is not jitter.
        variance = median(np.array([b.variance for b in self._buckets])) - (self._slope * _BUCKET_S) ** 2 / 12
        return math.sqrt(max(variance, 0.0))

    def add(self, device_s: Floats, arrival_ns: Stamps, trusted: Flags | None = None) -> None:
        """Update the fit with new samples, at least one and in order of time; call it before ``time_ns``.

        ``device_s`` (n,) are device times in s, ``arrival_ns`` (n,) arrival times. Arrivals are gathered in buckets of
        one second. While there are fewer than three buckets, an arrival that is earlier than the line pulls the line
        down at once; after that each finished bucket triggers a new fit. ``trusted`` (n,) marks samples whose device
        time is certain: the earliest arrival of a bucket that has any is taken from these. ``alignment`` is set from
        the first fit on, and each call brings it up to the newest sample.
        """
        excess = self.excess_of(device_s, arrival_ns)
        if not self._started:
            self._started = True
            self._seen_s = self._at_s = self._drifted_at_s = float(device_s[0])
            self._value = float(excess.min())
        newest_s = float(device_s[-1])
        if self._bucket is None:
            self._bucket = _Bucket(float(device_s[0]) + _BUCKET_S)
        self._bucket.add(device_s, excess)
        if trusted is not None and trusted.any():
            self._bucket.trust(device_s[trusted], excess[trusted])
        if len(self._buckets) < _FEWEST:
            at_s, least = self._bucket.least
            if least < self._line(at_s):
                self._aim(at_s, least, 0.0, _SLEW_AT_ONCE)
        if newest_s >= self._bucket.end_s:
            self._buckets.append(self._bucket)
            self._bucket = None
            if len(self._buckets) >= _FEWEST:
                self._fit(newest_s)
        self._seen_s = newest_s
        if self._fitted is not None:
            self._alignment = self._aligned(self._fitted)

    @property
    def drift(self) -> float:
        """Slope of the line in use: s of host time more than device time, a second."""
        return self._slope

    def excess_of(self, device_s: Floats, arrival_ns: Stamps) -> Floats:
        """Return arrival less device time, in s, counted from the first."""
        if self._origin_ns is None:
            self._origin_ns = int(arrival_ns[0]) - round(device_s[0] * 1e9)
        return np.asarray((arrival_ns - self._origin_ns) * 1e-9 - device_s)

    def drifted(self, device_s: Floats) -> Floats:
        """Return how much the excess has grown by drift alone, in s: the line without its changes of level."""
        return self._drifted + self._slope * (device_s - self._drifted_at_s)

    def time_ns(self, device_s: Floats) -> Stamps:
        """Return the host times (n,) in ns of device times (n,) in s, by the line in use."""
        host_ns = np.rint((device_s + self._lines(device_s)) * 1e9)
        return host_ns.astype(np.int64) + (self._origin_ns or 0)

    def lateness_of(self, device_s: Floats, arrival_ns: Stamps) -> Floats:
        """Return how much later than its time each sample came, in s."""
        return self.excess_of(device_s, arrival_ns) - self._lines(device_s)

    def lateness(self, device_s: float, arrival_ns: int) -> float:
        """Return how much later than its time one sample came, in s."""
        return (arrival_ns - (self._origin_ns or 0)) * 1e-9 - device_s - self._line(device_s)

    def _lines(self, device_s: Floats) -> Floats:
        lines = self._value + self._slope * (device_s - self._at_s)
        if self._rest and device_s[0] < self._rest_from_s + self._rest_lasts_s:
            lines += self._rest * np.clip(1 - (device_s - self._rest_from_s) / self._rest_lasts_s, 0.0, 1.0)
        return np.asarray(lines)

    def _line(self, device_s: float) -> float:
        left = min(max(1 - (device_s - self._rest_from_s) / self._rest_lasts_s, 0.0), 1.0)
        return self._value + self._slope * (device_s - self._at_s) + self._rest * left

    def _aim(self, at_s: float, value: float, slope: float, slew: float) -> None:
        """Change over to the line through ``value`` (s) at device time ``at_s`` with ``slope``.

        The value that was given out last is kept, and the difference to the new line is worn down linearly at ``slew``
        (s a second). What the old line had drifted by then is added to ``_drifted``.
        """
        self._drifted += self._slope * (self._seen_s - self._drifted_at_s)
        self._drifted_at_s = self._seen_s
        rest = self._line(self._seen_s) - (value + slope * (self._seen_s - at_s))
        self._at_s, self._value, self._slope = at_s, value, slope
        self._rest, self._rest_from_s, self._rest_lasts_s = rest, self._seen_s, max(abs(rest) / slew, 1e-9)

    def _fit(self, now_s: float) -> None:
        """Fit lines to the earliest and to the mean arrivals of all buckets, and steer the line in use to the better
        one, which is kept in ``_fitted``.

        The line of earliest arrivals, lowered by their scatter, is the default. The mean takes over, at a constant
        distance, once its uncertainty at ``now_s`` (device time of the newest sample) is less than half the other's,
        and gives way again once the other's is less than half of its. The correction is spread over 3 s (0.5 s during
        the first ten buckets), but made at no less than 1 ms/s and no more than 20 ms/s.
        """
        mean = _line_through([b.mean for b in self._buckets], self.most_drift)
        # The earliest of n cannot be trusted to scatter less than jitter / n: polls in step with samples seem to.
        known_to = self._jitter_s / median(np.array([b.count for b in self._buckets]))
        least = _line_through([b.least for b in self._buckets], self.most_drift, known_to)
        sd_least, sd_mean = least.sd_at(now_s), mean.sd_at(now_s)
        if self._above_mean is None and sd_mean < _SWITCH * sd_least:
            self._above_mean = least.at(now_s) - least.scatter - mean.at(now_s)
        elif self._above_mean is not None and sd_least < _SWITCH * sd_mean:
            self._above_mean = None
        if self._above_mean is None:
            # The earliest of many lies above the least delay by as much as it scatters (an exponential spacing).
            self._fitted, wanted = least, least.at(now_s) - least.scatter
        else:
            self._fitted, wanted = mean, mean.at(now_s) + self._above_mean
        settle_s = _SETTLE_S if len(self._buckets) > _AT_FIRST else _SETTLE_AT_FIRST_S
        slew = abs(self._line(now_s) - wanted) / settle_s
        self._aim(now_s, wanted, self._fitted.slope, min(max(slew, _SLEW), _SLEW_AT_MOST))
        self._known_jitter_s = self._jitter_s


def _line_through(points: list[tuple[float, float]], most_drift: float, known_to: float = 0.0) -> _Line:
    """Fit a line robustly through ``points`` (t, y), at least two in order of time, some of which may lie far off.

    Starts from the median slope of well separated pairs (Theil-Sen), then three rounds of least squares without
    outliers, with a prior of zero on the slope and its size limited to ``most_drift``. ``known_to`` is a lower limit
    for the standard deviation of one point, from which those of value and slope follow. The line has its value at the
    mean time of the points that are no outliers.
    """
    t, y = np.array(points).T
    half = (len(t) + 1) // 2
    slope = median((y[half:] - y[: len(y) - half]) / (t[half:] - t[: len(t) - half]))
    slope = min(max(slope, -most_drift), most_drift)
    residual = y - slope * t
    residual -= median(residual)
    for _ in range(3):
        size = np.abs(residual)
        kept = size <= _OUTLIER * (1.4826 * median(size) + 1e-9)
        t_kept, y_kept, residual = t[kept], y[kept], residual[kept]
        count = len(t_kept)
        variance = float(residual @ residual) / count + 1e-18
        middle, level = float(t_kept.sum()) / count, float(y_kept.sum()) / count
        about = t_kept - middle
        stiffness = float(about @ about) + variance / _DRIFT_SD**2
        slope = float(about @ (y_kept - level)) / stiffness
        slope = min(max(slope, -most_drift), most_drift)
        residual = y - level - slope * (t - middle)
    residual = residual[kept]
    scatter = math.sqrt(float(residual @ residual) / max(count - 2, 1))
    sd = max(scatter, known_to)
    return _Line(
        at_s=middle,
        value=level,
        slope=slope,
        sd_value=sd / math.sqrt(count),
        sd_slope=sd / math.sqrt(stiffness),
        scatter=scatter,
    )
