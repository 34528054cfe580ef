"""What the twins of controllers that speak lines of text have in common: bytes to lines, and a watchdog."""

from collections.abc import Callable

from sims.table import TableModel
from sims.watchdog import Watchdog


class LineController:
    """Takes bytes from the host as they come and writes the answers at once, in order."""

    ends, skipped, longest = b"\r", b"\n", 80
    """Which bytes end a line, which mean nothing, and how long a line may be."""

    def __init__(self, table: TableModel, write: Callable[[bytes], None], watchdog_s: float) -> None:
        """``watchdog_s`` of silence stops the axes (0: never)."""
        self._write = write
        self._line, self._too_long = b"", False
        self._watchdog = Watchdog(table.clock, watchdog_s, self._master_is_silent)

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""
        for byte in data:
            if byte in self.ends:
                line, self._line = self._line, b""
                self._answer(line.decode("ascii", "replace"))
                self._too_long = False
            elif byte not in self.skipped:
                self._too_long |= len(self._line) >= self.longest
                self._line = (self._line + bytes([byte]))[: self.longest]
        self._watchdog.heard(self._is_powered())

    def hung_up(self) -> None:
        """Forget the line that a connection was lost in the middle of."""
        self._line, self._too_long = b"", False

    def _answer(self, line: str) -> None:
        """Carry out a line and answer it; of one that was ``_too_long`` only the beginning is given."""
        raise NotImplementedError

    def _is_powered(self) -> bool:
        """Return whether silence of the master matters now."""
        raise NotImplementedError

    def _master_is_silent(self) -> None:
        """Stop the axes."""
        raise NotImplementedError
