"""Samples of one source on a bus of frames: assembled from their messages, and timed.

A source has one leading message, which carries its rates. What else belongs to a sample (accelerometer, counter, time)
may be in that message or in others. Frames of one instant win the bus in the order of their identifiers, so a message
of a smaller one is looked for just before the leading frame, a message of a larger one just after it.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from drivers.clocks.sampling import RegularClock
from drivers.types import Flags, Floats, ImuBlock, Stamps


@dataclass(frozen=True, slots=True)
class Piece:
    """The data of a frame with its place in the order of arrival and its arrival time in ns."""

    order: int
    t_ns: int
    data: bytes


class Companion:
    """Frames that belong to the leading ones: at most one to each."""

    def __init__(self, *, follows: bool) -> None:
        """``follows``: the message comes after the leading frame of its instant, else before it."""
        self.follows = follows
        self._pieces: list[Piece] = []

    def add(self, piece: Piece) -> None:
        """Add one message."""
        self._pieces.append(piece)

    def reached(self, order: int) -> bool:
        """Return whether one has come after this place."""
        return bool(self._pieces) and self._pieces[-1].order > order

    def matched(self, before: int, lead: list[int], after: int) -> tuple[Flags, list[bytes]]:
        """Return which leading frames (n,) have a companion, and the data of these companions, as many as are marked.

        Nothing is dropped: see ``forget``. ``lead`` are the places of the leading frames in the order of arrival;
        ``before`` and ``after`` those of the leading frames before the first and after the last. Of several candidates
        the one nearest in time is taken: the first after its frame if the companion follows, else the last before it.
        """
        own = np.array([piece.order for piece in self._pieces], dtype=np.int64)
        edges = np.array([*lead, after] if self.follows else [before, *lead], dtype=np.int64)
        last = np.searchsorted(own, edges[1:]) - 1  # the nearest before the end of each gap
        first = np.searchsorted(own, edges[:-1])
        found = first <= last
        chosen = first if self.follows else last
        return found, [self._pieces[i].data for i in chosen[found]]

    def idle(self) -> None:
        """Drop the messages that no leading frame can match any more: all if they follow it, else all but the
        newest.
        """
        self._pieces = [] if self.follows else self._pieces[-1:]

    def forget(self, order: int) -> None:
        """Drop the messages up to place ``order``, except the newest if later ones may need it."""
        kept = [piece for piece in self._pieces if piece.order > order]
        self._pieces = kept if self.follows else kept[-1:]


def regular_block(
    clock: RegularClock, rows: Iterable[tuple[int, Floats, bytes]], gyros: int, *, flush: bool = False
) -> ImuBlock | None:
    """Add rows (arrival in ns, values, raw bytes) to the clock, and return a block of the samples that can be timed.

    None if there are none. Values are as ``block_of`` expects them, for so many ``gyros``; equal samples have equal raw
    bytes. ``flush`` times the samples that the clock would hold back, too.
    """
    for arrival_ns, values, raw in rows:
        clock.add(arrival_ns, values, raw)
    ready = clock.ready(flush=flush)
    return None if ready is None else block_of(*ready, gyros)


def block_of(t_ns: Stamps, arrival_ns: Stamps, values: Floats, gyros: int, counter: Stamps | None = None) -> ImuBlock:
    """Return a block from rows of values (n, k): rates of the gyros, temperature, then three accelerations if present.

    ``t_ns``, ``arrival_ns`` and ``counter`` (n,) are taken over as they are; the block has views of ``values``. Its
    accelerations are None if the rows have none.
    """
    accel = values[:, gyros + 1 :] if values.shape[1] > gyros + 1 else None
    return ImuBlock(
        t_ns=t_ns,
        arrival_ns=arrival_ns,
        rate_rps=values[:, :gyros],
        temperature_c=values[:, gyros],
        counter=counter,
        accel_mps2=accel,
    )
