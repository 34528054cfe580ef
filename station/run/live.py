"""The estimate during the run: samples wait for the table's readings, then go to the live filters."""

import threading
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from drivers.types import Floats, ImuBlock, Stamps
from estimator.estimation.live.filter import Innovation
from estimator.estimation.live.forces import LiveForces
from estimator.estimation.live.source import LiveSource
from estimator.geometry.array import accelerometer_names, sensor_array
from estimator.geometry.kinematics import Site, body_rate, gravity_at, into_body
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.motion.growing_rows import GrowingRows
from estimator.recordings.recording import ForceSheet
from estimator.recordings.reference import TableReadings, TableUncertainty
from station.run.table_watch import TableRow

_ROWS_AT_ONCE = 20  # table readings are taken in by handfuls: a second at 20 Hz
_GYRO_BLOCKS = 5  # of the filter of gyros, for one of accelerometers
_FEWEST_PAIRS = 20  # of blocks, for a meaningful correlation
_HELD_NS = 60_000_000_000  # of body rates, for samples that come late


class LiveEstimate:
    """The live estimate of all sources of a run on one table.

    ``advance`` may run in a thread: fitting a ramp takes a quarter of a second, which must not delay readings, the
    journal or a stop.
    """

    def __init__(self, gimbals: tuple[str, ...], site: Site | None) -> None:
        """Start without sources or readings; the caller fills ``sources``.

        ``gimbals`` are named outermost first. Without a ``site`` Earth rate is left out, and gravity is the standard
        one.
        """
        self.rates = BodyRates(gimbals, site)
        self.sources: dict[str, LiveSource] = {}
        self.forces: dict[str, LiveForces] = {}
        """The accelerometers of sources that have a data sheet for them, from their first sample on."""
        self._rows: deque[TableRow] = deque()
        self._working = threading.Lock()
        self._keeping = threading.Lock()
        self._gimbals, self._site = gimbals, site
        self._kept_rows: GrowingRows | None = None
        self._kept_forces: dict[str, list[ImuBlock]] = {}
        self._window_ns = 0

    def add_accelerometers(
        self, name: str, axes: Floats, rate_hz: float, sheet: ForceSheet, uncertainty: TableUncertainty | None
    ) -> None:
        """Add the accelerometers of the source ``name``, which sample at ``rate_hz``.

        ``axes`` (a, 3) are theirs in the body, ``sheet`` is their data sheet, ``uncertainty`` that of the table.
        """
        self.forces[name] = LiveForces(
            array=sensor_array(axes, names=accelerometer_names(len(axes)), part_of_array=True),
            rate_hz=rate_hz,
            sheet=sheet,
            gimbals=self._gimbals,
            gravity=gravity_at(self._site),
            uncertainty=uncertainty,
        )

    def add(self, name: str, block: ImuBlock) -> None:
        """Add samples of a source; they are used once readings cover them."""
        self.sources[name].add(block)
        if name in self.forces:
            self.forces[name].add(block)
            if self._kept_rows is not None:
                self._kept_forces.setdefault(name, []).append(block)

    def take_histories(self, fewest: int) -> Iterator[tuple[str, dict[str, Any]]]:
        """Yield the path of a group of the recording, which ends with a source, and new columns for it; none is kept.

        A source with less than ``fewest`` new blocks of its gyros is left out; of accelerometers a fifth of that is
        enough.
        """
        for name, source in self.sources.items():
            for group, columns in source.take_history(fewest).items():
                yield f"{group}/{name}", columns
        for name, forces in self.forces.items():
            for group, columns in forces.take_history(max(fewest // _GYRO_BLOCKS, 1)).items():
                yield f"{group}/{name}", columns

    def keep_blocks(self) -> None:
        """Keep from now on the data for estimates under coloured noise.

        They are block sums of the sources that are there by now, samples of accelerometers, and readings of the table.
        """
        n = len(self._gimbals)
        self._kept_rows = GrowingRows(t_ns=np.int64, angle=(n,), rate=(n,), half_ns=np.int64)
        for source in self.sources.values():
            source.keep_blocks()

    def kept_forces(self, name: str) -> tuple[Stamps, Floats]:
        """Return the samples of accelerometers kept so far: instants (n,), and outputs (n, a) in m/s2."""
        blocks = [(one.t_ns, one.accel_mps2) for one in self._kept_forces[name] if one.accel_mps2 is not None]
        return np.concatenate([t_ns for t_ns, _ in blocks]), np.vstack([outputs for _, outputs in blocks])

    def readings(self, uncertainty: TableUncertainty | None) -> TableReadings:
        """Return the readings of the table kept so far, with this ``uncertainty``; call ``keep_blocks`` before."""
        assert self._kept_rows is not None
        with self._keeping:
            kept = [self._kept_rows[name] for name in ("t_ns", "angle", "rate", "half_ns")]
        t_ns, angle_rad, rate_rps, half_ns = kept
        return TableReadings(
            t_ns=t_ns,
            angle_rad=angle_rad,
            rate_rps=rate_rps,
            gimbals=self._gimbals,
            uncertainty=uncertainty,
            half_width_ns=half_ns,
            rate_window_ns=self._window_ns,
        )

    def add_row(self, row: TableRow) -> bool:
        """Add a row of table readings; return whether there are enough for ``advance``."""
        self._rows.append(row)
        return len(self._rows) >= _ROWS_AT_ONCE

    def advance(self) -> None:
        """Use the rows, and the samples that they cover; body rates older than a minute are then forgotten."""
        with self._working:
            self._take_rows()
            for source in self.sources.values():
                source.advance(self.rates)
            for forces in tuple(self.forces.values()):  # the first samples of another source may come meanwhile
                forces.advance(self.rates)
            self.rates.forget(self.rates.final_until_ns - _HELD_NS)

    def body_rate(self, row: TableRow) -> Floats:
        """Return the rate of the body (1, 3), in rad/s, as one row of table readings has it."""
        return body_rate(row.angle_rad[None], row.rate_rps[None], self._gimbals, self._site)

    def gravity(self, row: TableRow, gravity_mps2: float) -> Floats:
        """Return the specific force of the body at rest (1, 3), in m/s2, as one row of table readings has it."""
        return into_body(np.array([0.0, 0.0, gravity_mps2]), row.angle_rad[None], self._gimbals)

    def finish(self) -> None:
        """Use all remaining rows and samples, for the end of a run."""
        with self._working:
            self._take_rows()
            self.rates.finish()
            for source in self.sources.values():
                source.advance(self.rates, flush=True)
            for forces in self.forces.values():
                forces.advance(self.rates, flush=True)

    def _take_rows(self) -> None:
        """Move the rows that have arrived into the body rates, and into the kept readings if these are kept.

        Does nothing without rows.
        """
        rows = [self._rows.popleft() for _ in range(len(self._rows))]
        if not rows:
            return
        columns = _columns(rows)
        self.rates.add(*columns)
        with self._keeping:
            if self._kept_rows is not None:
                self._kept_rows.append(*columns[:-1])
            self._window_ns = columns[-1]

    @property
    def notes(self) -> tuple[str, ...]:
        """Effects of an error model that the live estimate leaves out, each once."""
        return tuple(dict.fromkeys(note for s in self.sources.values() for note in s.notes))

    @property
    def nis_mean(self) -> float:
        """Mean normalised innovation squared per degree of freedom over all sources; NaN without innovations."""
        sums = [source.nis() for source in self.sources.values()]
        dof = sum(own for _, own in sums)
        return sum(total for total, _ in sums) / dof if dof else float("nan")

    @property
    def recent(self) -> int:
        """How many innovations the last half minute of all sources has."""
        return sum(one.dof for one in self._recent())

    @property
    def nis_recent(self) -> float:
        """Mean normalised innovation squared per degree of freedom over the last half minute; NaN if there is none."""
        recent = self._recent()
        dof = sum(one.dof for one in recent)
        return sum(one.nis for one in recent) / dof if dof else float("nan")

    def _recent(self) -> list[Innovation]:
        return [one for source in self.sources.values() for one in source.recent_innovations()]

    @property
    def whiteness(self) -> float:
        """Correlation of normalised innovations with those of the previous block, over the last half minute.

        0 for a correct filter, within 1 / sqrt(pairs of blocks); NaN while there are too few.
        """
        recent = [source.recent()[0] for source in self.sources.values()]
        squares = sum(float((x[1:] ** 2).sum() + (x[:-1] ** 2).sum()) / 2 for x in recent)
        if sum(x[1:].size for x in recent) < _FEWEST_PAIRS or not squares:
            return float("nan")
        return sum(float((x[1:] * x[:-1]).sum()) for x in recent) / squares


def _columns(rows: list[TableRow]) -> tuple[Stamps, Floats, Floats, Stamps, int]:
    t_ns, angle_rad, rate_rps, half_width_ns, window_ns = zip(*rows, strict=True)
    stamps = np.array(t_ns, dtype=np.int64), np.array(half_width_ns, dtype=np.int64)
    return stamps[0], np.array(angle_rad), np.array(rate_rps), stamps[1], max(window_ns)
