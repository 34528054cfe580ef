"""The estimate while the run goes on: samples wait for the table's readings, then feed the live filters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drivers.arrays import Floats, Stamps
from drivers.seams import ImuBlock
from estimator.array import SensorArray
from estimator.blocks import Blocks, BlockSums
from estimator.filter import LiveFilter
from estimator.kinematics import Site
from estimator.model import Prior, decode
from estimator.reference import BodyRates, TableReadings, TableUncertainty
from estimator.rows import BLOCK_S
from estimator.sample_columns import SampleColumns
from station.table_watch import TableRow

RECENT_S = 30.0
"""What ``nis_recent`` and ``whiteness`` look back on, seconds."""

_KEEP_EVERY = 5  # states are kept every so many-th block
_ROWS_AT_ONCE = 20  # table readings are taken in by handfuls: a second at 20 Hz
_RECENT_BLOCKS = round(RECENT_S / BLOCK_S)
_FEWEST_PAIRS = 20  # of blocks, for a correlation that says anything


@dataclass(slots=True, eq=False)
class History:
    """What one filter said as it went: innovations by block, states and sigmas once a second."""

    t_ns: list[int] = field(default_factory=list)
    nis: list[float] = field(default_factory=list)
    dof: list[int] = field(default_factory=list)
    normalised: list[Floats] = field(default_factory=list)
    state_t_ns: list[int] = field(default_factory=list)
    states: list[Floats] = field(default_factory=list)
    sd: list[Floats] = field(default_factory=list)


@dataclass(frozen=True, slots=True, eq=False)
class Recent:
    """What one filter said in the last half minute, and where its states are now.

    ``nis`` and ``dof`` are sums over the blocks; ``by_gyro`` (m,) is the mean square of each gyro's normalised
    innovation; ``products`` sums those of each block with those of the block before (``pairs`` of them), ``squares``
    what they are to be compared with. ``states`` and ``sd`` (m, 4) are decoded.
    """

    nis: float
    dof: int
    by_gyro: Floats
    products: float
    squares: float
    pairs: int
    states: Floats
    sd: Floats


class LiveSource:
    """One source: samples not yet used, its filter, what the filter said."""

    def __init__(
        self, array: SensorArray, rate_hz: float, noise_rps: float, prior: Prior, effects: SampleColumns | None = None
    ) -> None:
        """``noise_rps`` is the data sheet's white noise of one sample; ``effects`` are those of an error model."""
        self.array = array
        self.prior = prior
        self.noise_rps = np.full(len(array), noise_rps)
        self.effects = effects if effects is not None and effects.count else None
        self.notes = effects.notes if effects is not None else ()
        self.filter = LiveFilter(array, self.noise_rps, prior, self.effects.count if self.effects else 0)
        self.history = History()
        self._rows = max(round(BLOCK_S * rate_hz), 1)
        self._period_s = 1 / rate_hz
        self._keeps_blocks = False
        self._sums: BlockSums | None = None
        self._t: Stamps = np.empty(0, dtype=np.int64)
        self._y: Floats = np.empty((0, len(array)))
        self._temperature_c: Floats = np.empty(0)
        self._new: list[ImuBlock] = []
        self._recent: Recent | None = None
        self._recent_at = -1

    def add(self, block: ImuBlock) -> None:
        """Take in samples."""
        self._new.append(block)

    def advance(self, rates: BodyRates, *, everything: bool = False) -> None:
        """Use the samples that the table's readings cover, in whole blocks, at the end also the last part."""
        self._take_new()
        early = int(np.searchsorted(self._t, rates.starts_ns, side="left"))
        ready = int(np.searchsorted(self._t, rates.final_until_ns, side="right"))
        whole = ready if everything else early + max(ready - early, 0) // self._rows * self._rows
        if whole > early:
            w = rates.at(self._t[early:whole])
            if self._keeps_blocks:
                self._sum(rates.starts_ns, w, self._t[early:whole], self._y[early:whole])
            y, further = self._y[early:whole], None
            if self.effects is not None:
                further, expected = self.effects.at(rates, self._t[early:whole], self._temperature_c[early:whole])
                y = y - expected
            for start in range(0, whole - early, self._rows):
                part = slice(start, min(start + self._rows, whole - early))
                self._update(int(self._t[early + part.stop - 1]), w[part], y[part], further, part)
        start = max(whole, early)
        if start:
            self._t, self._y = self._t[start:], self._y[start:]
            self._temperature_c = self._temperature_c[start:]

    def decoded(self) -> tuple[Floats, Floats]:
        """Return the states (m, 4) and their sigmas."""
        x, p = self.filter.state()
        pairs = [decode(xi, pi) for xi, pi in zip(x, p, strict=True)]
        return np.array([s for s, _ in pairs]), np.array([np.sqrt(np.diag(c)) for _, c in pairs])

    def recent(self) -> Recent:
        """Return what the filter said lately; worked out once for each handful of blocks."""
        count = len(self.history.t_ns)
        if self._recent is None or self._recent_at != count:
            self._recent, self._recent_at = self._work_out_recent(), count
        return self._recent

    def _work_out_recent(self) -> Recent:
        last = slice(-_RECENT_BLOCKS, None)
        states, sd = self.decoded()
        x = np.array(self.history.normalised[last]).reshape(-1, len(self.array))
        return Recent(
            nis=sum(self.history.nis[last]),
            dof=sum(self.history.dof[last]),
            by_gyro=np.asarray((x**2).mean(axis=0)) if len(x) else np.full(len(self.array), np.nan),
            products=float((x[1:] * x[:-1]).sum()),
            squares=float((x[1:] ** 2).sum() + (x[:-1] ** 2).sum()) / 2,
            pairs=x[1:].size,
            states=states,
            sd=sd,
        )

    def keep_blocks(self) -> None:
        """Sum the rows by block from now on, for estimates under coloured noise."""
        self._keeps_blocks = True

    def blocks(self) -> Blocks:
        """Return the blocks of the rows used so far; none before the first, or if they are not kept."""
        return (self._sums or BlockSums(len(self.array), 0, BLOCK_S, self._period_s)).blocks()

    def _sum(self, origin_ns: int, w: Floats, t_ns: Stamps, y: Floats) -> None:
        self._sums = self._sums or BlockSums(len(self.array), origin_ns, BLOCK_S, self._period_s)
        known = np.isfinite(w).all(axis=1)
        self._sums.add(t_ns[known], w[known], y[known] - w[known] @ self.array.p.T)

    def _take_new(self) -> None:
        """Join what has come; samples that the device calls invalid (NaN) are left out."""
        if not self._new:
            return
        t_ns = np.concatenate([block.t_ns for block in self._new])
        rate = np.vstack([block.rate_rps for block in self._new])
        good = np.isfinite(rate).all(axis=1)
        temperature = np.concatenate([block.temperature_c for block in self._new])
        self._temperature_c = np.concatenate([self._temperature_c, temperature[good]])
        self._new.clear()
        self._t = np.concatenate([self._t, t_ns[good]])
        self._y = np.vstack([self._y, rate[good]])

    def _update(self, t_ns: int, w: Floats, y: Floats, further: Floats | None, part: slice) -> None:
        known = np.isfinite(w).all(axis=1)
        if further is not None:
            known &= np.isfinite(y).all(axis=1)  # effects of a temperature that has not come yet
        if not known.any():
            return
        innovation = self.filter.update(w[known], y[known], None if further is None else further[part][known])
        history = self.history
        history.t_ns.append(t_ns)
        history.nis.append(innovation.nis)
        history.dof.append(innovation.dof)
        history.normalised.append(innovation.normalised)
        if len(history.t_ns) % _KEEP_EVERY == 0:
            states, sd = self.decoded()
            history.state_t_ns.append(t_ns)
            history.states.append(states)
            history.sd.append(sd)


