"""One external file: its columns, and the instants of the rows that are read."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.errors import RecordingError
from estimator.importing.clocks.timefit import TimeFit, fit_times, regular_times
from estimator.importing.mapping.mapping import FileFormat, Timing
from estimator.importing.table import Table, Wanted
from estimator.types import Floats

_LEAST_STEP_S, _LARGEST_STEP_S = 1e-6, 3600.0  # no samples are nearer or further apart
_LEAST_USUAL_S, _LARGEST_USUAL_S = 5e-5, 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Log:
    """Columns of a file, and the instants of its kept rows."""

    path: Path
    table: Table
    time: TimeFit

    @property
    def notes(self) -> list[str]:
        """Notes of its table, and on skipped lines, duplicate rows and an unusual step of its samples, as far as there
        are any.
        """
        table, notes = self.table, [*self.table.notes]
        if table.skipped_lines:
            lines = "line is" if table.skipped_lines == 1 else "lines are"
            notes.append(f"{table.skipped_lines} broken {lines} skipped, the first is {table.first_skipped}")
        if self.time.doubled:
            notes.append(f"{self.time.doubled} duplicate rows were skipped")
        if not _LEAST_USUAL_S < (step_s := self.time.step_s) < _LARGEST_USUAL_S:
            notes.append(
                f"its samples are {step_s:.3g} s apart according to [time]. If that is wrong, correct its unit"
            )
        return notes


def wanted(timing: Timing, columns: Sequence[str], labels: tuple[str, ...] = ()) -> Wanted:
    """Return the columns wanted of a file: its stamps, or the variable of its rate, then ``columns`` and ``labels``.

    Only ``columns`` may be blank.
    """
    needed = timing.stamps.names if timing.stamps else (timing.rate,) if isinstance(timing.rate, str) else ()
    return Wanted(needed, tuple(columns), labels, timing.calendar)


def timed(path: Path, table: Table, timing: Timing, file_format: FileFormat, values: Floats) -> Log:
    """Return a file with the instants of the part to read, as ``file_format`` limits it.

    ``values`` (rows, c) are all measured columns of ``table``. By them repeated rows are found, which are left out;
    rows stay numbered as in ``table``. RecordingError, naming the file, if fewer than two rows are left, or stamps are
    invalid or fewer than eight.
    """
    position = np.arange(len(values)) if table.position is None else table.position
    part = file_format
    read = np.flatnonzero((position >= part.from_row) & (position < part.until_row))
    if len(read) < 2:
        check = "check from_row and until_row in [file]" if len(read) < len(values) else "record more"
        raise RecordingError(f"{table.name} has {len(values)} row{'s' * (len(values) != 1)} to read: {check}")
    time = _all_times(timing, table, position, read, values)
    kept = (time.t_s >= part.from_s) & (time.t_s <= part.until_s)
    if kept.sum() < 2:
        raise RecordingError(f"{table.name} lasts {time.t_s[-1]:.6g} s. Check from_s and until_s in [file]")
    other_s = None if time.other_s is None else time.other_s[kept]
    return Log(path, table, replace(time, t_s=time.t_s[kept], rows=read[time.rows][kept], other_s=other_s))


def _all_times(
    timing: Timing, table: Table, position: NDArray[np.int64], read: NDArray[np.intp], values: Floats
) -> TimeFit:
    """Return the instants of the rows ``read``, from stamps or a sample rate, fixed or a variable of the file.

    ``position`` (rows,) numbers all rows, lost ones included; ``values`` (rows, c) are the measured columns.
    RecordingError if stamps are invalid, of another number than the rows, or implausibly close or far apart, or the
    rate is not positive.
    """
    if timing.stamps is not None:
        stamps = table.values(timing.stamps, "[time] column")[:, 0]
        if timing.wraps_at < np.inf:
            stamps = np.unwrap(stamps, period=timing.wraps_at * timing.stamps.scale)
        if len(stamps) != len(values):
            raise RecordingError(f"{table.name} has {len(values)} rows but {len(stamps)} stamps")
        try:
            fit = fit_times(stamps[read], values[read], position[read])
        except RecordingError as error:
            raise RecordingError(f"{table.name} {error}") from None
        if not _LEAST_STEP_S < fit.step_s < _LARGEST_STEP_S:
            raise RecordingError(
                f"{table.name}: its samples are {fit.step_s:.6g} s apart according to [time]. Correct its unit"
            )
        return fit
    rate_hz = table.number(timing.rate) if isinstance(timing.rate, str) else timing.rate
    if rate_hz <= 0:
        raise RecordingError(f"{table.name}: {timing.rate} is {rate_hz}, not a sample rate in Hz")
    return regular_times(position[read], rate_hz)
