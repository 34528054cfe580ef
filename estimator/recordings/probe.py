"""Child process that reads files completely, so that a damaged one harms no other process.

A line of JSON for each: its kind and path come in, and why it cannot be read goes out, null if it can. Ends with its
input, and without an answer if a file kills its reader. What follows an unreadable file is read by a new process, as
libraries are not to be trusted after one: a fork of a process that has never read any, where there are forks.
"""

import json
import math
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import h5py

_MOST_MEMORY_BYTES = 1 << 30
_FREE_BYTES, _MOST_TIMES = 1 << 26, 30
"""What datasets may hold in all: so much, and beside it so many times what the file takes on its disk."""
_ROWS = 65536  # read at once
_UNREADABLE = 3  # exit code of a reader after a file that it could not read


def read_hdf5(path: Path) -> str | None:
    """Read a whole HDF5 file; return why it is unreadable, None if it is fine.

    ValueError as ``objects``; OSError of HDF5 for damaged content.
    """
    if path.stat().st_size == 0:
        return "it is empty"
    if not h5py.is_hdf5(path):
        return "it is not an HDF5 file. Import external data with `station import`"
    with h5py.File(path, "r") as file:
        for dataset in objects(path, file):
            for start in range(0, len(dataset) if dataset.shape else 0, _ROWS):
                dataset[start : start + _ROWS]
    return None


def objects(path: Path, file: Any, names: Callable[[Any], Sequence[str]] | None = None) -> Iterator[Any]:
    """Yield the datasets of an open file, each once; attributes are read as well.

    ValueError for data in other files, or sizes that cannot be true for a file as large as ``path``. With ``names``
    only the objects that it returns for the file are checked, without reading attributes, which is 15 times faster.
    """
    disk = path.stat()
    left = _FREE_BYTES + _MOST_TIMES * getattr(disk, "st_blocks", disk.st_size // 512 + 1) * 512  # a hole is no data
    links: dict[bytes, int] = {b".": h5py.h5l.TYPE_HARD}
    file.id.links.visit(lambda name, link: links.update({name: link.type}), info=True)
    for name, kind in links.items():
        if kind not in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT):
            raise ValueError(f"{name.decode(errors='replace')} is in another file; only the data in this file are read")
    hard = (name for name, kind in links.items() if kind == h5py.h5l.TYPE_HARD)  # a soft one leads to another of them
    for name in map(str.encode, names(file)) if names else hard:
        item = file[name]
        if isinstance(item, h5py.Dataset) and (item.is_virtual or item.external):
            raise ValueError(f"{name.decode(errors='replace')} is in another file; only the data in this file are read")
        left -= sum(h5py.h5a.get_info(item.id, index=at).data_size for at in range(len(item.attrs)))
        if isinstance(item, h5py.Dataset):
            left -= math.prod(item.shape or ()) * max(int(item.id.get_type().get_size()), 1)
        if left < 0:
            raise ValueError(
                f"it claims to hold far more data than its size allows, in {name.decode(errors='replace')}"
            )
        if not names:
            dict(item.attrs)
        if isinstance(item, h5py.Dataset):
            yield item


def read_mat(path: Path) -> str | None:
    """Read a whole MATLAB file; return why it is of a kind that is not read, None if it is fine.

    scipy's exceptions for a damaged file pass through.
    """
    from scipy.io import loadmat

    try:
        loadmat(str(path), squeeze_me=False)
    except NotImplementedError:
        return "it is a MATLAB 7.3 file. Save it with -v7"
    return None


def read_all(kind: str, path: Path) -> str | None:
    """Return why a file of this kind cannot be read, or None."""
    try:
        return {"HDF5": read_hdf5, "MATLAB": read_mat}[kind](path)
    except Exception as error:  # libraries raise any exception of their decoders for a damaged file: zlib.error, ...
        said = str(error).splitlines()[0] if str(error) else "no detail"
        return f"it is {'' if kind == 'HDF5' else f'no {kind} file, or '}damaged or cut short ({said})"


def answer() -> int:
    """Answer until the input ends, or a file cannot be read; return ``_UNREADABLE`` for the latter, else 0."""
    for line in sys.stdin:
        kind, path = json.loads(line)
        reason = read_all(kind, Path(path))
        print(json.dumps(reason), flush=True)
        if reason is not None:
            return _UNREADABLE
    return 0


def answer_in_forks() -> None:
    """Answer by one fork after another until the input ends, or one dies of a file."""
    ended_with = _UNREADABLE
    while ended_with == _UNREADABLE:
        reader = os.fork()
        if reader == 0:
            os._exit(answer())
        ended_with = os.waitstatus_to_exitcode(os.waitpid(reader, 0)[1])


if __name__ == "__main__":
    if os.name == "posix":
        import resource

        resource.setrlimit(resource.RLIMIT_DATA, (_MOST_MEMORY_BYTES, _MOST_MEMORY_BYTES))
        answer_in_forks()
    else:
        answer()
