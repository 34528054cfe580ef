"""Rows that grow in place: what a run reads of its table."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingRows:
    """Rows that grow at the end without being copied each time."""

    def __init__(self, shape: tuple[int, ...], dtype: type = np.float64) -> None:
        self._store: NDArray[Any] = np.empty((256, *shape), dtype=dtype)
        self._length = 0

    def __len__(self) -> int:
        return self._length

    @property
    def all(self) -> NDArray[Any]:
        return self._store[: self._length]

    def append(self, rows: NDArray[Any]) -> None:
        total = self._length + len(rows)
        if total > len(self._store):
            grown = np.empty((max(total, 2 * len(self._store)), *self._store.shape[1:]), dtype=self._store.dtype)
            grown[: self._length] = self.all
            self._store = grown
        self._store[self._length : total] = rows
        self._length = total
