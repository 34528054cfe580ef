"""Reserved space on a disk: what a file needs to be completed when the disk is full."""

import tempfile
from contextlib import suppress
from pathlib import Path

_PIECE_BYTES = 1 << 16


class Ballast:
    """Disk space reserved by a nameless file in a folder; it is released when the process ends."""

    def __init__(self, folder: Path, size_bytes: int) -> None:
        """Create an empty file in the folder; OSError if that is impossible."""
        self._file = tempfile.TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115  closed by ``close``
        self._size_bytes = size_bytes
        self.held_bytes = 0

    def hold(self) -> bool:
        """Reserve the space, or as much as there is; return whether it is all."""
        with suppress(OSError):
            while self.held_bytes < self._size_bytes:
                piece = bytes(min(_PIECE_BYTES, self._size_bytes - self.held_bytes))
                self.held_bytes += self._file.write(piece) or 0
        return self.held_bytes >= self._size_bytes

    def drop(self) -> None:
        """Return the space to the disk, for the next data."""
        self._file.seek(0)
        self._file.truncate()
        self.held_bytes = 0

    def close(self) -> None:
        """Return the space for good."""
        self._file.close()
        self.held_bytes = 0
