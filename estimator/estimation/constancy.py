"""Whether the quantities that a calibration takes as constant were so: states of gyros, gearing and angles of axes.

A state that changes for a while, or from an instant on, adds its regressor over that time. The score of such a change
is the sum of what the estimate leaves times that regressor, both under the noise that was found. Its variance, what the
constants take of it allowed for, follows from the same products (the fluctuation test of Zeileis and Hornik 2007; for
one instant the Lagrange multiplier test of Andrews 1993). All spans between the edges of an even grid are tried. What
all gyros share is the table's doing.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import pairwise
from statistics import NormalDist
from typing import NamedTuple

import numpy as np

from estimator.effects.table import TABLE_RATE
from estimator.estimation.noise_evidence import Joint, settled
from estimator.estimation.runs.run import Run
from estimator.estimation.spectra import Z
from estimator.sensors.gyros import GYRO
from estimator.types import Floats

Key = tuple[str, float, str]
"""What may change, in words; the factor from its SI unit to the unit shown; that unit."""

_BY_CHANCE = 1e-4  # probability that a run without changes is reported
_MOST_SPANS = (40, 80)  # parts of a run at most: at first, and where those find something worth a look
_FEWEST_BLOCKS = 10  # of a part
_FINE = 3  # waves for each part: finer ones add next to nothing
_LEAST = 1e-7  # share of all that is known of a state that must be left of a change: less is rounding
_MOST_NAMED = 3
_WORTH = 0.75  # of the limit for a report: finer parts, and noise estimated without the change, raise the score
_ALIKE = 9.2  # twice the logarithm of the odds, 100, below which two causes are not distinguished
_WAY = "the gyros and the {} encoder disagreed"
_DEG = float(np.degrees(1.0))
_SHOWN = {"1": (1e6, "ppm"), "rad/s": (_DEG, "deg/s"), "rad": (_DEG, "deg")}
_STATES: tuple[Key, ...] = tuple((state.symbol, *_SHOWN[state.unit]) for state in GYRO.states)


class _Change(NamedTuple):
    """A change in mid-run: its size in sigmas, the words for it, its key, its size in SI units (before the factor of
    the key), and the numbers of the two edges of time between which it was.
    """

    sigmas: float
    text: str
    key: Key = ("", 0.0, "")
    size: float = 0.0
    edges: tuple[int, int] = (0, 0)


def changes(joint: Joint) -> list[str]:
    """Return one sentence on what changed in mid-run by more than chance (a state of a gyro, or the table), or an empty
    list.

    The runs are searched in spans of time, then in finer ones if something is at least near the limit. Too few blocks
    for two spans give an empty list. Changes that fit as well are named together, at most ``_MOST_NAMED``. If all lie
    below the limit, those near it are looked at again, because the noise was estimated with the change in it and may
    have absorbed it: the change is subtracted, the noise estimated anew, and twice the gain in log evidence counts as
    squared sigmas.
    """
    columns = [one for number, run in enumerate(joint.runs) for one in _columns(run)]
    edges_s = np.linspace(min(run.t_s[0] for run in joint.runs), max(run.t_s[-1] for run in joint.runs), 2)
    found, limit = [_Change(np.inf, "")], 0.0
    used = sum(int((run.weight > 0).sum()) for run in joint.runs) // len(joint.runs)
    for parts in (min(most, used // _FEWEST_BLOCKS) for most in _MOST_SPANS):
        if parts < 2 or found[0].sigmas <= _WORTH * limit:
            return []
        edges_s = np.linspace(edges_s[0], edges_s[-1], parts + 1)
        scores: dict[Key, Floats] = {}
        for gyro, own in enumerate(columns):
            sums = _spans(joint, gyro, np.stack([*own.values()]), edges_s)
            scores |= {key: scores.get(key, 0.0) + one for key, one in zip(own, sums, strict=True)}
        limit = _limit(sum(int((one[1] > 0).sum()) for one in scores.values()))
        found = sorted((_worst(key, one, edges_s) for key, one in scores.items()), reverse=True)
    if found[0].sigmas <= limit:
        worth = [one for one in found[:_MOST_NAMED] if one.sigmas > _WORTH * limit]
        found = sorted((one._replace(sigmas=_beside(joint, columns, one, edges_s)) for one in worth), reverse=True)
    if not found or found[0].sigmas <= limit:
        return []
    alike = [one.text for one in found if found[0].sigmas ** 2 - one.sigmas**2 < _ALIKE]
    return [f"{' or '.join(alike[:_MOST_NAMED])} ({found[0].sigmas:.0f} sigma)"]


def _beside(joint: Joint, columns: Sequence[Mapping[Key, Floats]], change: _Change, edges_s: Floats) -> float:
    """Return the sigmas of a change after the noise was estimated again without it: the root of twice the gain in log
    evidence, 0 without a gain.

    ``columns`` hold by gyro and key what a change of size 1 adds to the output error (b,), ``edges_s`` (T + 1,) are the
    instants of the edges. Gyros without the key of the change keep their output error.
    """
    first_s, last_s = edges_s[change.edges[0]], edges_s[change.edges[1]] + 1e-9
    spectra = list(joint.evidence.gyros)
    for gyro, own in enumerate(columns):
        if change.key in own:
            run, i = joint.run_of(gyro)
            there = change.size * ((run.t_s >= first_s) & (run.t_s < last_s))
            part = run.weighed((own[change.key] * there)[:, None], i)
            its = spectra[gyro]
            spectra[gyro] = replace(its, columns=[*its.columns], products=its.products.copy())
            spectra[gyro].subtract([part[stretch.blocks] for stretch in its.stretches])
    evidence, terms = settled(joint.runs, spectra, joint.evidence.shapes, joint.laws)
    return float(np.sqrt(max(2 * (evidence.of(terms) - joint.evidence.of(terms)), 0.0)))


def halves(joint: Joint, cluster_s: float) -> list[str]:
    """Return one sentence if a state differs between the halves of a run by more than chance, else an empty list.

    It names only the largest difference. This is for references of other instruments, whose errors are correlated over
    ``cluster_s`` (Liang, Zeger 1986).
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
    """Return the states (4,) and their variances (4,) of a gyro from whitened rows (b, c + 1) of one half of a run.

    The rows are [states, z, laws], ``t_s`` (b,) their instants. ``precision`` (c,) is that of the prior. Each variance
    is the larger of the variance under the noise and the one with residuals correlated within clusters of
    ``cluster_s``.
    """
    columns = np.delete(rows, Z, axis=1)
    covariance = np.linalg.inv(columns.T @ columns + np.diag(precision))
    x = covariance @ columns.T @ rows[:, Z]
    _, first = np.unique((t_s / cluster_s).astype(np.intp), return_index=True)
    scores = np.add.reduceat(columns * (rows[:, Z] - columns @ x)[:, None], first, axis=0) @ covariance
    free = len(first) / max(len(first) - len(x), len(first) / 4)
    return x[:4], np.maximum(np.diag(covariance), free * np.sum(scores**2, axis=0))[:4]


