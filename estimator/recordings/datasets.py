"""Datasets of a recording: created with their units, and appended to."""

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from estimator.recordings.recording import LAYOUT


def extend(dataset: Any, length: int, rows: NDArray[Any]) -> int:
    """Write rows behind the first ``length`` rows of a dataset, which ends with them; return the new length.

    Rows that it had beyond ``length`` are lost. Uses HDF5 directly, ten times as fast as h5py's indexing.
    """
    rows = np.ascontiguousarray(rows)
    total = length + len(rows)
    dataset.id.set_extent((total, *rows.shape[1:]))
    space = dataset.id.get_space()
    space.select_hyperslab((length, *(0 for _ in rows.shape[1:])), rows.shape)
    dataset.id.write(h5py.h5s.create_simple(rows.shape), space, rows)
    return total


def create(file: Any, path: str, rows: NDArray[Any], *, growing: bool) -> Any:
    """Create and return a dataset of these rows, with the unit that ``LAYOUT`` has for its name, if any.

    ``growing`` makes it extensible. ``path`` is that of the dataset, whose last part is its name.
    """
    row_bytes = max(rows.dtype.itemsize * int(np.prod(rows.shape[1:])), 1)
    chunk = max(min(32768 // row_bytes, 4096), 16)
    extra = {"maxshape": (None, *rows.shape[1:]), "chunks": (chunk, *rows.shape[1:])} if growing else {}
    dataset = file.create_dataset(path, data=rows, **extra)
    name = path.rsplit("/", 1)[-1]
    if unit := LAYOUT.get(name, {}).get("unit"):
        dataset.attrs["units"] = unit
    return dataset
