"""Noise at rest: coverage of the intervals of N, B and K, degrees of freedom, time.

python tests/bench/allan.py coverage             200 series of each of four kinds of sensor
python tests/bench/allan.py freedom              degrees of freedom against 20,000 series, 1000 samples each
python tests/bench/allan.py length               spread of B and K in records of the length that is told for 10 %
python tests/bench/allan.py time                 360 s at 4 kHz, six channels
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from estimator.observations.allan.deviation import degrees_of_freedom
from estimator.observations.allan.duration import record_length_s, relative_uncertainty
from estimator.observations.allan.sensor import RATE, Series, sensor_noise
from estimator.observations.allan.terms import NoiseTerms, noise_terms

SENSORS = {  # samples, sampling period in s, N, B, K
    "all three seen": (36000, 1.0, 1.0, 0.3, 0.01),
    "no floor of a decade": (18000, 0.02, 1.0, 1.0, 0.3),
    "little B and K": (4000, 1.0, 1.0, 0.1, 0.003),
    "short": (1000, 1.0, 1.0, 0.2, 0.02),
}
WIDTHS = (1, 4, 16, 64, 200, 330)
_AT_ONCE = 50
_EARLIER = 16  # flicker noise begins so many lengths of a series before it


def flicker(random: np.random.Generator, samples: int, count: int) -> np.ndarray:
    """Return half integrated white noise (samples, count), of density ``1 / (2 sin(theta / 2))``."""
    longer = next_fast_len(_EARLIER * samples)
    room = next_fast_len(2 * longer)
    numbers = np.arange(1, longer)
    kernel = rfft(np.concatenate([[1.0], np.cumprod((numbers - 0.5) / numbers)]), room)
    made = np.empty((samples, count))
    for column in made.T:
        column[:] = irfft(kernel * rfft(random.standard_normal(longer), room), room)[longer - samples : longer]
    return made


def series(random: np.random.Generator, kind: str, count: int) -> np.ndarray:
    """Return series (n, count) of a kind of sensor."""
    samples, period_s, n, b, k = SENSORS[kind]
    white = n / np.sqrt(period_s) * random.standard_normal((samples, count))
    walk = k * np.sqrt(period_s) * np.cumsum(random.standard_normal((samples, count)), axis=0)
    return np.asarray(white + walk + b * flicker(random, samples, count))


def found_in(kind: str, count: int, seed: int) -> Iterator[NoiseTerms]:
    """Yield what is found in series of a kind of sensor."""
    random = np.random.default_rng([seed, len(kind)])
    for first in range(0, count, _AT_ONCE):
        yield from noise_terms([series(random, kind, min(_AT_ONCE, count - first))], SENSORS[kind][1])


def coverage(count: int, seed: int) -> None:
    """Print how many intervals hold the truth."""
    total: dict[str, list[bool]] = {name: [] for name in "NBK"}
    for kind, (*_, n, b, k) in SENSORS.items():
        found = list(found_in(kind, count, seed))
        words = []
        for name, true in zip("NBK", (n, b, k), strict=True):
            inside = [terms[name].low <= true <= terms[name].high for terms in found]
            seen = np.mean([terms[name].seen for terms in found])
            total[name] += inside
            words.append(f"{name} {np.mean(inside):.1%} (seen in {seen:.0%})")
        print(f"{kind}, {count} series: {', '.join(words)}", flush=True)
    of_all = ", ".join(f"{name} {np.mean(inside):.1%}" for name, inside in total.items())
    print(f"all {count * len(SENSORS)}: {of_all}; together {np.mean([*total.values()]):.1%}")


def freedom(count: int, seed: int) -> None:
    """Print degrees of freedom as computed and as simulated, and by how much they differ."""
    random = np.random.default_rng(seed)
    for number, name in enumerate(("white", "flicker", "walk")):
        squares: dict[int, list[np.ndarray]] = {width: [] for width in WIDTHS}
        for _ in range(0, count, 500):
            rate = flicker(random, 1000, 500) if number == 1 else random.standard_normal((1000, 500))
            rate = np.cumsum(rate, axis=0) if number == 2 else rate
            phase = np.vstack([np.zeros((1, 500)), np.cumsum(rate, axis=0)])
            for width, own in squares.items():
                second = phase[2 * width :] - 2 * phase[width:-width] + phase[: -2 * width]
                own.append(np.mean(second**2, axis=0))
        for width, parts in squares.items():
            variance = np.concatenate(parts)
            simulated = 2 * variance.mean() ** 2 / variance.var()
            computed = float(degrees_of_freedom([1000], width, 1.0, np.eye(3)[[number]])[0])
            print(f"{name:8} {width:4d} {computed:8.2f} {simulated:8.2f} {computed / simulated - 1:+.1%}", flush=True)


def length(count: int, seed: int) -> None:
    """Print the spread of B and K in records as long as is told for 10 %."""
    random = np.random.default_rng(seed)
    samples, period_s, *sizes = SENSORS["all three seen"]
    first = next(found_in("all three seen", 1, seed))
    for term, name in ((1, "B"), (2, "K")):
        wanted_s = record_length_s(first, term, 0.1)
        n, b, k = sizes
        spread = []
        for _ in range(0, count, _AT_ONCE):
            shape = round(wanted_s / period_s), _AT_ONCE
            rate = n * random.standard_normal(shape) + k * np.cumsum(random.standard_normal(shape), axis=0)
            spread += [terms[name].value for terms in noise_terms([rate + b * flicker(random, *shape)], period_s)]
        expected = relative_uncertainty(np.array(sizes), term, wanted_s, period_s)
        words = f"{name}: {wanted_s:.0f} s for 10 % under the noise of one series, {expected:.1%} under the true noise"
        print(f"{words}; spread {np.std(spread) / sizes[term]:.1%} of {len(spread)} series", flush=True)


def duration() -> None:
    """Print the processor time and the wall time of 360 s at 4 kHz, six channels."""
    values = np.random.default_rng(1).standard_normal((1_440_000, 6))
    one = Series(tuple("abcdef"), RATE, 1 / 4000, (values,))
    for _ in range(3):
        began, used = time.perf_counter(), time.process_time()
        sensor_noise(one, 10)
        print(f"{time.perf_counter() - began:.2f} s, {time.process_time() - used:.2f} s of processor time")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["coverage", "freedom", "length", "time"])
    parser.add_argument("--count", type=int, help="series; default: 200, of freedom 20,000")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    if arguments.what == "time":
        duration()
    else:
        default = 20_000 if arguments.what == "freedom" else 200
        run = {"coverage": coverage, "freedom": freedom, "length": length}[arguments.what]
        run(arguments.count or default, arguments.seed)
