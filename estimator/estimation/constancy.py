"""Whether what a calibration takes for constant was so: the states of each gyro, gearing and angles of each axis.

A state that changes for a while, or from an instant on, adds its regressor over that time. The score of such a change
is the sum of what the estimate leaves times that regressor, both under the noise that was found. Its variance, what the
constants take of it allowed for, follows from the same products (the fluctuation test of Zeileis and Hornik 2007; for
one instant the Lagrange multiplier test of Andrews 1993). All spans between the edges of an even grid are tried.
What all gyros share is the table's doing.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from estimator.effects.table import TABLE_RATE
from estimator.estimation.noise_evidence import Joint
from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import Z
from estimator.types import Floats

_BY_CHANCE = 1e-4  # probability that anything is told of a run in which nothing changes
_MOST_SPANS, _FEWEST_BLOCKS = 80, 10  # parts of a run at most, and blocks of each at least
_FINE = 3  # waves for each part: what is finer tells next to nothing of it
_LEAST = 1e-7  # share of all that is known of a state that must be left of a change: less is rounding
_MOST_NAMED = 3
_ALIKE = 9.2  # twice the logarithm of the odds, 100, below which two causes are not told apart
_DEG = float(np.degrees(1.0))
_STATES = (("k", 1e6, "ppm"), ("b", _DEG, "deg/s"), ("sigma_j", _DEG, "deg"), ("sigma_k", _DEG, "deg"))


class _Change(NamedTuple):
    """By how many sigmas something changed, and how that is told."""

    sigmas: float
    text: str


def changes(joint: Joint) -> list[str]:
    """Return, in words, what changed in mid-run by more than chance: a state of a gyro, or the table."""
    used = sum(int((run.weight > 0).sum()) for run in joint.runs) // len(joint.runs)
    parts = min(_MOST_SPANS, used // _FEWEST_BLOCKS)
    if parts < 2:
        return []
    edges_s = np.linspace(min(run.t_s[0] for run in joint.runs), max(run.t_s[-1] for run in joint.runs), parts + 1)
    own: dict[tuple[str, float, str], Floats] = {}
    shared: dict[tuple[str, float, str], Floats] = {}
    for number, run in enumerate(joint.runs):
        table, states = _of_table(run), run.state_columns()
        for i, gyro in enumerate(joint.gyros_of(number)):
            who = run.array.names[i].partition(" ")[2]
            sums = _spans(joint, number, gyro, np.stack([*states[i].T, *(one[i] for one in table.values())]), edges_s)
            own |= {
                (f"{state} of {who}", f, unit): one for (state, f, unit), one in zip(_STATES, sums[:4], strict=True)
            }
            shared |= {key: shared.get(key, 0.0) + one for key, one in zip(table, sums[4:], strict=True)}
    tried = sum(int((one[1] > 0).sum()) for one in (*own.values(), *shared.values()))
    found = sorted((_worst(key, one, edges_s) for key, one in (*own.items(), *shared.items())), reverse=True)
    if found[0].sigmas <= _limit(tried):
        return []
    alike = [one.text for one in found if found[0].sigmas ** 2 - one.sigmas**2 < _ALIKE]
    return [f"what was measured changed in mid-run: {' or '.join(alike[:_MOST_NAMED])} ({found[0].sigmas:.0f} sigma)"]


def halves(joint: Joint, cluster_s: float) -> list[str]:
    """Return, in words, what of the states differs between the halves of a run by more than chance.

    For references of other instruments, of which errors hang together over ``cluster_s`` (Liang, Zeger 1986).
    """
    found = []
    for gyro, name in enumerate(name for run in joint.runs for name in run.array.names):
        t_s, rows = joint.whitened(gyro)
        precision = np.concatenate([1 / joint.evidence.gyros[gyro].prior, np.ones(rows.shape[1] - 5)])
        sides = [_half(t_s[side], rows[side], precision, cluster_s) for side in (t_s < t_s.mean(), t_s >= t_s.mean())]
        sigmas = np.abs(sides[0][0] - sides[1][0]) / np.sqrt(sides[0][1] + sides[1][1])
        found += [
            _Change(float(one), f"{state} of {name.partition(' ')[2]}")
            for one, (state, *_) in zip(sigmas, _STATES, strict=True)
        ]
    worst = max(found)
    if worst.sigmas <= _limit(len(found)):
        return []
    return [f"the two halves of this recording disagree: {worst.text} by {worst.sigmas:.0f} sigma"]


def _half(t_s: Floats, rows: Floats, precision: Floats, cluster_s: float) -> tuple[Floats, Floats]:
    """Return states and their variances (4,) from whitened rows (b, c + 1), the larger of two: as noise, by cluster."""
    columns = np.delete(rows, Z, axis=1)
    covariance = np.linalg.inv(columns.T @ columns + np.diag(precision))
    x = covariance @ columns.T @ rows[:, Z]
    _, first = np.unique((t_s / cluster_s).astype(np.intp), return_index=True)
    scores = np.add.reduceat(columns * (rows[:, Z] - columns @ x)[:, None], first, axis=0) @ covariance
    free = len(first) / max(len(first) - len(x), len(first) / 4)
    return x[:4], np.maximum(np.diag(covariance), free * np.sum(scores**2, axis=0))[:4]


def _limit(tried: int) -> float:
    """Return the sigmas that the largest of so many has by chance so seldom."""
    return NormalDist().inv_cdf(1 - _BY_CHANCE / max(2 * tried, 1))


def _worst(key: tuple[str, float, str], spans: Floats, edges_s: Floats) -> _Change:
    """Return the change of something that the scores of its spans (2, T + 1, T + 1) make most probable."""
    score, variance = spans
    sigmas = np.abs(score) / np.sqrt(np.where(variance > 0, variance, np.inf))
    first, last = (int(edge) for edge in np.unravel_index(np.argmax(sigmas), sigmas.shape))
    # One instant is simpler than two, and while an axis rests nothing tells them apart.
    nearly = max(float(sigmas[first, last]) ** 2 - _ALIKE / 2, 0.0) ** 0.5
    if sigmas[first, -1] >= nearly:
        last = len(edges_s) - 1
    elif sigmas[0, last] >= nearly:
        first = 0
    size, parts = float(score[first, last] / max(variance[first, last], 1e-300)), len(edges_s) - 1
    since = edges_s - edges_s[0]
    when = f"between {since[first]:.0f} and {since[last]:.0f} s"
    if first == 0 or last == parts:  # what was so until then is off from then on
        size, at_s = (size, since[first]) if last == parts else (-size, since[last])
        when = f"from {at_s:.0f} s on"
    name, factor, unit = key
    return _Change(float(sigmas[first, last]), f"{name} by {size * factor:+.3g} {unit} {when}")


def _of_table(run: Run) -> Mapping[tuple[str, float, str], Floats]:
    """Return what gyros see (m, b) of each axis that turns further than it reads: by a share, and by a rate."""
    if not run.grid.gimbals:
        return {}
    coarse, effect, found = run.coarse(), TABLE_RATE.effect(run.grid.gimbals), {}
    even = replace(coarse, grid=replace(coarse.grid, rate_rps=np.ones_like(coarse.grid.rate_rps)))
    for its, factor, unit in ((coarse, 100.0, "%"), (even, _DEG, "deg/s")):
        seen = np.array([its.columns(effect, gyro).T for gyro in range(len(run.array))])
        for n, axis in enumerate(run.grid.gimbals):
            found[f"the way of axis {axis} beside its readings", factor, unit] = seen[:, n]
    return found


def _spans(joint: Joint, number: int, gyro: int, columns: Floats, edges_s: Floats) -> Floats:
    """Return the scores and their variances (c, 2, T + 1, T + 1) of columns (c, b) of a gyro in each span of time.

    A span goes from one edge to a later one; where the constants explain all of it, or it is none, both are 0.
    """
    run, spectra = joint.runs[number], joint.evidence.gyros[gyro]
    parts, c, n = len(edges_s) - 1, len(columns), spectra.columns[0].shape[1]
    power, across, inner = np.zeros((c, parts, parts)), np.zeros((c * parts, n)), np.zeros((n, n))
    weighed = run.weighed(columns.T, gyro - joint.gyros_of(number).start)
    for stretch, own in zip(spectra.stretches, spectra.columns, strict=True):
        root = np.sqrt(joint.weight[:, gyro] @ (1 / joint.evidence.density(spectra, stretch)))[stretch.band, None]
        ends = np.searchsorted(run.t_s[stretch.blocks], edges_s[1:-1]).tolist()
        low = min(len(own), -(-_FINE * parts * len(own) // len(run.t_s)))
        waves = _waves(len(own), low) * (root[:low] * np.sqrt(stretch.length_s) / spectra.arw)
        its = weighed[stretch.blocks]
        each = np.stack([waves[:, a:b] @ its[a:b] for a, b in pairwise((0, *ends, len(own)))], axis=2)
        rows = own * root
        power += each.transpose(1, 2, 0) @ each.transpose(1, 0, 2)
        across += each.reshape(low, -1).T @ rows[:low]
        inner += rows.T @ rows
    constants = np.delete(np.arange(len(inner)), Z)
    precision = np.concatenate([1 / spectra.prior, np.ones(len(constants) - 4)])
    known, of_z = across[:, constants], inner[constants][:, [Z]]
    taken = np.linalg.solve(inner[np.ix_(constants, constants)] + np.diag(precision), np.hstack([known.T, of_z]))
    known = known.reshape(-1, parts, len(constants))
    score = (across[:, Z] - across[:, constants] @ taken[:, -1]).reshape(-1, parts)
    left = power - known @ taken[:, :-1].reshape(len(constants), -1, parts).transpose(1, 0, 2)
    score = np.pad(score.cumsum(axis=1), ((0, 0), (1, 0)))
    sums = np.pad(left.cumsum(axis=1).cumsum(axis=2), ((0, 0), (1, 0), (1, 0)))
    edge = np.arange(parts + 1)
    own = sums[..., edge, edge]
    variance = own[..., None, :] + own[..., :, None] - sums - sums.swapaxes(-1, -2)
    seen = (variance > _LEAST * power.sum(axis=(1, 2), keepdims=True)) & (edge > edge[:, None])
    found: Floats = np.stack([(score[:, None, :] - score[:, :, None]) * seen, variance * seen], axis=1)
    return found


@lru_cache(maxsize=4)
def _waves(blocks: int, count: int) -> Floats:
    """Return the lowest rows (count, blocks) of the orthonormal cosine transform."""
    waves = np.cos(np.pi / blocks * np.outer(np.arange(count), np.arange(blocks) + 0.5)) * np.sqrt(2 / blocks)
    waves[0] /= np.sqrt(2)
    return np.asarray(waves)
