"""Whether memory suffices for work on a recording, checked before it begins."""

from contextlib import suppress
from pathlib import Path

import psutil

from estimator.errors import RecordingError
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import Reference
from estimator.recordings.writing import columns_of

READING, ESTIMATING = 3, 13
"""Memory that is needed at most, as a multiple of the columns of a recording (tests/bench/large.py)."""
_SMALL_BYTES = 50_000_000  # of columns, for which there is memory wherever this runs
_GROUP = Path("/sys/fs/cgroup")


def check_memory(name: object, columns_bytes: int, times: int) -> None:
    """Raise RecordingError if there is not ``times`` as much free memory as columns of ``columns_bytes`` take.

    ``name`` is for the message. Columns below 50 MB are not checked.
    """
    needed_bytes = times * columns_bytes
    if columns_bytes < _SMALL_BYTES or needed_bytes < (free_bytes := _free_bytes()):
        return
    raise RecordingError(
        f"{name} holds {columns_bytes / 1e9:.2g} GB of samples and readings: this needs about {needed_bytes / 1e9:.2g} "
        f"GB of memory, and {free_bytes / 1e9:.2g} GB are free; use a computer with more, or shorter recordings"
    )


def check_estimating(*recordings: Recording) -> None:
    """Raise RecordingError, with the memory needed, if it does not suffice to estimate from all of these at once."""
    held: list[ImuData | Reference] = []
    for recording in recordings:
        held += [recording.reference, *recording.sources.values()]
    columns_bytes = sum(column.nbytes for part in held for column in columns_of(part).values())
    check_memory(", ".join(recording.name for recording in recordings), columns_bytes, ESTIMATING)


def _free_bytes() -> int:
    """Return the memory available to this process: of the computer, and of its control group (Linux)."""
    free_bytes = int(psutil.virtual_memory().available)
    with suppress(OSError, ValueError):  # no group, or no limit
        limit, used = (int((_GROUP / f"memory.{what}").read_text()) for what in ("max", "current"))
        free_bytes = min(free_bytes, limit - used)
    return free_bytes