class LiveEstimate:
    """All sources of a run on one table."""

    def __init__(self, gimbals: tuple[str, ...], site: Site | None) -> None:
        """Start without sources."""
        self.rates = BodyRates(gimbals, site)
        self.sources: dict[str, LiveSource] = {}
        self._rows: list[TableRow] = []
        self._gimbals = gimbals
        self._kept_rows: list[TableRow] | None = None

    def keep_blocks(self) -> None:
        """Keep from now on what estimates under coloured noise need: sums of rows by block, readings of the table."""
        self._kept_rows = []
        for source in self.sources.values():
            source.keep_blocks()

    def readings(self, uncertainty: TableUncertainty | None) -> TableReadings:
        """Return the readings of the table that have been kept."""
        t_ns, angle_rad, rate_rps, half_width_ns = _columns(self._kept_rows or [])
        return TableReadings(t_ns, angle_rad, rate_rps, self._gimbals, uncertainty, half_width_ns)

    def add_row(self, row: TableRow) -> None:
        """Take in one row of table readings; now and then use the samples that they cover."""
        self._rows.append(row)
        if self._kept_rows is not None:
            self._kept_rows.append(row)
        if len(self._rows) >= _ROWS_AT_ONCE:
            self._take_rows()
            for source in self.sources.values():
                source.advance(self.rates)

    def finish(self) -> None:
        """Use what is left."""
        self._take_rows()
        self.rates.finish()
        for source in self.sources.values():
            source.advance(self.rates, everything=True)

    def _take_rows(self) -> None:
        if self._rows:
            self.rates.add(*_columns(self._rows))
            self._rows.clear()

    @property
    def notes(self) -> tuple[str, ...]:
        """Which effects of an error model the live estimate goes without, each once."""
        return tuple(dict.fromkeys(note for s in self.sources.values() for note in s.notes))

    @property
    def nis_mean(self) -> float:
        """Mean normalised innovation squared per degree of freedom over all sources."""
        total = sum(s.filter.nis_sum for s in self.sources.values())
        dof = sum(s.filter.nis_dof for s in self.sources.values())
        return total / dof if dof else float("nan")

    @property
    def nis_recent(self) -> float:
        """Mean normalised innovation squared per degree of freedom over the last half minute of all sources."""
        recent = [source.recent() for source in self.sources.values()]
        dof = sum(r.dof for r in recent)
        return sum(r.nis for r in recent) / dof if dof else float("nan")

    @property
    def whiteness(self) -> float:
        """Correlation of normalised innovations with those of the block before, over the last half minute.

        0 for a filter that is right, within 1 / sqrt(pairs of blocks); NaN before there are enough.
        """
        recent = [source.recent() for source in self.sources.values()]
        squares = sum(r.squares for r in recent)
        if sum(r.pairs for r in recent) < _FEWEST_PAIRS or not squares:
            return float("nan")
        return sum(r.products for r in recent) / squares


def _columns(rows: list[TableRow]) -> tuple[Stamps, Floats, Floats, Stamps]:
    t_ns, angle_rad, rate_rps, half_width_ns = zip(*rows, strict=True)
    stamps = np.array(t_ns, dtype=np.int64), np.array(half_width_ns, dtype=np.int64)
    return stamps[0], np.array(angle_rad), np.array(rate_rps), stamps[1]
