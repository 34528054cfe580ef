"""Noise of sensors at rest: any named series of samples with a rate and a unit, and those of a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.errors import RecordingError
from estimator.geometry.noise import NoiseModel
from estimator.observations.allan.deviation import AllanCurve, curves, overlapping_deviation
from estimator.observations.allan.terms import NoiseTerms, fewest_samples, mean_width, noise_terms
from estimator.packaged import sentence
from estimator.types import Floats, Stamps

RATE, FORCE = "rad/s", "m/s2"
"""Units of what gyros and accelerometers put out."""
_LONGEST_GAP_S = 1.0  # a longer one ends a stretch
_GAP_STEPS = 1.5  # larger distances, in sampling periods, mean missing samples
_SILENT = 0.5  # share of numbers up to which a sensor is left out, not the rows without its numbers
_MOST_MISSING = 0.05  # of a stretch: with more, averaging times are no longer right


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Evenly sampled outputs of sensors at rest: separate stretches (n, m).

    ``names`` (m,) are those of the sensors, ``unit`` that of the samples in SI. ``missing`` samples were skipped, so
    that their neighbours count as adjacent. ``silent`` sensors give no numbers, and are not among the names.
    """

    names: tuple[str, ...]
    unit: str
    period_s: float
    stretches: tuple[Floats, ...]
    missing: int = 0
    silent: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        unit: str,
        t_ns: Stamps,
        values: Floats,
        spans_ns: Sequence[tuple[int, int]],
    ) -> "Series":
        """Return the series of outputs (n, m) of sensors ``names`` at instants (n,) within spans of rest (first, last).

        Instants ascend; ``unit`` is that of ``values``. A gap of more than a second ends a stretch, shorter ones are
        skipped. Rows that are not finite count as missing; sensors that are hardly ever finite are listed as silent.
        RecordingError if all are silent, the samples have no rate, or more than a twentieth is missing.
        """
        speaks = np.isfinite(values).mean(axis=0) > _SILENT
        silent = tuple(name for name, speaking in zip(names, speaks, strict=True) if not speaking)
        names = [name for name in names if name not in silent]
        values = values[:, speaks]
        good = np.isfinite(values).all(axis=1)
        t_ns, values = t_ns[good], values[good]
        steps_ns = np.diff(t_ns)
        if not names:
            raise RecordingError(sentence("allan.silent", names=", ".join(silent)))
        if len(steps_ns) < 2 or float(np.median(steps_ns)) <= 0:
            raise RecordingError(sentence("allan.no_rate", names=", ".join(names)))
        regular = steps_ns <= _GAP_STEPS * np.median(steps_ns)
        period_s = float(np.mean(steps_ns[regular])) * 1e-9
        stretches: list[Floats] = []
        missing = 0
        for first, last in spans_ns:
            rows = slice(*np.searchsorted(t_ns, [first, last + 1]).tolist())
            gaps_s = np.diff(t_ns[rows]) * 1e-9
            ends = np.flatnonzero(gaps_s > max(_LONGEST_GAP_S, _GAP_STEPS * period_s)) + 1
            short = gaps_s[(gaps_s > _GAP_STEPS * period_s) & (gaps_s <= _LONGEST_GAP_S)]
            missing += int(np.sum(np.round(short / period_s) - 1))
            stretches += [part for part in np.split(values[rows], ends) if len(part) > 1]
        total = sum(map(len, stretches))
        if missing > _MOST_MISSING * (total + missing):
            share = missing / (total + missing)
            raise RecordingError(sentence("allan.gaps", names=", ".join(names), share=share))
        return cls(
            names=tuple(names),
            unit=unit,
            period_s=period_s,
            stretches=tuple(stretches),
            missing=missing,
            silent=silent,
        )

    @property
    def span_s(self) -> float:
        """Length of all stretches."""
        return sum(map(len, self.stretches)) * self.period_s

    @property
    def longest_s(self) -> float:
        """Length of the longest stretch, which bounds the averaging times."""
        return max(map(len, self.stretches), default=0) * self.period_s

    @property
    def long_enough(self) -> bool:
        """Whether a stretch is long enough for N, B and K."""
        return max(map(len, self.stretches), default=0) >= fewest_samples(self.period_s)

    @property
    def constant(self) -> tuple[str, ...]:
        """Sensors whose output does not change."""
        still = [all(np.ptp(part[:, i]) == 0 for part in self.stretches) for i in range(len(self.names))]
        return tuple(name for name, is_still in zip(self.names, still, strict=True) if is_still)

    def means(self, width: int) -> "Series":
        """Return the series of means over ``width`` samples; incomplete ones at the ends of stretches are dropped.

        A stretch without a complete mean is left out. The same object for a width of 1.
        """
        if width == 1:
            return self
        counts = [len(part) // width for part in self.stretches]
        stretches = tuple(
            part[: count * width].reshape(count, width, -1).mean(axis=1)
            for part, count in zip(self.stretches, counts, strict=True)
            if count
        )
        return replace(self, period_s=self.period_s * width, stretches=stretches)

    def only(self, names: Sequence[str]) -> "Series":
        """Return the series of some of the sensors."""
        columns = [self.names.index(name) for name in names]
        stretches = tuple(part[:, columns] for part in self.stretches)
        return replace(self, names=tuple(names), stretches=stretches)


@dataclass(frozen=True, slots=True, eq=False)
class SensorNoise:
    """Noise of one sensor over ``span_s`` of rest: Allan deviation, and N, B and K with their intervals, SI.

    ``longest_s`` is the longest rest without a gap.
    """

    name: str
    unit: str
    span_s: float
    longest_s: float
    curve: AllanCurve
    terms: NoiseTerms

    @property
    def model(self) -> NoiseModel:
        """The likeliest N, B and K as the noise model of a gyro."""
        return NoiseModel(*self.terms.values.tolist())


def usable(series: Series) -> tuple[Series | None, list[str]]:
    """Return the series with the sensors whose noise can be determined, None if there is none, and notes.

    Left out are constant outputs, or all sensors if no stretch is long enough. Notes are also on silent sensors and
    missing samples.
    """
    names = ", ".join(series.names)
    notes: list[str] = []
    if series.silent:
        notes.append(sentence("allan.silent", names=", ".join(series.silent)))
    if not series.long_enough:
        least_s = fewest_samples(series.period_s) * series.period_s
        notes.append(sentence("allan.short", names=names, longest_s=series.longest_s, least_s=least_s))
        return None, notes
    if series.missing:
        notes.append(sentence("allan.missing", names=names, count=series.missing))
    constant = series.constant
    if constant:
        notes.append(sentence("allan.constant", names=", ".join(constant)))
        series = series.only([name for name in series.names if name not in constant])
    return (series if series.names else None), notes


def sensor_noise(series: Series, per_decade: int = 5, *, coarse: bool = False) -> list[SensorNoise]:
    """Return the noise of each sensor of a series; ValueError if it is too short, or an output is constant.

    The Allan deviation starts at one sample, with ``coarse`` at the means used for N, B and K, which is faster.
    """
    if not series.long_enough or series.constant:
        raise ValueError("a series that is too short, or does not change")
    terms = noise_terms(series.stretches, series.period_s)
    if coarse:
        series = series.means(mean_width(series.period_s))
    tau_s, deviation = overlapping_deviation(series.stretches, series.period_s, per_decade)
    sizes = np.array([own.values for own in terms])
    found = curves(tau_s, deviation, list(map(len, series.stretches)), series.period_s, sizes)
    return [
        SensorNoise(
            name=name,
            unit=series.unit,
            span_s=series.span_s,
            longest_s=series.longest_s,
            curve=curve,
            terms=own,
        )
        for name, curve, own in zip(series.names, found, terms, strict=True)
    ]
