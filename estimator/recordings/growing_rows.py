"""Rows that grow in place: what a run reads of its table."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingRows:
    """Rows of named columns that grow at the end without being copied each time."""

    def __init__(self, **columns: Any) -> None:
        """Start empty; a column is the shape of its rows, or their type if they are no numbers in floating point."""
        self._stores: dict[str, NDArray[Any]] = {
            name: np.empty((256, *what)) if isinstance(what, tuple) else np.empty(256, what)
            for name, what in columns.items()
        }
        self._length, self._room = 0, 256

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self._stores[name][: self._length]

    def append(self, *rows: NDArray[Any]) -> None:
        """Append rows, those of every column in the order of the columns."""
        total = self._length + len(rows[0])
        if total > self._room:
            more = max(total - self._room, self._room)
            for name, store in self._stores.items():
                self._stores[name] = np.concatenate([store, np.empty((more, *store.shape[1:]), store.dtype)])
            self._room += more
        for store, own in zip(self._stores.values(), rows, strict=True):
            store[self._length : total] = own
        self._length = total