def _limit(tried: int) -> float:
    """Return the sigmas that the largest of ``tried`` normal values exceeds by chance with probability
    ``_BY_CHANCE``.
    """
    return NormalDist().inv_cdf(1 - _BY_CHANCE / max(2 * tried, 1))


def _worst(key: Key, spans: Floats, edges_s: Floats) -> _Change:
    """Return the change that is most significant among the ``spans`` (2, T + 1, T + 1) of scores and variances of one
    key, with the edges ``edges_s`` (T + 1,).

    Where it is nearly as significant to let the change last from the start or to the end of the run, that is chosen:
    one instant is simpler than two. The text on a change from the start until an instant tells the opposite change from
    that instant on.
    """
    score, variance = spans
    sigmas = np.abs(score) / np.sqrt(np.where(variance > 0, variance, np.inf))
    first, last = (int(edge) for edge in np.unravel_index(np.argmax(sigmas), sigmas.shape))
    # One instant is simpler than two, and while an axis rests they cannot be distinguished.
    nearly = max(float(sigmas[first, last]) ** 2 - _ALIKE / 2, 0.0) ** 0.5
    if sigmas[first, -1] >= nearly:
        last = len(edges_s) - 1
    elif sigmas[0, last] >= nearly:
        first = 0
    of_span = size = float(score[first, last] / max(variance[first, last], 1e-300))
    parts, since = len(edges_s) - 1, edges_s - edges_s[0]
    when = f"from {since[first]:.0f} to {since[last]:.0f} s"
    if first == 0 or last == parts:  # if it lasted until then, it differs from then on
        size, at_s = (size, since[first]) if last == parts else (-size, since[last])
        when = f"from {at_s:.0f} s on,"
    name, factor, unit = key
    text = f"{when} {name} by {size * factor:+.3g} {unit}"
    return _Change(float(sigmas[first, last]), text, key, of_span, (first, last))


def _columns(run: Run) -> list[dict[Key, Floats]]:
    """Return for each gyro of a run the columns (b,) that ``changes`` tests, by key.

    They are the gyro's states and, on a table, for each axis two errors of the axis: turning further than it reads by a
    share of its way, and by a constant rate. A key is the text on the change, the factor to the unit that is shown, and
    this unit.
    """
    states, gimbals = run.state_columns(), run.grid.gimbals
    found: list[dict[Key, Floats]] = []
    coarse, effect = run.coarse(), TABLE_RATE.effect(gimbals)
    rate_rps = coarse.grid.rate_rps
    even = replace(coarse.grid, rate_rps=np.ones_like(rate_rps))
    for i, name in enumerate(run.array.names):
        who = name.partition(" ")[2]
        found.append(
            {(f"{state} of {who} differed", f, u): its for (state, f, u), its in zip(_STATES, states[i].T, strict=True)}
        )
        if gimbals:
            ways = effect.columns(even, run.array, i)
            seen = coarse.fold(np.hstack([ways * rate_rps, ways])).T
            kinds = [(_WAY.format(axis), f, unit) for f, unit in ((100.0, "%"), (_DEG, "deg/s")) for axis in gimbals]
            found[-1] |= dict(zip(kinds, seen, strict=True))
    return found


def _spans(joint: Joint, gyro: int, columns: Floats, edges_s: Floats) -> Floats:
    """Return (c, 2, T + 1, T + 1): score and variance of each of the columns (c, b) of a gyro in each span of time.

    A span reaches from one of the T + 1 edges in ``edges_s`` (third index) to a later one (fourth). Both values are 0
    where the span is empty or runs backwards, or where the constant states and laws explain nearly all that the column
    shows in it.
    """
    (run, own_number), spectra = joint.run_of(gyro), joint.evidence.gyros[gyro]
    parts, c, n = len(edges_s) - 1, len(columns), spectra.columns[0].shape[1]
    power, across, inner = np.zeros((c, parts, parts)), np.zeros((c * parts, n)), np.zeros((n, n))
    weighed = run.weighed(columns.T, own_number)
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
