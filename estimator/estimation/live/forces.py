"""The live filter of the accelerometers of one source: samples wait for the table's readings, then feed it."""

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol, Self

import numpy as np

from estimator.estimation.live.covered import covered_blocks
from estimator.estimation.live.filter import Innovation, compressed_rows
from estimator.estimation.live.force_problem import About, ForceProblem
from estimator.estimation.live.usable_rows import UsableRows
from estimator.geometry.array import SensorArray, accelerometer_array
from estimator.geometry.kinematics import Gravity, gravity_at
from estimator.geometry.model import decode
from estimator.observations.timing import TimeOffset
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.motion.growing_rows import GrowingRows
from estimator.recordings.recording import ForceSheet, ImuData, Recording
from estimator.recordings.reference import TableUncertainty
from estimator.types import Flags, Floats, Stamps

_BLOCK_S = 1.0
_FEWEST_ROWS = 8
_RECENT_BLOCKS = 30
_LARGEST_S = 0.09  # of delays about which outputs are linearised
_SETTLED_S, _SETTLED_M, _MOST_STEPS = 1e-4, 1e-3, 4
_TRUSTED_NIS = 4.0  # above, a block may be wrong, and its delay and arm are not followed
_CHUNK_ROWS = 8192


class ForceBlock(Protocol):
    """Samples of one source: instants (n,) and outputs of its accelerometers (n, a), None without."""

    @property
    def t_ns(self) -> Stamps: ...
    @property
    def accel_mps2(self) -> Floats | None: ...


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ForceState:
    """All parameters (size,) of the accelerometers of a source, and their covariance (size, size)."""

    x: Floats
    covariance: Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class _Rows:
    """Rows that one block gives the filter: outputs (q,), columns (q, size), by accelerometer how many."""

    z: Floats
    h: Floats
    counts: tuple[int, ...]


