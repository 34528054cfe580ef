"""The residual of each gyro beside a model, and how much of it a candidate explains: a cheap first judgement."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.evidence import SCALES, Evidence, Term
from estimator.estimation.runs.run import with_gyro
from estimator.estimation.spectra import Z
from estimator.tracing.candidates import Candidate
from estimator.tracing.option_columns import Stack
from estimator.tracing.run_columns import RunColumns, of_gyro
from estimator.tracing.tones.peaks import highest
from estimator.types import Floats

_NEAR_S = 0.005  # around its apparent size an effect is searched that is exact for its own size only
_SHORTEST_S = 1e-4  # of a time constant, which is not negative
_LONGEST_S = 0.3  # of a delay or a time constant: slower effects are not of this kind
_ROUNDING = 1e-9  # share by which gains of the same columns may differ, scanned with others
_LOST = 1e-14  # share of squares to which those that a model leaves of them are known
_FIRST_STEP = 0.02  # share of a constant
_CLOSE = 0.2  # sigmas to which a constant of a law is found
_TOGETHER = 8  # candidates that are scanned at once: so many columns fit the cache of a processor


def at(candidate: Candidate, theta: float) -> Candidate:
    """Return a candidate with another value of its nonlinear parameter."""
    assert candidate.of is not None
    return replace(candidate, effect=candidate.of(theta), theta=theta)


def first_of_best(gains: Floats) -> int:
    """Return the number of the largest of some gains (k,); the first of those that differ by rounding only."""
    return int(np.argmax(gains >= gains.max() * (1 - _ROUNDING)))


class Scan:
    """The whitened residual of each gyro beside a model, to compute how much an effect would explain of it."""

    def __init__(
        self, columns: Sequence[RunColumns], evidence: Evidence, terms: Sequence[Term], noise: int | None = None
    ) -> None:
        """Compute the residual of each gyro beside the model of ``terms``, over the noise.

        ``noise`` is the number of the noise model, by default the one most probable with the terms.
        """
        self._columns = columns
        runs = [one.run for one in columns]
        best = int(np.argmax(evidence.noise_weight(terms))) if noise is None else noise
        asked = [*range(Z), *(c for t in terms for c in t.columns), Z]
        self._gyros: list[_Left] = []
        for gyro in evidence.gyros:
            density = np.concatenate([evidence.density(gyro, s)[best][s.band] for s in gyro.stretches])
            lengths_s = np.concatenate([np.full(len(s.band), s.length_s) for s in gyro.stretches])
            whole = np.vstack([own[:, asked] for own in gyro.columns]) / np.sqrt(density)[:, None]
            basis, _ = np.linalg.qr(whole[:, :-1])
            rest = whole[:, -1] - basis @ (basis.T @ whole[:, -1])
            where = tuple((number, i) for number, _, i in with_gyro(runs, gyro.name))
            self._gyros.append(_Left(where, np.sqrt(lengths_s / density) / gyro.arw, basis, rest))

    def gains(self, candidates: Sequence[Candidate]) -> Floats:
        """Return by how much half the squares fall if one of some effects is added (k,), each gyro fitted by itself.

        All have the same number of parameters. Their columns are kept for the next scan.
        """
        found = np.zeros(len(candidates))
        for start in range(0, len(candidates), _TOGETHER):
            part = slice(start, start + _TOGETHER)
            found[part] = _gains(*self._products(candidates[part], keep=True))
        return found

    def bounds(self, stacks: Sequence[Stack]) -> tuple[Floats, Floats]:
        """Return bounds (k,) on the rise of the log evidence if each candidate is added: at most and at least.

        ``stacks`` hold the columns of all k candidates. The upper bound is the gain, half of the fall of the squares.
        The lower is the log evidence with parameters whose expected size is the largest plausible one, less the cost of
        trying all sizes.
        """
        count = 1 + max((int(stack.numbers.max()) for stack in stacks), default=-1)
        most, at_least = np.zeros(count), np.full(count, -np.log(len(SCALES)))
        for stack in stacks:
            own, right = self._products_of(stack)
            most[stack.numbers] += _gains(own, right)
            at_least[stack.numbers] += _evidence(own, right)
        return most, at_least

    def _products_of(self, stack: Stack) -> tuple[Floats, Floats]:
        """Return the same as ``_products`` for the k candidates of a stack, and its gyros alone.

        What the model explains of the columns is taken off their products, not off the columns.
        """
        k, p, rows = stack.columns.shape
        left = [self._gyros[gyro] for gyro in stack.gyros]
        model = np.hstack([np.column_stack([one.basis, one.rest]) * one.root[:, None] for one in left])
        with_model = (stack.columns.reshape(-1, rows) @ model).reshape(k, p, len(left), -1).transpose(2, 0, 1, 3)
        explained, with_rest = with_model[..., :-1], with_model[..., -1]
        weight = np.array([one.root[stack.first_rows] ** 2 for one in left])
        whole = (weight @ stack.products.reshape(k * p * p, -1).T).reshape(len(left), k, p, p)
        rounding = _LOST * np.trace(whole, axis1=2, axis2=3)[..., None, None] * np.eye(p)
        return whole - explained @ explained.swapaxes(2, 3) + rounding, with_rest

    def gain(self, candidate: Candidate) -> float:
        """Return by how much half the squares fall if an effect is added, each gyro fitted by itself."""
        return float(_gains(*self._products([candidate]))[0])

    def products(self, candidate: Candidate) -> tuple[Floats, Floats]:
        """Return products of an effect's columns beside the model, (gyros, p, p), and with what is left, (gyros, p)."""
        own, with_rest = self._products([candidate])
        return own[:, 0], with_rest[:, 0]

    def products_of(self, stacks: Sequence[Stack], number: int) -> tuple[Floats, Floats]:
        """Return what ``products`` returns, for the candidate with this number among those of ``stacks``."""
        found: dict[int, tuple[Floats, Floats]] = {}
        for stack in (one for one in stacks if number in one.numbers):
            own, with_rest = self._products_of(stack.only(number))
            found |= dict(zip(stack.gyros, zip(own[:, 0], with_rest[:, 0], strict=True), strict=True))
        of_gyros = [found[gyro] for gyro in range(len(self._gyros))]
        return np.array([own for own, _ in of_gyros]), np.array([with_rest for _, with_rest in of_gyros])

    def _products(self, candidates: Sequence[Candidate], *, keep: bool = False) -> tuple[Floats, Floats]:
        """Return products of the columns of k candidates beside the model, over the noise.

        They are those with one another (gyros, k, p, p) and with the residual (gyros, k, p). All candidates must have
        the same number p of parameters; ``keep`` keeps their columns for later calls.
        """
        of_runs = [[columns.of(candidate, keep=keep) for candidate in candidates] for columns in self._columns]
        stacks: dict[tuple[tuple[int, int], ...], Floats] = {}
        products, with_rest = [], []
        for gyro in self._gyros:
            # The same columns stand for all gyros that have the same.
            alike = all(len(one) == 1 for number, _ in gyro.where for one in of_runs[number])
            where = tuple((number, 0) for number, _ in gyro.where) if alike else gyro.where
            if where not in stacks:
                parts = [np.vstack([of_gyro(one, i) for one in of_runs[number]]) for number, i in where]
                stacks[where] = np.hstack(parts)
            new = stacks[where] * gyro.root
            new -= (new @ gyro.basis) @ gyro.basis.T
            each = new.reshape(len(candidates), -1, len(gyro.root))
            products.append(each @ each.swapaxes(1, 2))
            with_rest.append(each @ gyro.rest)
        return np.array(products), np.array(with_rest)

    def size(self, candidate: Candidate) -> float:
        """Return the size of an effect with a nonlinear size that leaves the least residual, the same for all gyros.

        The size is the effect's first parameter. The effect is evaluated anew at each size, because its column alone,
        enlarged by the noise of the reference, gives too little. With a single start value, as for a table's own rates,
        the column is evaluated there and once at the size that it gives. The size is at most 0.3 s either way.
        """
        assert candidate.start is not None
        if len(candidate.start) == 1:  # a table's own rates have next to no noise
            size = self._first_size(candidate)
            return self._first_size(at(candidate, size)) if size else size

        def gain(size: float) -> float:
            return self._gain_of(candidate, size)

        start = np.sort(np.append(candidate.start, self._first_size(candidate)))
        best = int(np.argmax([gain(size) for size in start.tolist()]))
        reach = max(abs(float(start[best])), _NEAR_S)
        least = -_LONGEST_S if candidate.start.min() <= 0 else _SHORTEST_S
        low = max(float(start[best - 1]) if best else -np.inf, float(start[best]) - reach, least)
        high = min(float(start[best + 1]) if best + 1 < len(start) else np.inf, float(start[best]) + reach, _LONGEST_S)
        return highest(gain, low, high)

    def _first_size(self, candidate: Candidate) -> float:
        """Return the size from the candidate's present column, which is right for small sizes."""
        products, with_rest = self._products([candidate])
        own, right = products[:, 0, 0, 0].sum(), with_rest[:, 0, 0].sum()
        sign = -1.0 if candidate.theta and candidate.theta < 0 else 1.0  # a lag of the reference is a size of its own
        return float(np.clip(sign * right / max(own, 1e-30) * candidate.effect.largest[0], -_LONGEST_S, _LONGEST_S))

    def _gain_of(self, candidate: Candidate, size: float) -> float:
        """Return by how much an effect of a size raises the log evidence, with each gyro's noise set to what is then
        left.

        The size, in the unit of the effect's first parameter, is the same for all gyros.
        """
        share = abs(size) / candidate.effect.largest[0] if size else 0.0
        total = 0.0
        products, with_rest = self._products([at(candidate, size)])
        for gyro, own, right in zip(self._gyros, products[:, 0, 0, 0], with_rest[:, 0, 0], strict=True):
            before = float(gyro.rest @ gyro.rest)
            left = before - 2 * share * right + share**2 * own
            total -= 0.5 * len(gyro.rest) * np.log(max(left, 1e-9 * before) / before)
        return float(total)

    def width(self, candidate: Candidate) -> float:
        """Return by how much the nonlinear parameter may move before the log evidence falls by one half."""
        assert candidate.theta is not None
        return self._width(candidate.theta, lambda theta: self.gain(at(candidate, theta)), _FIRST_STEP)

    def _width(self, theta: float, gain: Callable[[float], float], first: float) -> float:
        """Return the distance from ``theta``, where ``gain`` is largest, at which the gain falls by 0.5; at most
        ``theta``.

        The search begins at the share ``first`` of ``theta`` and doubles the distance until the mean of both sides
        falls by more; a parabola then gives the distance.
        """
        top = gain(theta)
        step = first * theta
        while step < theta:
            fall = top - 0.5 * (gain(theta - step) + gain(theta + step))
            if fall > 0.5:
                return float(step / np.sqrt(2 * fall))
            step *= 2
        return float(theta)

    def tuned(self, candidate: Candidate, best: int | None = None) -> Candidate:
        """Return a candidate at the value of its nonlinear parameter with the largest gain, near its best start value.

        ``best`` is the number of that start value if it is known. ``log_tries`` of the result is the cost of the
        search: minus the logarithm of the share of the parameter's range that would do as well. For a candidate
        ``by_size`` the value is its size and there is no cost.
        """
        start = candidate.start
        assert start is not None
        if candidate.by_size:
            return at(candidate, self.size(candidate))
        if best is None:
            best = first_of_best(self.gains([at(candidate, theta) for theta in start.tolist()]))
        known: dict[str | float | None, float] = {}

        def gain(theta: float) -> float:
            option = at(candidate, theta)
            key = _key(option)
            if key not in known:
                known[key] = self.gain(option)
            return known[key]

        low, high = float(start[max(best - 1, 0)]), float(start[min(best + 1, len(start) - 1)])
        # The constant of a law that changes strongly with it is needed to this accuracy.
        known_to = 1 / np.sqrt(2 * max(gain(float(start[best])), 1.0)) if candidate.law else 0.0
        theta = highest(gain, low, high, _CLOSE * known_to * float(start[best]))
        if gain(theta) < gain(float(start[best])):
            theta = float(start[best])
        # What it costs that the value was looked for: the share of its range that would do as well. Any instant of a
        # step is as probable as any other, of a time constant any ratio.
        width = np.sqrt(2 * np.pi) * self._width(theta, gain, max(_FIRST_STEP, 0.5 * known_to))
        spread = float(start[-1] - start[0])
        share = width / spread if candidate.run is not None else width / theta / candidate.range_log
        return replace(at(candidate, theta), log_tries=float(-np.log(np.clip(share, 1e-4, 1.0))))


