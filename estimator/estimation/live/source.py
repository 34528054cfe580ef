"""The live filter of one source: samples wait for the table's readings, then feed it block by block.

A session runs it while the table turns; ``filter_nis`` runs it over a recording.
"""

import hashlib
import threading
from collections import deque
from dataclasses import dataclass
from typing import Any, Protocol, Self

import numpy as np

from estimator.calibration.error_model import ErrorModel
from estimator.estimation.live.covered import covered_blocks
from estimator.estimation.live.filter import Innovation, LiveFilter
from estimator.estimation.live.sample_columns import SampleColumns
from estimator.geometry.array import SensorArray
from estimator.geometry.model import Prior, decode
from estimator.observations.blocks import Blocks, BlockSums
from estimator.observations.rows import BLOCK_S
from estimator.observations.timing import expected_sd_s
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.motion.growing_rows import GrowingRows
from estimator.recordings.recording import ImuData, Recording, possible
from estimator.types import Floats, Stamps

RECENT_S = 30.0
"""What ``History.recent`` looks back on, seconds."""

_KEEP_EVERY = 5  # states are kept after so many blocks
_RECENT_BLOCKS = round(RECENT_S / BLOCK_S)
_LARGEST_S = 0.15  # of offsets that are subtracted
_SETTLED_S, _MOST_STEPS = 1e-4, 4


class SampleBlock(Protocol):
    """Samples of one source: instants (n,), rates (n, m), temperatures (n,), NaN where not known."""

    @property
    def t_ns(self) -> Stamps: ...
    @property
    def rate_rps(self) -> Floats: ...
    @property
    def temperature_c(self) -> Floats: ...


class History:
    """What one filter gives in the course of a run: innovations by block, states and sigmas once a second.

    ``recent`` are the innovations of the last half minute; ``blocks`` is their number in all. ``taken_off`` are the
    offsets that were subtracted from the stamps, in s, and the instant up to which each held, in ns.
    """

    def __init__(self, gyros: int) -> None:
        """Begin without innovations and estimates, for so many ``gyros``."""
        self.recent: deque[Innovation] = deque(maxlen=_RECENT_BLOCKS)
        self.blocks = 0
        self.taken_off: tuple[list[int], list[float]] = ([], [])
        self._kept = {
            "innovation": GrowingRows(t_ns=np.int64, nis=(), dof=np.int64, normalised=(gyros,)),
            "estimate": GrowingRows(t_ns=np.int64, states=(gyros, 4), sd=(gyros, 4)),
        }

    def add(self, t_ns: int, offset_s: float, innovation: Innovation) -> None:
        """Keep the innovation of a block, the instant of its last sample and the time offset used in it.

        ``taken_off`` grows by an entry only if the offset changes.
        """
        self.recent.append(innovation)
        self.blocks += 1
        ends_ns, offsets_s = self.taken_off
        if offsets_s[-1:] == [offset_s]:
            ends_ns[-1] = t_ns
        else:
            ends_ns.append(t_ns)
            offsets_s.append(offset_s)
        self._keep("innovation", t_ns, innovation.nis, innovation.dof, innovation.normalised)

    def add_state(self, t_ns: int, states: Floats, sd: Floats) -> None:
        """Keep the states and their sigmas after the last block."""
        self._keep("estimate", t_ns, states, sd)

    def _keep(self, group: str, *row: Any) -> None:
        self._kept[group].append(*(np.array([value]) for value in row))

    def take(self, fewest: int = 1) -> dict[str, dict[str, Any]]:
        """Return by group the columns by name that were kept since the last call, and forget them.

        "innovation" has t_ns, nis, dof, normalised (rows, gyros) of each block, "estimate" t_ns, states, sd (rows,
        gyros, 4) of each second. Empty for fewer than ``fewest`` blocks, which then stay for the next call. A group
        without rows is left out.
        """
        if len(self._kept["innovation"]) < fewest:
            return {}
        return {group: rows.take() for group, rows in self._kept.items() if len(rows)}