class LiveForces:
    """The accelerometers of one source of a run: samples not yet used, their filter, what it gave.

    ``advance`` may work in a thread of its own. What others read changes by a whole block at once, under ``lock``.
    """

    def __init__(
        self,
        *,
        array: SensorArray,
        rate_hz: float,
        sheet: ForceSheet,
        gimbals: Sequence[str],
        gravity: Gravity,
        uncertainty: TableUncertainty | None,
    ) -> None:
        """Begin with the data sheet ``sheet``; ``array`` has the axes of the accelerometers, which sample at
        ``rate_hz``.

        ``gimbals`` are outermost first; ``uncertainty`` is that of the table, None if not stated.
        """
        self.array = array
        self.noise_mps2 = float(sheet.noise.arw * np.sqrt(rate_hz))
        self.problem = ForceProblem(array, sheet.prior, gimbals, uncertainty, gravity)
        self.gravity_mps2 = gravity.value_mps2
        self.lock = threading.RLock()
        self.blocks = 0
        self.about: tuple[list[int], list[About]] = ([], [])
        """About what outputs were linearised, and the instant up to which, in ns."""
        self.unused_ns: list[list[tuple[int, int]]] = [[] for _ in array.names]
        """By accelerometer the first and the last instant of each span of samples that were left out."""
        self.recent: deque[Innovation] = deque(maxlen=_RECENT_BLOCKS)
        self._judges = [UsableRows(self.noise_mps2) for _ in array.names]
        self._kept: list[Floats] = [np.empty((0, len(places) + 1)) for places in self.problem.places]
        self._nis_sum, self._nis_dof = 0.0, 0
        self._begin()
        self._about = About()
        self._rows = max(round(_BLOCK_S * rate_hz), _FEWEST_ROWS)
        self._t: Stamps = np.empty(0, dtype=np.int64)
        self._y: Floats = np.empty((0, len(array)))
        self._new: deque[ForceBlock] = deque()
        a = len(array)
        self._history = {
            "force_innovation": GrowingRows(t_ns=np.int64, nis=(), dof=np.int64, normalised=(a,)),
            "force_estimate": GrowingRows(
                t_ns=np.int64, states=(a, 4), sd=(a, 4), arm_m=(3,), arm_sd_m=(3,), delay_s=(), delay_sd_s=()
            ),
        }

    @classmethod
    def of(cls, recording: Recording, source: str) -> Self:
        """Return the filter of a source of a recording on a table, without samples.

        Its sample rate is the stated one, else that of the stamps. AssertionError without a table or a data sheet.
        """
        table, data = recording.table, recording.sources[source]
        assert table is not None, "specific force is computed from the readings of a table"
        assert data.accel_sheet is not None, "nothing is expected of these accelerometers"
        return cls(
            array=force_array(data),
            rate_hz=data.rate_hz or 1e9 / float(np.median(np.diff(data.t_ns))),
            sheet=data.accel_sheet,
            gimbals=table.gimbals,
            gravity=gravity_at(recording.site),
            uncertainty=table.uncertainty,
        )

    def add(self, block: ForceBlock) -> None:
        """Add samples; they are used once the table's readings cover them. Those without accelerations are ignored."""
        if block.accel_mps2 is not None:
            self._new.append(block)

    def advance(self, rates: BodyRates, *, flush: bool = False) -> None:
        """Update the filter with the samples that the table's readings cover, in whole blocks.

        With ``flush``, for the end of a run, the last part of a block is used too. Samples before the first known
        rate are dropped. Does nothing while no rate is known.
        """
        self._take_new()
        blocks, start = covered_blocks(self._t, rates, self._rows, flush=flush)
        for block in blocks:
            self._update(rates, block)
        self._t, self._y = self._t[start:], self._y[start:]

    def state(self) -> tuple[Floats, Floats]:
        """Return all parameters (size,) and their covariance (size, size)."""
        with self.lock:
            return self._filter.x[:, 0].copy(), self._filter.P.copy()

    def decoded(self) -> tuple[Floats, Floats]:
        """Return the states (a, 4) and their sigmas."""
        x, p = self.state()
        parts = [slice(4 * i, 4 * i + 4) for i in range(len(self.array))]
        pairs = [decode(x[own], p[own, own]) for own in parts]
        return np.array([s for s, _ in pairs]), np.array([np.sqrt(np.diag(c)) for _, c in pairs])

    def arm(self) -> tuple[Floats, Floats]:
        """Return the mean place (3,) in m of the accelerometers that give something, and its sigmas."""
        return self.problem.arm(*self.state(), self._counted())

    @property
    def delay(self) -> TimeOffset:
        """By how much the accelerometers are later than the readings of the table."""
        return TimeOffset(*self.problem.delay(*self.state()))

    @property
    def excluded(self) -> tuple[bool, ...]:
        """By accelerometer whether it is not what is stated, so that nothing of it counts."""
        with self.lock:
            return tuple(judge.excluded for judge in self._judges)

    @property
    def left_out(self) -> tuple[str, ...]:
        """By accelerometer why its last samples were left out, "" if they were not."""
        with self.lock:
            return tuple(judge.reason for judge in self._judges)

    @property
    def nis_mean(self) -> float:
        """Mean normalised innovation squared per degree of freedom so far; NaN before the first."""
        with self.lock:
            return self._nis_sum / self._nis_dof if self._nis_dof else float("nan")

    def recent_innovations(self) -> tuple[Innovation, ...]:
        """Return the innovations of the last half minute, NaN where an accelerometer was left out."""
        with self.lock:
            return tuple(self.recent)

    def take_history(self, fewest: int = 1) -> dict[str, dict[str, Any]]:
        """Return by group the columns by name that were kept since the last call, and forget them.

        "force_innovation" has t_ns, nis, dof, normalised, and "force_estimate" t_ns, states, sd, arm_m, arm_sd_m,
        delay_s, delay_sd_s: a row for each block. Empty for fewer than ``fewest`` blocks, which then stay for the next
        call.
        """
        with self.lock:
            if len(self._history["force_innovation"]) < fewest:
                return {}
            return {group: rows.take() for group, rows in self._history.items() if len(rows)}

    def _counted(self) -> list[int]:
        """Return the accelerometers by number whose place counts: some of their samples could be used, and they are not
        excluded; all if there are none.
        """
        numbers = range(len(self.array))
        return [i for i in numbers if len(self._kept[i]) and not self._judges[i].excluded] or list(numbers)

    def _begin(self) -> None:
        """Make the filter with the data sheet alone; sums, history and what the accelerometers gave stay."""
        from filterpy.kalman import KalmanFilter  # 0.8 s of import: only where a filter runs

        size = len(self.problem.variances)
        self._filter = KalmanFilter(dim_x=size, dim_z=size)
        self._filter.x = np.zeros((size, 1))
        self._filter.P = np.diag(self.problem.variances)

    def _take_new(self) -> None:
        """Append the samples added since the last call, if any."""
        new = [self._new.popleft() for _ in range(len(self._new))]
        if new:
            self._t = np.concatenate([self._t, *(block.t_ns for block in new)])
            self._y = np.vstack([self._y, *(block.accel_mps2 for block in new if block.accel_mps2 is not None)])

    def _update(self, rates: BodyRates, part: slice) -> None:
        """Update filter and history with the samples in ``part``.

        An accelerometer that turns out not to be what is stated is taken out of the filter, with all that it gave. The
        delay and the arm about which outputs are linearised follow the estimate in a few steps, and stay for the next
        block. Samples that are left out are noted; a block without others changes neither filter nor history.
        """
        t_ns, y = self._t[part], self._y[part]
        found = self.problem.at(rates, t_ns, self._about)
        z, plausible = y - found.expected_mps2, self.problem.plausible_mps2(found.columns)
        before = [judge.excluded for judge in self._judges]
        with self.lock:
            usable = np.column_stack(
                [judge.judge(y[:, i], z[:, i], plausible[:, i]) for i, judge in enumerate(self._judges)]
            )
            if before != [judge.excluded for judge in self._judges]:
                self._take_out()
        rows = _rows(self.problem, found.columns, z, usable)
        for _ in range(_MOST_STEPS):
            about = self._tried(rows)
            if about is None:
                break
            self._about = about
            found = self.problem.at(rates, t_ns, about)
            usable &= np.isfinite(found.expected_mps2)
            rows = _rows(self.problem, found.columns, y - found.expected_mps2, usable)
        with self.lock:
            self._note_unused(t_ns, usable)
            self._note_about(int(t_ns[-1]))
            if len(rows.z):
                self._take(int(t_ns[-1]), rows)

    def _tried(self, rows: _Rows) -> About | None:
        """Return about which delay and arm a block ought to be linearised, by trying it on the filter, which is
        restored.

        None if that is nearly what it was, if the block may be wrong, or is empty.
        """
        if not len(rows.z):
            return None
        with self.lock:  # nobody else sees the filter as it is tried
            kept = self._filter.x, self._filter.P
            innovation = self._updated(rows)
            x, covariance = self.state()
            self._filter.x, self._filter.P = kept
        if innovation.nis > _TRUSTED_NIS * innovation.dof:
            return None
        delay_s = float(np.clip(self.problem.delay(x, covariance)[0], -_LARGEST_S, _LARGEST_S))
        arm_m = self.problem.arm(x, covariance, self._counted())[0]
        near = abs(delay_s - self._about.delay_s) < _SETTLED_S
        if near and np.abs(arm_m - self._about.arm_m).max() < _SETTLED_M:
            return None
        return About(delay_s=delay_s, arm_m=tuple(arm_m.tolist()))

    def _updated(self, rows: _Rows) -> Innovation:
        """Update the filter with rows, and return their innovation.

        It has the normalised innovation of each accelerometer's mean, NaN for one without rows.
        """
        own = self._filter
        own.update(rows.z[:, None], R=np.diag(np.full(len(rows.z), self.noise_mps2**2)), H=rows.h)
        innovation = own.y[:, 0]
        normalised = np.full(len(self.array), np.nan)
        firsts = np.concatenate([[0], np.cumsum(rows.counts)[:-1]])
        for i, (first, count) in enumerate(zip(firsts.tolist(), rows.counts, strict=True)):
            if count:  # the first row is the mean of the block
                normalised[i] = innovation[first] / np.sqrt(own.S[first, first])
        return Innovation(float(innovation @ own.SI @ innovation), len(rows.z), normalised)

    def _take(self, t_ns: int, rows: _Rows) -> None:
        """Update the filter with the rows of a block that ends at ``t_ns``, and add the result to sums and history.

        Of each accelerometer the information of its rows is kept, too: ``_take_out`` makes the filter anew from it.
        """
        innovation = self._updated(rows)
        self._nis_sum += innovation.nis
        self._nis_dof += innovation.dof
        self.recent.append(innovation)
        self.blocks += 1
        first = 0
        for i, count in enumerate(rows.counts):
            own = slice(first, first + count)
            columns = np.column_stack([rows.h[own][:, self.problem.places[i]], rows.z[own]])
            self._kept[i] = np.asarray(np.linalg.qr(np.vstack([self._kept[i], columns]), mode="r"))
            first += count
        delay = self.delay
        self._keep("force_innovation", t_ns, innovation.nis, innovation.dof, innovation.normalised)
        self._keep("force_estimate", t_ns, *self.decoded(), *self.arm(), delay.offset_s, delay.sd_s)

    def _keep(self, group: str, *row: Any) -> None:
        self._history[group].append(*(np.array([value]) for value in row))

    def _take_out(self) -> None:
        """Make the filter anew from what the accelerometers gave that are not excluded.

        All samples of an excluded one count as unused. Sums and history stay as they were.
        """
        self._begin()
        for i, judge in enumerate(self._judges):
            if judge.excluded:
                self._kept[i] = self._kept[i][:0]
                self.unused_ns[i] = [(-(2**62), 2**62)]
            elif len(self._kept[i]):
                counts = [0] * len(self.array)
                counts[i] = len(self._kept[i])
                h = np.zeros((counts[i], len(self.problem.variances)))
                h[:, self.problem.places[i]] = self._kept[i][:, :-1]
                self._updated(_Rows(z=self._kept[i][:, -1], h=h, counts=tuple(counts)))

    def _note_unused(self, t_ns: Stamps, usable: Flags) -> None:
        """Note the spans of samples of each accelerometer that were left out; nothing for one that is excluded."""
        for i, judge in enumerate(self._judges):
            if judge.excluded or usable[:, i].all():
                continue
            edges = np.flatnonzero(np.diff(np.concatenate([[False], ~usable[:, i], [False]]).astype(np.int8)))
            for start, stop in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
                self.unused_ns[i].append((int(t_ns[start]), int(t_ns[stop - 1])))

    def _note_about(self, t_ns: int) -> None:
        """Note about what the samples up to an instant were linearised; the last entry grows if that is unchanged."""
        ends_ns, abouts = self.about
        if abouts[-1:] == [self._about]:
            ends_ns[-1] = t_ns
        else:
            ends_ns.append(t_ns)
            abouts.append(self._about)


