"""Child process that reads every dataset of HDF5 files, so that a damaged one harms nobody else.

A line of JSON for each file: its path comes in, and why it cannot be read goes out, null if it can. Ends with its
input.
"""

import json
import sys
from pathlib import Path
from typing import Any

import h5py


def read_all(path: Path) -> str | None:
    """Return why the file cannot be read, or None."""
    try:
        if path.stat().st_size == 0:
            return "it is empty"
        if not h5py.is_hdf5(path):
            return "it is not an HDF5 file; bring foreign data in with `station import`"
        with h5py.File(path, "r") as file:

            def visit(_name: str, item: Any) -> None:
                if isinstance(item, h5py.Dataset):
                    for start in range(0, len(item) if item.shape else 0, 65536):
                        item[start : start + 65536]

            file.visititems(visit)
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        return f"it is damaged or cut short ({str(error).splitlines()[0] if str(error) else 'no detail'})"
    return None


if __name__ == "__main__":
    for line in sys.stdin:
        print(json.dumps(read_all(Path(json.loads(line)))), flush=True)
