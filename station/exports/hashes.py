"""SHA-256 of a file, and of the samples in a recording whatever else is written into it later."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np

_RAW = ("imu", "table", "reference")
_NUMBERS = "biuf"

RAW_RULE = (
    "over the datasets of numbers below /imu, /reference and /table, sorted by their paths: of each its path in "
    "UTF-8, a line feed, and its values in little-endian order, row by row"
)
"""How the hash of the raw data is formed, in words."""


def file_sha256(path: Path) -> str:
    """Return the hash of a whole file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def raw_sha256(path: Path) -> str:
    """Return the hash of what was measured, as ``RAW_RULE`` says: estimates and attributes do not change it."""
    import h5py

    found = hashlib.sha256()
    with h5py.File(path, "r") as file:
        names: list[str] = []

        def note(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and name.partition("/")[0] in _RAW and item.dtype.kind in _NUMBERS:
                names.append(name)

        file.visititems(note)
        for name in sorted(names):
            values = file[name][()]
            found.update(f"/{name}\n".encode())
            found.update(np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False)).data)
    return found.hexdigest()