@dataclass(frozen=True, slots=True, eq=False)
class _Left:
    """Residual of one gyro beside a model in the cosine domain: rows are the frequencies of all its stretches.

    ``where`` has for each run with this gyro the run's number and the gyro's number in it. ``root`` (rows,) is the root
    of each row's weight, ``basis`` (rows, c) are orthonormal columns that span the model, ``rest`` (rows,) is the
    residual.
    """

    where: tuple[tuple[int, int], ...]
    root: Floats
    basis: Floats
    rest: Floats


def _gains(own: Floats, right: Floats) -> Floats:
    """Return the gains (k,) from products (gyros, k, p, p) of columns and those with the residual (gyros, k, p)."""
    taken = np.linalg.solve(own + 1e-6 * np.eye(own.shape[-1]), right[..., None])[..., 0]
    return np.asarray(0.5 * np.sum(right * taken, axis=(0, 2)))


def _evidence(own: Floats, right: Floats) -> Floats:
    """Return by how much the log evidence (k,) rises with parameters of unit variance, of the same products."""
    grown = own + np.eye(own.shape[-1])
    taken = np.linalg.solve(grown, right[..., None])[..., 0]
    return np.asarray(0.5 * (np.sum(right * taken, axis=2) - np.linalg.slogdet(grown)[1]).sum(axis=0))


def _key(candidate: Candidate) -> str | float | None:
    """Return the key of an option of a candidate; a law has its constant rounded."""
    return candidate.law or candidate.theta
