"""Rows that grow in place, such as the table readings of a run."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.types import Floats, Stamps


class GrowingRows:
    """Rows of named columns that can be appended without copying everything, and forgotten from the beginning."""

    def __init__(self, **columns: Any) -> None:
        """Start empty; a column is the shape of its rows, or their type if they are no numbers in floating point."""
        self._stores: dict[str, NDArray[Any]] = {
            name: np.empty((256, *what)) if isinstance(what, tuple) else np.empty(256, what)
            for name, what in columns.items()
        }
        self._first, self._end, self._room = 0, 0, 256

    def __len__(self) -> int:
        return self._end - self._first

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._stores[name][self._first : self._end]

    def append(self, *rows: NDArray[Any]) -> None:
        """Append rows, one array for each column in the order of the columns; arrays taken out earlier stay valid."""
        count = len(rows[0])
        if self._end + count > self._room:  # to new arrays, without forgotten rows: views of the old ones stay valid
            self._room = 2 * (len(self) + count)
            for name, store in self._stores.items():
                self._stores[name] = np.empty((self._room, *store.shape[1:]), store.dtype)
                self._stores[name][: len(self)] = store[self._first : self._end]
            self._first, self._end = 0, len(self)
        for store, own in zip(self._stores.values(), rows, strict=True):
            store[self._end : self._end + count] = own
        self._end += count

    def forget(self, count: int) -> None:
        """Drop the first ``count`` rows."""
        self._first += count

    def take(self) -> dict[str, NDArray[Any]]:
        """Return all columns by name, and drop their rows."""
        taken = {name: self[name].copy() for name in self._stores}
        self.forget(len(self))
        return taken


def rows_of_motion(n: int) -> GrowingRows:
    """Return the rows of the motion of n gimbals, none yet.

    ``corner_s`` is the doubt of a corner, NaN for none; ``known`` whether what happened since the row before is. Those
    that begin with ``felt`` are the same for accelerometers (``felt``), ``sharp`` are corners of the ramps in them.
    """
    read: dict[str, Any] = {"t_ns": np.int64, "angle": (n,), "rate": (n,), "summed": (n,), "half_s": (), "measured": ()}
    felt: dict[str, Any] = {"felt_angle": (n,), "felt_rate": (n,), "felt_s": (n,), "sharp": np.bool_}
    return GrowingRows(**read, corner_s=(n,), known=np.bool_, **felt)


def final_rows(n: int) -> GrowingRows:
    """Return the final rows of the motion of n gimbals, none yet: whether it is ``sure`` since the row before."""
    felt: dict[str, Any] = {"felt_angle": (n,), "felt_rate": (n,), "felt_sure": np.bool_, "sharp": np.bool_}
    return GrowingRows(t_ns=np.int64, angle=(n,), rate=(n,), sure=np.bool_, **felt)


def integrated(before: GrowingRows, t_ns: Stamps, rate_rps: Floats) -> tuple[Stamps, Floats, Floats]:
    """Return steps (k,) in ns since the previous row, rates (k + 1, gimbals) from it on, and their integral (k,
    gimbals).

    ``t_ns`` (k,) and ``rate_rps`` (k, gimbals) are the new rows. The previous row is the last of ``before``, whose
    integral goes on, or the first of these rows if that is empty; the first step and integral are then 0.
    """
    last_ns, last_rps, start = t_ns[:1], rate_rps[:1], np.zeros((1, rate_rps.shape[1]))
    if len(before):
        last_ns, last_rps, start = (before[name][-1:] for name in ("t_ns", "rate", "summed"))
    step_ns, rates = np.diff(np.concatenate([last_ns, t_ns])), np.vstack([last_rps, rate_rps])
    area = 0.5 * (rates[1:] + rates[:-1]) * (step_ns * 1e-9)[:, None]
    return step_ns, rates, np.cumsum(np.vstack([start, area]), axis=0)[1:]


def drift_of(before: GrowingRows, drift: Floats) -> Floats:
    """Return by how much the angle is beyond the summed rate (1, gimbals) in the last row of ``before``.

    Without such a row it is the first of ``drift`` (k, gimbals), the same of new rows.
    """
    return before["angle"][-1:] - before["summed"][-1:] if len(before) else drift[:1]