def force_array(data: ImuData) -> SensorArray:
    """Return the accelerometers of a source: their axes in the body, those of the body if none are stated."""
    assert data.accel_mps2 is not None
    axes = np.eye(3) if data.accel_axes is None else data.accel_axes
    return accelerometer_array(axes, data.array)


def white_forces(recording: Recording, source: str, live: LiveForces) -> ForceState:
    """Return the parameters of the live filter, estimated from all samples at once under white noise.

    Used are the samples that the filter used, linearised about the same delays and arms. Normal equations at single
    samples share neither blocks nor transforms with the filter.
    """
    table, data = recording.table, recording.sources[source]
    assert table is not None, "specific force is computed from the readings of a table"
    assert data.accel_mps2 is not None, "the filter had samples"
    rates = BodyRates.of(table, recording.site)
    order = np.argsort(data.t_ns, kind="stable")
    t_ns, outputs = data.t_ns[order], data.accel_mps2[order].copy()
    for i, spans in enumerate(live.unused_ns):
        for first_ns, last_ns in spans:
            outputs[np.searchsorted(t_ns, first_ns) : np.searchsorted(t_ns, last_ns, side="right"), i] = np.nan
    inside = (t_ns >= rates.starts_ns) & (t_ns <= rates.final_until_ns)
    t_ns, outputs = t_ns[inside], outputs[inside]
    problem, (ends_ns, abouts) = live.problem, live.about
    information, right = np.diag(1 / problem.variances), np.zeros(len(problem.variances))
    of_row = np.minimum(np.searchsorted(ends_ns, t_ns), max(len(ends_ns) - 1, 0))
    edges = {0, len(t_ns), *range(0, len(t_ns), _CHUNK_ROWS), *(np.flatnonzero(np.diff(of_row)) + 1).tolist()}
    for start, stop in pairwise(sorted(edges)):
        found = problem.at(rates, t_ns[start:stop], abouts[of_row[start]])
        z = outputs[start:stop] - found.expected_mps2
        for i, places in enumerate(problem.places):
            known = np.isfinite(z[:, i])
            columns = found.columns[known, i] / live.noise_mps2
            information[np.ix_(places, places)] += columns.T @ columns
            right[places] += columns.T @ (z[known, i] / live.noise_mps2)
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return ForceState(x=covariance @ right, covariance=covariance)


def _rows(problem: ForceProblem, columns: Floats, z: Floats, usable: Flags) -> _Rows:
    """Return the rows of a block of n samples: of each accelerometer its usable ones, by an orthogonal transform.

    ``columns`` (n, a, c) are the derivatives of the outputs by the c parameters of an accelerometer, ``z`` (n, a) their
    deviations, ``usable`` (n, a) which count. The first row of each is that of the mean; one without usable outputs has
    no rows and count 0.
    """
    outputs, wide, counts = [np.empty(0)], [np.empty((0, len(problem.variances)))], []
    for i, places in enumerate(problem.places):
        own = usable[:, i]
        counts.append(0)
        if not own.any():
            continue
        regressors = np.hstack([np.ones((int(own.sum()), 1)), columns[own, i]])
        turned, r = compressed_rows(regressors, z[own, i])
        h = np.zeros((len(turned), len(problem.variances)))
        h[:, places] = r[:, 1:]
        outputs.append(turned)
        wide.append(h)
        counts[i] = len(turned)
    return _Rows(z=np.concatenate(outputs), h=np.vstack(wide), counts=tuple(counts))