class LiveSource:
    """One source of a run: samples not yet used, its filter, the filter's history.

    ``advance`` may work in a thread of its own. Filter and history change by a whole block at once, under ``lock``.
    """

    def __init__(
        self,
        *,
        array: SensorArray,
        rate_hz: float,
        noise_rps: float,
        prior: Prior,
        effects: SampleColumns | None = None,
        timing_s: float = 0.0,
    ) -> None:
        """Begin with the prior; ``noise_rps`` is the data sheet's white noise of one sample, ``rate_hz`` their rate.

        ``effects`` are those of an error model; ``timing_s`` is the uncertainty that the table states of its timing. A
        model that holds a delay takes the place of the time offset.
        """
        self.array = array
        self.prior = prior
        self.noise_rps = np.full(len(array), noise_rps)
        self.effects = effects if effects is not None and effects.count else None
        self.notes = effects.notes if effects is not None else ()
        self.offset_sd_s = 0.0 if effects is not None and effects.holds_delay else expected_sd_s(timing_s)
        further = self.effects.count if self.effects else 0
        self.filter = LiveFilter(array, self.noise_rps, prior, further, self.offset_sd_s)
        self._offset_s = 0.0  # subtracted from the stamps
        self.history = History(len(array))
        self._rows = max(round(BLOCK_S * rate_hz), 1)
        self._period_s = 1 / rate_hz
        self._keeps_blocks = False
        self._sums: BlockSums | None = None
        self._t: Stamps = np.empty(0, dtype=np.int64)
        self._y: Floats = np.empty((0, len(array)))
        self._temperature_c: Floats = np.empty(0)
        self._new: deque[SampleBlock] = deque()
        self.lock = threading.RLock()
        self._recent: tuple[Floats, ...] = ()
        self._recent_at = -1

    def add(self, block: SampleBlock) -> None:
        """Add samples; they are used once the table's readings cover them."""
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
        if start:
            self._t, self._y = self._t[start:], self._y[start:]
            self._temperature_c = self._temperature_c[start:]

    def decoded(self) -> tuple[Floats, Floats]:
        """Return the states (m, 4) and their sigmas."""
        with self.lock:
            x, p = self.filter.state()
        pairs = [decode(xi, pi) for xi, pi in zip(x, p, strict=True)]
        return np.array([s for s, _ in pairs]), np.array([np.sqrt(np.diag(c)) for _, c in pairs])

    def recent(self) -> tuple[Floats, ...]:
        """Return the normalised innovations (n, m) of the blocks of the last half minute, then the values of
        ``decoded``.

        They are computed again only if there were new blocks since.
        """
        with self.lock:
            if self._recent_at != self.history.blocks:
                x = np.array([one.normalised for one in self.history.recent]).reshape(-1, len(self.array))
                self._recent, self._recent_at = (x, *self.decoded()), self.history.blocks
            return self._recent

    def recent_innovations(self) -> tuple[Innovation, ...]:
        """Return the innovations of the last half minute."""
        with self.lock:
            return tuple(self.history.recent)

    def nis(self) -> tuple[float, int]:
        """Return the sum of the normalised innovations squared, and of their degrees of freedom."""
        with self.lock:
            return self.filter.nis_sum, self.filter.nis_dof

    def take_history(self, fewest: int = 1) -> dict[str, dict[str, Any]]:
        """Return ``History.take``, under the lock."""
        with self.lock:
            return self.history.take(fewest)

    def keep_blocks(self) -> None:
        """Sum the rows by block from now on, for estimates under coloured noise."""
        self._keeps_blocks = True

    def blocks(self) -> Blocks:
        """Return the blocks of the rows used so far; none before the first, or if they are not kept."""
        with self.lock:
            return (self._sums or BlockSums(len(self.array), 0, BLOCK_S, self._period_s)).blocks()

    def _sum(self, rates: BodyRates, part: slice) -> None:
        self._sums = self._sums or BlockSums(len(self.array), rates.starts_ns, BLOCK_S, self._period_s)
        t_ns, y = self._t[part], self._y[part]
        w = rates.at(rates.earlier(t_ns, self._offset_s))
        known = np.isfinite(w).all(axis=1)
        self._sums.add(t_ns[known], w[known], y[known] - w[known] @ self.array.p.T)

    def _take_new(self) -> None:
        """Append the samples added since the last call, if any; those with NaN or with impossible rates are left
        out.
        """
        new = [self._new.popleft() for _ in range(len(self._new))]
        if not new:
            return
        t_ns = np.concatenate([block.t_ns for block in new])
        rate, _ = possible(np.vstack([block.rate_rps for block in new]))
        good = np.isfinite(rate).all(axis=1)
        temperature = np.concatenate([block.temperature_c for block in new])
        self._temperature_c = np.concatenate([self._temperature_c, temperature[good]])
        self._t = np.concatenate([self._t, t_ns[good]])
        self._y = np.vstack([self._y, rate[good]])

    def _update(self, rates: BodyRates, part: slice) -> None:
        """Update filter and history with the samples in ``part``; does nothing if no motion is known at them.

        While a ramp shows another time offset than was subtracted, the block is formed again with that offset, at most
        ``_MOST_STEPS`` times. Every second the states are kept. Sums of blocks are formed, too, if these are to be
        kept.
        """
        block = self._block(rates, part)
        for _ in range(_MOST_STEPS):
            # A ramp may show another offset than was subtracted: then the block is formed again with that.
            if block is None or block[3] is None:
                break
            found = float(np.clip(self.filter.tried(*block), -_LARGEST_S, _LARGEST_S))
            if abs(found - self._offset_s) < _SETTLED_S:
                break
            self._offset_s = found
            block = self._block(rates, part)
        if block is None:
            return
        t_ns, history = int(self._t[part.stop - 1]), self.history
        with self.lock:
            innovation = self.filter.update(*block)
            history.add(t_ns, block[4], innovation)
            if history.blocks % _KEEP_EVERY == 0:
                history.add_state(t_ns, *self.decoded())
            if self._keeps_blocks:
                self._sum(rates, part)

    def _block(
        self, rates: BodyRates, part: slice
    ) -> tuple[Floats, Floats, Floats | None, Floats | None, float] | None:
        """Return the arguments of ``LiveFilter.update`` for some samples: rates, outputs, effects, acceleration,
        offset.

        Outputs are less those that the expected effects give. Samples without a known rate, acceleration or needed
        temperature are left out; None if none is left.
        """
        t_ns, y, further = rates.earlier(self._t[part], self._offset_s), self._y[part], None
        w, wdot = rates.at(t_ns), rates.angular_acceleration_at(t_ns)
        if self.effects is not None:
            further, expected = self.effects.at(rates, t_ns, self._temperature_c[part])
            y = y - expected
        known = np.isfinite(w).all(axis=1) & np.isfinite(y).all(axis=1)  # not so: temperatures still to come
        if wdot is not None:
            known &= np.isfinite(wdot).all(axis=1)
        if not known.any():
            return None
        chosen = [None if part is None else part[known] for part in (further, wdot)]
        return w[known], y[known], chosen[0], chosen[1], self._offset_s


