"""Tones: vibrations and aliases of unknown frequency, searched for in the samples themselves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from estimator.effects.disturbances import TONE
from estimator.estimation.evidence import SCALES, log_mean
from estimator.estimation.runs.run import Run
from estimator.estimation.runs.samples import Samples
from estimator.tracing.tones.peaks import highest
from estimator.types import Floats

Waves = NDArray[np.complex128]

_LOWEST_HZ = 0.05  # below it a tone is distinguished from slow effects by these, not by its line
_LOWEST_BY_HAND_HZ = 5.0  # below it hands move the body, and an error of the reference shows
_FLOOR_BINS = 60  # the noise about a line is the median over so many frequencies to each side
_STEPS = 12
_WORTH = 0.3
_FEWEST_CYCLES = 20
_PARTS = 4
_GAP_S = 1.0  # between samples: means of both sides are not those of one piece
_CYCLES_A_PIECE = 3.0  # fewer within a piece without a gap are no line, but changes of the bias from piece to piece
_FEWEST = 256
_RAMP = 0.02  # share of the steepest acceleration
_COHERENT = 0.75  # least share of the power of single parts of a run that a tone shows with one phase for all


@dataclass(frozen=True, slots=True, eq=False)
class ToneFound:
    """A line: its frequency, whether its phase is the same in all runs, and its log evidence.

    ``log_evidence`` is relative to no tone, less the cost of the search over frequencies.
    """

    frequency_hz: float
    locked: bool
    log_evidence: float


def find_tone(runs: Sequence[Run], samples: Sequence[Samples], predicted: Sequence[Floats]) -> ToneFound | None:
    """Return the strongest line in the samples of all runs beside a model, None if there is none.

    ``predicted`` (b, m) is what the model gives for the blocks of each run. Samples on ramps and slow lines, of less
    than some cycles, are left out. The line is locked (one phase for all runs) or not, whichever is more probable. None
    as well beside a reference of another instrument, with too few samples, with sources of different rates, if chance
    may give such a line, or if it does not last through the runs.
    """
    if any(run.by_another for run in runs):
        return None  # the reference moves with the body: a line in their difference may be of either
    samples = [_steady_samples(run, s) for run, s in zip(runs, samples, strict=True)]
    if min(len(s.t_s) for s in samples) < _FEWEST:
        return None
    rests = [_less_prediction(run, s, p) for run, s, p in zip(runs, samples, predicted, strict=True)]
    even = [_evened(s.t_s, rest) for s, rest in zip(samples, rests, strict=True)]
    longest = max((len(values) for values, _ in even), default=0)
    period_s = min(period for _, period in even)
    size = 2 << int(np.ceil(np.log2(longest)))
    hz = np.fft.rfftfreq(size, period_s)
    total = np.zeros(len(hz))
    floors: list[Floats] = []
    for (values, period), rest in zip(even, rests, strict=True):
        if abs(period / period_s - 1) > 1e-3:
            return None  # sources of different rates: each would need its own grid of frequencies
        power = np.abs(np.fft.rfft(values, size, axis=0)) ** 2 / len(rest)  # of the samples that there are
        floor = _noise_floor(power)
        floors.append(floor)
        total += (power / floor).sum(axis=1)
    span_s = longest * period_s
    lowest_hz = _LOWEST_HZ if all(run.grid.gimbals for run in runs) else _LOWEST_BY_HAND_HZ
    lowest_hz = max(lowest_hz, *(_CYCLES_A_PIECE / _piece_s(s) for s in samples))
    usable = (hz > max(lowest_hz, _FEWEST_CYCLES / span_s)) & (hz < 0.98 * hz[-1])
    if not usable.any():
        return None
    peak = int(np.flatnonzero(usable)[np.argmax(total[usable])])
    from scipy.special import gammaincc  # of a gamma distribution; scipy.stats takes a second to import

    amplitudes = sum(len(s.names) for s in samples)
    if float(gammaincc(amplitudes, total[peak])) * usable.sum() > _WORTH:
        return None  # chance alone gives such a line: the next steps cost more than the search for it
    width = 1 / span_s
    variances = [floor[peak] for floor in floors]

    @cache  # both kinds of tone are first computed at the same frequencies
    def turning(frequency_hz: float) -> list[Waves]:
        return _turning(frequency_hz, samples, rests)

    best: ToneFound | None = None
    tries = float(np.log(usable.sum() / 2))
    for locked in (True, False):
        gain = partial(_gain_at, turning=turning, samples=samples, variances=variances, locked=locked)
        frequency = _peak(gain, hz[peak] - width, hz[peak] + width)
        _, squares, information = gain(frequency)
        value = _log_evidence(np.array(squares), np.array(information)) - tries - (0.0 if locked else 1.0)
        if best is None or value > best.log_evidence:
            best = ToneFound(frequency, locked, value)
    if best is None or not _coherent(best, samples, rests, variances):
        return None
    return best


def _coherent(
    found: ToneFound, samples: Sequence[Samples], rests: Sequence[Floats], variances: Sequence[Floats]
) -> bool:
    """Return whether a tone lasts through each run: one that comes and goes explains more in parts than in the whole.

    Each run is cut into four equal parts, and each part has an amplitude and phase of its own. The tone lasts if it
    explains more than 0.75 of the squares that the parts explain, less what more amplitudes explain by chance. In the
    whole, a locked tone has one amplitude and phase per gyro for all runs, another one per gyro and run. ``rests`` has
    the residuals (n, m) of the n samples of m gyros of each run, ``variances`` the variances (m,) of their noise.
    """
    parts, part_rests, part_variances = [], [], []
    for s, rest, variance in zip(samples, rests, variances, strict=True):
        edges = np.linspace(0, len(s.t_s), _PARTS + 1).astype(int)
        for a, b in pairwise(edges.tolist()):
            parts.append(Samples(s.t_s[a:b], s.z_rps[a:b], s.names))
            part_rests.append(rest[a:b])
            part_variances.append(variance)
    whole, squares, _ = _tone_gain(_turning(found.frequency_hz, samples, rests), samples, variances, found.locked)
    apart, more, _ = _tone_gain(_turning(found.frequency_hz, parts, part_rests), parts, part_variances, False)
    chance = float(len(more) - len(squares))  # half the squares of chance: one for each pair of amplitudes
    return whole > _COHERENT * (apart - chance)


@dataclass(frozen=True, slots=True, eq=False)
class ToneFit:
    """A tone fitted to samples: by gyro cosine and sine (2,), or of each run (2 runs,) if not locked; in rad/s.

    ``sd`` is the standard deviation of each of these numbers.
    """

    found: ToneFound
    amplitude: dict[str, Floats]
    sd: dict[str, float]

    def at(self, name: str, run: int) -> Floats:
        """Return cosine and sine (2,) of a gyro in a run; zero in a run whose phase is not known."""
        if self.found.locked:
            return self.amplitude[name]
        known = self.amplitude[name]
        return known[2 * run : 2 * run + 2] if 2 * run < len(known) else np.zeros(2)


def fit_tone(found: ToneFound, runs: Sequence[Run], samples: Sequence[Samples], predicted: Sequence[Floats]) -> ToneFit:
    """Return the tone with the amplitudes that fit samples best beside a model.

    ``predicted`` (b, m) is what the model gives for the blocks of each run. A locked tone has one amplitude for all
    runs, another one for each. The standard deviations assume white noise.
    """
    names = list(dict.fromkeys(name for s in samples for name in s.names))
    width = 1 if found.locked else len(samples)
    total = {name: np.zeros(width, dtype=np.complex128) for name in names}
    count = {name: np.zeros(width) for name in names}
    squares = dict.fromkeys(names, 0.0)
    for number, (run, s, p) in enumerate(zip(runs, samples, predicted, strict=True)):
        rest = _less_prediction(run, s, p)
        turning = np.exp(-2j * np.pi * found.frequency_hz * s.t_s) @ rest
        at = 0 if found.locked else number
        for i, name in enumerate(s.names):
            total[name][at] += turning[i]
            count[name][at] += len(s.t_s)
            squares[name] += float(np.sum(rest[:, i] ** 2))
    amplitude, sd = {}, {}
    for name in names:
        fitted = 2 * total[name] / np.maximum(count[name], 1)
        amplitude[name] = np.column_stack([fitted.real, -fitted.imag]).ravel()
        # White noise of a sample over the root of half the samples.
        variance = squares[name] / max(float(count[name].sum()), 1.0)
        sd[name] = float(np.sqrt(2 * variance / max(float(count[name].mean()), 1.0)))
    return ToneFit(found, amplitude, sd)


def without_tone(fit: ToneFit, samples: Sequence[Samples]) -> list[Samples]:
    """Return new samples with a tone subtracted, by run; those given stay as they are."""
    cleaned = []
    for number, s in enumerate(samples):
        phase = 2 * np.pi * fit.found.frequency_hz * s.t_s
        waves = np.column_stack([np.cos(phase), np.sin(phase)])
        own = np.column_stack([waves @ fit.at(name, number) for name in s.names])
        cleaned.append(Samples(s.t_s, s.z_rps - own, s.names))
    return cleaned


def _steady_samples(run: Run, samples: Samples) -> Samples:
    """Return the samples of a run in full blocks outside ramps, where block means say enough of each sample.

    Blocks beside a ramp are left out, too. Without a table nothing is a ramp.
    """
    keep = run.weight > 0
    if run.grid.gimbals:
        steep = run.fold(np.abs(run.grid.acceleration_rps2).max(axis=1, keepdims=True))[:, 0]
        ramp = steep > _RAMP * max(float(steep.max()), 1e-9)
        ramp[1:] |= ramp[:-1].copy()
        ramp[:-1] |= ramp[1:].copy()
        keep &= ~ramp
    block = np.clip(np.searchsorted(run.t_s + 0.5 * run.length_s, samples.t_s), 0, len(run.t_s) - 1)
    inside = keep[block] & (np.abs(samples.t_s - run.t_s[block]) <= 0.5 * run.length_s)
    return Samples(samples.t_s[inside], samples.z_rps[inside], samples.names)


def _less_prediction(run: Run, samples: Samples, predicted: Floats) -> Floats:
    """Return the samples (n, m) less what a model gives, and less the mean of each piece without a gap.

    ``predicted`` (b, m) is what it gives for blocks, interpolated between those that are full.
    """
    known = run.weight > 0
    rest = samples.z_rps - np.column_stack([np.interp(samples.t_s, run.t_s[known], c) for c in predicted[known].T])
    pieces = _pieces(samples)
    for a, b in pairwise(pieces):
        rest[a:b] -= rest[a:b].mean(axis=0)
    return np.asarray(rest)


def _pieces(samples: Samples) -> list[int]:
    """Return where pieces of samples without a gap begin, and the end."""
    breaks = np.flatnonzero(np.diff(samples.t_s) > _GAP_S) + 1
    return [0, *breaks.tolist(), len(samples.t_s)]


def _piece_s(samples: Samples) -> float:
    """Return the length of the usual piece of samples without a gap."""
    ends = [(samples.t_s[a], samples.t_s[b - 1]) for a, b in pairwise(_pieces(samples)) if b > a]
    return max(float(np.median([b - a for a, b in ends])), 1e-3)


def _evened(t_s: Floats, values: Floats) -> tuple[Floats, float]:
    """Return values about their mean on an even grid: where samples are missing, zero."""
    period_s = float(np.median(np.diff(t_s)))
    number = np.round((t_s - t_s[0]) / period_s).astype(np.intp)
    out = np.zeros((int(number[-1]) + 1, values.shape[1]))
    out[number] = values - values.mean(axis=0)
    return out, period_s


def _noise_floor(power: Floats) -> Floats:
    """Return the noise power (f, m) about each of f frequencies: the running median of ``power``, scaled to the
    mean.
    """
    from scipy.ndimage import median_filter

    floor = np.empty_like(power)
    at = np.arange(len(power))
    for column, own in zip(floor.T, power.T, strict=True):  # of one dimension the filter is fifteen times faster
        coarse = median_filter(own[::4], size=_FLOOR_BINS + 1, mode="nearest")
        column[:] = np.interp(at, at[::4], coarse)
    return np.asarray(floor / np.log(2) + 1e-30)


def _turning(frequency_hz: float, samples: Sequence[Samples], rests: Sequence[Floats]) -> list[Waves]:
    """Return the sums (m,) over the samples of each run, each times a phasor that turns back at a frequency."""
    sums = []
    for s, rest in zip(samples, rests, strict=True):
        phase = 2 * np.pi * frequency_hz * s.t_s
        sums.append(np.cos(phase) @ rest - 1j * (np.sin(phase) @ rest))
    return sums


def _gain_at(
    frequency_hz: float,
    turning: Callable[[float], list[Waves]],
    samples: Sequence[Samples],
    variances: Sequence[Floats],
    locked: bool,
) -> tuple[float, list[float], list[float]]:
    """Return the result of ``_tone_gain`` at a frequency, whose waves ``turning`` gives."""
    return _tone_gain(turning(frequency_hz), samples, variances, locked)


def _tone_gain(
    turning: Sequence[Waves], samples: Sequence[Samples], variances: Sequence[Floats], locked: bool
) -> tuple[float, list[float], list[float]]:
    """Return half the sum of the squares that a tone explains, and by amplitude the squares and the information.

    ``turning`` are the products (m,) of each run's samples with the wave, ``variances`` (m,) the noise of each.
    Amplitudes are one for each gyro, or one for each gyro and run if not ``locked``.
    """
    sums: dict[tuple[str, int], tuple[complex, float]] = {}
    for number, (own, s, variance) in enumerate(zip(turning, samples, variances, strict=True)):
        for i, name in enumerate(s.names):
            key = name, 0 if locked else number
            total, information = sums.get(key, (0j, 0.0))
            sums[key] = total + own[i] / variance[i], information + 0.5 * len(s.t_s) / variance[i]
    squares = [abs(total) ** 2 / information for total, information in sums.values()]
    return 0.5 * sum(squares), squares, [information for _, information in sums.values()]


def _peak(gain: Callable[[float], tuple[float, list[float], list[float]]], low: float, high: float) -> float:
    """Return the frequency of the highest gain: the best point of a grid, refined between its neighbours."""
    grid = np.linspace(low, high, _STEPS)
    best = int(np.argmax([gain(f)[0] for f in grid.tolist()]))
    return highest(lambda f: gain(f)[0], float(grid[max(best - 1, 0)]), float(grid[min(best + 1, _STEPS - 1)]))


def _log_evidence(squares: Floats, information: Floats) -> float:
    """Return the log evidence of amplitudes (cosine and sine each), averaged over the scales of their prior.

    ``squares`` and ``information`` (n,) are as ``_tone_gain`` returns them.
    """
    largest = TONE.effect(frequency_hz=1.0).largest[0]
    values = []
    for scale in SCALES:
        told = information * (scale * largest) ** 2
        values.append(float(np.sum(0.5 * squares * told / (1 + told) - np.log1p(told))))
    return log_mean(np.array(values))
