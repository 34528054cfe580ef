"""Samples of one source on a bus of frames: what arrives piece by piece, put together and timed.

A source has one leading message, which carries its rates. What else belongs to a sample (accelerometer, counter,
time) may be in that message or in others. Frames of one instant win the bus in the order of their identifiers, so
a message of a smaller one is looked for just before the leading frame, a message of a larger one just after it.
"""

from dataclasses import dataclass

import numpy as np

from drivers.arrays import Flags, Floats, Stamps
from drivers.sampling import Alignment, CounterClock, RegularClock
from drivers.seams import ImuBlock, SourceCounts


@dataclass(frozen=True, slots=True)
class Piece:
    """A frame's data with its place in the order of arrival and its arrival in ns."""

    order: int
    t_ns: int
    data: bytes


class Companion:
    """Frames that go with the leading ones: at most one with each."""

    def __init__(self, *, follows: bool) -> None:
        """``follows`` tells whether it comes after the leading frame of its instant, or before it."""
        self.follows = follows
        self._pieces: list[Piece] = []

    def add(self, piece: Piece) -> None:
        """Take in one."""
        self._pieces.append(piece)

    def reached(self, order: int) -> bool:
        """Return whether one has come after this place."""
        return bool(self._pieces) and self._pieces[-1].order > order

    def matched(self, before: int, lead: list[int], after: int) -> tuple[Flags, list[bytes]]:
        """Return which leading frames (n,) have one, and the data of these.

        ``before`` and ``after`` are the places of the leading frames before the first and after the last.
        """
        own = np.array([piece.order for piece in self._pieces], dtype=np.int64)
        edges = np.array([*lead, after] if self.follows else [before, *lead], dtype=np.int64)
        last = np.searchsorted(own, edges[1:]) - 1  # the nearest before the end of each gap
        first = np.searchsorted(own, edges[:-1])
        found = first <= last
        chosen = first if self.follows else last
        return found, [self._pieces[i].data for i in chosen[found]]

    def idle(self) -> None:
        """Drop what no leading frame can have any more, while none has come: all but the newest, or all."""
        self._pieces = [] if self.follows else self._pieces[-1:]

    def forget(self, order: int) -> None:
        """Drop what no leading frame after this place can have; of what is kept for later, only the newest."""
        kept = [piece for piece in self._pieces if piece.order > order]
        self._pieces = kept if self.follows else kept[-1:]


class RegularSamples:
    """Rows of values timed by their own regular rhythm; held back until ``RegularClock`` can tell."""

    def __init__(self, period_s: float, counts: SourceCounts) -> None:
        """Start empty, for rows that come every ``period_s``."""
        self._clock = RegularClock(period_s, counts)
        self._rows: list[Floats] = []
        self._first = 0  # serial number of the first row kept

    @property
    def alignment(self) -> Alignment | None:
        """The sender's clock against the loop's; None in the first seconds."""
        return self._clock.alignment

    def add(self, arrival_ns: Stamps, values: Floats, raw: list[bytes]) -> None:
        """Take in rows (n, k); ``raw`` is what equal samples share."""
        serial = self._first + len(self._rows)
        self._rows.extend(values)
        for i, (t_ns, data) in enumerate(zip(arrival_ns.tolist(), raw, strict=True)):
            self._clock.add(t_ns, float(serial + i), data)

    def restart(self) -> None:
        """Begin anew after a break; nothing must be held any more."""
        self._clock.restart()

    def ready(self, *, everything: bool = False) -> tuple[Stamps, Stamps, Floats] | None:
        """Return (t_ns, arrival_ns, values (n, k)) of the rows that can be timed, or None."""
        if not (everything or self._clock.due):
            return None
        ready = self._clock.ready(everything=everything)
        if ready is None:
            return None
        t_ns, arrival_ns, serial = ready
        chosen = serial.astype(np.int64) - self._first
        values = np.array([self._rows[i] for i in chosen])
        done = int(chosen[-1]) + 1
        del self._rows[:done]
        self._first += done
        return t_ns, arrival_ns, values


class CountedSamples:
    """Rows of values timed by the device's own counter or clock, at once."""

    def __init__(self, clock: CounterClock) -> None:
        """Take the clock with its tick and wrap."""
        self._clock = clock

    @property
    def alignment(self) -> Alignment | None:
        """The device's clock against the loop's; None in the first seconds."""
        return self._clock.alignment

    def block(self, arrival_ns: Stamps, count: Stamps, values: Floats, gyros: int) -> ImuBlock | None:
        """Return the new ones of these rows as a block, or None."""
        if not len(count):
            return None
        new, t_ns = self._clock.stamp(count, arrival_ns)
        if not len(t_ns):
            return None
        return block_of(t_ns, arrival_ns[new], values[new], gyros, count[new])


def block_of(t_ns: Stamps, arrival_ns: Stamps, values: Floats, gyros: int, counter: Stamps | None = None) -> ImuBlock:
    """Return a block of rows: rates of the gyros, temperature, and three accelerations where there are such."""
    accel = values[:, gyros + 1 :] if values.shape[1] > gyros + 1 else None
    return ImuBlock(t_ns, arrival_ns, values[:, :gyros], values[:, gyros], counter, accel)