def filter_nis(recording: Recording, model: ErrorModel | None = None) -> float | None:
    """Return the mean normalised innovation squared (NIS) per degree of freedom of a recording on a table.

    It is that of blocks of ``BLOCK_S``, under the white noise of the data sheet. If the recording keeps the innovations
    of the filter that ran with it, under the same ``model`` of effects, these are used; otherwise the filter is run
    over all samples. NaN if no sample was used. None if the reference is no table, or a source states no noise.
    ModelError if the table does not fit the model.
    """
    kept = recording.kept_innovations
    if kept is not None and kept.model_sha256 == model_sha256(model):
        return kept.nis_sum / kept.dof if kept.dof else float("nan")
    table = recording.table
    if table is None:
        return None
    if not all(data.noise is not None and data.noise.arw > 0 for data in recording.sources.values()):
        return None
    rates = BodyRates.of(table, recording.site)
    timing_s = table.uncertainty.timing_s if table.uncertainty else 0.0
    total, dof = 0.0, 0
    for data in recording.sources.values():
        assert data.noise is not None
        effects = None
        if model is not None and model.effects:
            effects = SampleColumns(model, table.gimbals, recording.site, data.array)
        rate_hz = _rate_hz(data)
        noise_rps = float(data.noise.arw * np.sqrt(rate_hz))
        source = LiveSource(
            array=data.array, rate_hz=rate_hz, noise_rps=noise_rps, prior=data.prior, effects=effects, timing_s=timing_s
        )
        source.add(_Samples.of(data))
        source.advance(rates, flush=True)
        total += source.filter.nis_sum
        dof += source.filter.nis_dof
    return total / dof if dof else float("nan")


def model_sha256(model: ErrorModel | None) -> str:
    """Return the hash of an error model, empty for none."""
    return hashlib.sha256(model.text().encode()).hexdigest() if model is not None and not model.is_empty else ""


def _rate_hz(data: ImuData) -> float:
    """Return the sample rate of a source in Hz: the stated one, else that of its stamps, else one sample a block."""
    if data.rate_hz is not None:
        return data.rate_hz
    period_s = float(np.median(np.diff(data.t_ns))) * 1e-9 if len(data.t_ns) > 1 else 0.0
    return 1 / period_s if period_s > 0 else 1 / BLOCK_S


@dataclass(frozen=True, slots=True, eq=False)
class _Samples:
    """Samples of a recording in the order of time, as a driver gives them."""

    t_ns: Stamps
    rate_rps: Floats
    temperature_c: Floats

    @classmethod
    def of(cls, data: ImuData) -> Self:
        order = np.argsort(data.t_ns, kind="stable")
        warm = np.full(len(order), np.nan) if data.temperature_c is None else data.temperature_c[order]
        return cls(data.t_ns[order], data.rate_rps[order], warm)
