"""Common parts of twins with a request language: lines, numbers, refusals, and the controller's watchdog."""

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from sims.physics.table import TableModel


class Refused(Exception):
    """A command or request that a device refuses, with the code of its protocol."""

    def __init__(self, code: int) -> None:
        """Keep the code."""
        super().__init__(code)
        self.code = code


class LineDevice:
    """Collects bytes from the host into lines and answers each at once, in order."""

    ends, skipped, longest = b"\r", b"", 80
    """Which bytes end a line, which mean nothing, and how long a line may be."""

    def __init__(self, write: Callable[[bytes], None]) -> None:
        """Answer by ``write``."""
        self._write = write
        self._line, self._too_long = b"", False

    def received(self, data: bytes) -> None:
        """Add bytes and handle each line that they complete; characters beyond ``longest`` are dropped and noted.

        Those in ``skipped`` are ignored.
        """
        for byte in data:
            if byte in self.ends:
                line, self._line = self._line, b""
                self._take(line)
                self._too_long = False
            elif byte not in self.skipped:
                self._too_long |= len(self._line) >= self.longest
                self._line = (self._line + bytes([byte]))[: self.longest]

    def hung_up(self) -> None:
        """Forget the line that a connection was lost in the middle of."""
        self._line, self._too_long = b"", False

    def _take(self, line: bytes) -> None:
        """Obey a line; of one that was ``_too_long`` only the beginning is given."""
        raise NotImplementedError


class Watchdog:
    """Calls back after a period of silence while armed."""

    def __init__(
        self, clock: Callable[[], float], silence_s: float | Callable[[], float], expired: Callable[[], None]
    ) -> None:
        """Watch for ``silence_s`` of silence, a number or a function that gives the present one; 0: never.

        ``clock`` gives seconds; ``expired`` is called after the silence. Disarmed at first.
        """
        self._clock, self._expired = clock, expired
        self._silence_s = silence_s if callable(silence_s) else lambda: silence_s
        self._heard_s = clock()
        self._watching = False
        self._armed = False

    def heard(self, armed: bool) -> None:
        """Note that the master has sent something, and whether its silence matters now."""
        self._heard_s, self._armed = self._clock(), armed
        if armed and not self._watching and (silence_s := self._silence_s()):
            self._watch(silence_s)

    def _watch(self, for_s: float) -> None:
        self._watching = True
        asyncio.get_running_loop().call_later(for_s, self._look)

    def _look(self) -> None:
        """Call back if the silence has lasted for its limit, else look again when it would have.

        Nothing, and no look again, if disarmed or without a limit. After the call it watches again from the next
        ``heard`` on.
        """
        self._watching = False
        silence_s = self._silence_s()
        remaining_s = self._heard_s + silence_s - self._clock()
        if not self._armed or not silence_s:
            return
        if remaining_s > 1e-9:
            self._watch(remaining_s)
        else:
            self._expired()


@dataclass(frozen=True, slots=True)
class TableTwinSetup:
    """A controller in front of the simulated table.

    ``addresses`` are those of its axes, outermost first, ``options`` the protocol's keys in the bench file.
    ``watchdog_s`` of silence stops the axes (0: never). ``number`` counts controllers of the same kind from 0.
    ``cycle_s`` is how often a drive samples its controlword (0: at once).
    """

    table: TableModel
    addresses: Mapping[str, Any]
    options: Mapping[str, Any]
    watchdog_s: float
    number: int = 0
    cycle_s: float = 0.0


class LineController(LineDevice):
    """A controller that stops its axes when its master falls silent."""

    skipped = b"\n"

    def __init__(self, setup: TableTwinSetup, write: Callable[[bytes], None]) -> None:
        """Stand where the table is."""
        super().__init__(write)
        self._watchdog = Watchdog(setup.table.clock, setup.watchdog_s, self._master_is_silent)

    def received(self, data: bytes) -> None:
        """Take bytes from the host, cut anywhere."""
        super().received(data)
        self._watchdog.heard(self._is_powered())

    def _is_powered(self) -> bool:
        """Return whether silence of the master matters now."""
        raise NotImplementedError

    def _master_is_silent(self) -> None:
        """Stop the axes."""
        raise NotImplementedError


def number(text: str, refusal: Exception) -> float:
    """Return the finite number in ``text``; raise ``refusal`` if it is none."""
    try:
        value = float(text)
    except ValueError:
        raise refusal from None
    if not math.isfinite(value):
        raise refusal
    return value
