"""One file of a session by hand: its samples, and where they are in the file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.columns import read_table
from estimator.importing.hands.mapping import PoseMapping
from estimator.importing.log import Log, timed, wanted
from estimator.importing.mapping.mapping import Timing
from estimator.importing.table import Wanted
from estimator.observations.defects.faults import updates
from estimator.types import Floats


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class HandLog:
    """Samples of one file: instants (n,) or None for given means, accelerometers (n, 3), gyros (n, m) if there are.

    ``kept`` (n,) are the rows of ``log`` that they are.
    """

    name: str
    t_s: Floats | None
    force: Floats
    rate_rps: Floats | None
    notes: Sequence[str]
    log: Log | None = None
    kept: NDArray[np.intp] | None = None


def read_log(mapping: PoseMapping, path: Path) -> HandLog:
    """Return the samples of a file; RecordingError if it cannot be used."""
    if mapping.timing is None:
        table = read_table(path, mapping.format, Wanted((), tuple(mapping.names)))
        force = table.values(mapping.accelerometer, "[accelerometer] columns")
        return HandLog(name=path.name, t_s=None, force=force, rate_rps=None, notes=table.notes)
    return _timed(mapping, mapping.timing, path)


def _timed(mapping: PoseMapping, timing: Timing, path: Path) -> HandLog:
    """Return the samples of a file, without rows that lack all accelerometers or only repeat their held values.

    What the gyros have in those rows is dropped too. RecordingError if gyros and accelerometers differ in rows, or
    fewer than two rows have a number of the accelerometers.
    """
    label = mapping.known.cuts.column if mapping.known else None
    table = read_table(path, mapping.format, wanted(timing, mapping.names, (label,) if label else ()))
    force = table.values(mapping.accelerometer, "[accelerometer] columns")
    rate = table.values(mapping.gyro.columns, "[gyro] columns") if mapping.gyro else None
    if rate is not None and len(rate) != len(force):
        raise RecordingError(f"{path.name} has {len(rate)} gyro rows but {len(force)} accelerometer rows")
    log = timed(path, table, timing, mapping.format, force if rate is None else np.hstack([force, rate]))
    rows, t_s = log.time.rows, log.time.t_s
    notes = [f"{path.name}: {note}" for note in [log.time.text, *log.notes]]
    seen = np.isfinite(force[rows]).any(axis=1)
    kept = np.flatnonzero(seen)
    if len(kept) < 2:
        raise RecordingError(f"{path.name} has no number of the accelerometer. Check [accelerometer] columns")
    fresh = updates(force[rows[kept]])
    if fresh is not None and len(fresh) > 1:
        share = len(kept) / len(fresh)
        notes.append(f"{path.name}: the accelerometer is new in one row of {share:.2g}; rows between were skipped")
        kept = kept[fresh]
    rates = None if rate is None else rate[rows[kept]]
    return HandLog(
        name=path.name,
        t_s=t_s[kept],
        force=force[rows[kept]],
        rate_rps=rates,
        notes=notes,
        log=log,
        kept=kept,
    )
