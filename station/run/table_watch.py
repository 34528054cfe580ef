"""Reads the table regularly, puts its readings on common instants, and watches over its condition."""

import asyncio
import itertools
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from drivers.errors import LinkLost
from drivers.protocols import Turntable
from drivers.types import AxisState, Floats
from station.run.sequencer import Sequencer
from station.run.uncommanded import MotionGuard, check_axes

_STATUS_EVERY = 5  # the condition is read with every so many-th reading
_STATUS_AT_LATEST_S = 0.6  # and on a slow link before a drive stops for lack of messages
_IDLE_S = 0.4  # so often each axis without a command is read: it may turn by itself
_KEPT = 5  # readings before that a mean rate is judged by
_WELL_NS = 1e6  # to which an instant needs to be known


class TableRow(NamedTuple):
    """Angles and rates (axes,) at one instant, which may be off by the half width of the round trips.

    Rates are means over the ``rate_window_ns`` that ends at that instant.
    """

    t_ns: int
    angle_rad: Floats
    rate_rps: Floats
    half_width_ns: int
    rate_window_ns: int = 0


class Aligner:
    """Combines readings of single axes, each at its own instant, into rows at a common instant.

    The instant of a row is that of the fastest axis' rate; angles are carried there by the rate, rates by interpolation
    between readings. A row is complete one reading later, when the rates around it are known. Mean rates are those up
    to the angle of the fastest axis; there is no row while they include time before the first reading.
    """

    def __init__(self, axes: tuple[str, ...]) -> None:
        """Columns are ordered as ``axes``."""
        self._axes = axes
        self._readings: deque[dict[str, AxisState]] = deque()
        self._next = 0  # index of the reading whose row is given next
        self._since_ns: int | None = None  # instant of the first reading

    def add(self, states: Mapping[str, AxisState]) -> list[TableRow]:
        """Add one reading of all axes; return the rows that are now complete, possibly none.

        A reading that is not later than the one before is dropped.
        """
        self._readings.append(dict(states))
        if len(self._readings) > 1 and self._at_ns(-1) <= self._at_ns(-2):
            self._readings.pop()  # its instant is of another axis than that of the reading before
            return []
        self._since_ns = self._at_ns(0) if self._since_ns is None else self._since_ns
        rows = []
        while self._next < len(self._readings) - 1:
            rows += self._row(self._next)
            self._next += 1
        while self._next > _KEPT:
            self._readings.popleft()
            self._next -= 1
        return rows

    def last(self) -> list[TableRow]:
        """Return the rows of the readings that are left, when no other will come."""
        return [row for index in range(self._next, len(self._readings)) for row in self._row(index)]

    def _at_ns(self, index: int) -> int:
        # A rate may bend between two readings, so the axis that is or was the fastest is to need no interpolation.
        before = self._readings[max(index % len(self._readings) - 1, 0)]
        now = self._readings[index]
        state = now[max(now, key=lambda axis: max(abs(now[axis].rate_rps), abs(before[axis].rate_rps)))]
        return state.angle_t_ns if state.rate_window_ns else state.rate_t_ns

    def _row(self, index: int) -> list[TableRow]:
        """Return the row of reading number ``index`` in a list, with angles and rates of all axes at one instant.

        Empty if its rates are means over a window that begins before the first reading.
        """
        at_ns, states = self._at_ns(index), self._readings[index].values()
        half_width_ns, window_ns = (max(getattr(s, key) for s in states) for key in ("half_width_ns", "rate_window_ns"))
        if self._since_ns is None or (window_ns and at_ns - window_ns < self._since_ns):
            return []
        angles = np.empty(len(self._axes))
        rates = np.empty(len(self._axes))
        for column, axis in enumerate(self._axes):
            state = self._readings[index][axis]
            own = [reading[axis] for reading in self._readings]
            times = np.array([r.rate_t_ns + r.rate_window_ns // 2 - at_ns for r in own], dtype=np.float64)
            series = np.array([r.rate_rps for r in own])
            if state.rate_window_ns:
                # Instants known much worse than this reading's are not used.
                known = np.array([r.half_width_ns <= 2 * state.half_width_ns + _WELL_NS for r in own])
                known[index + 2 :] = False
                rates[column] = _cubic_at_zero(times[known], series[known])
            else:
                rates[column] = np.interp(0.0, times, series)
            between_ns = at_ns - state.angle_t_ns
            rate = rates[column] if state.rate_window_ns else np.interp(-0.5 * between_ns, times, series)
            angles[column] = state.angle_rad + rate * between_ns * 1e-9
        return [TableRow(at_ns, angles, rates, half_width_ns, window_ns)]


def _cubic_at_zero(times_ns: Floats, rates: Floats) -> float:
    """Return the rate at time 0 by the cubic through the last four readings (Lagrange).

    Time 0 beyond these counts as the nearest of their ends. Of readings (n,) within 1 ms of each other only the last
    counts; with fewer than four the polynomial is of lower degree.
    """
    apart = np.diff(times_ns, append=np.inf) > _WELL_NS  # nearer instants are equivalent
    times, series = times_ns[apart][-4:], rates[apart][-4:]
    at, between = min(max(0.0, times[0]), times[-1]) - times, np.subtract.outer(times, times)
    np.fill_diagonal(between, 1.0)
    shares = at / between
    np.fill_diagonal(shares, 1.0)
    return float(shares.prod(axis=1) @ series)


async def watch_table(
    table: Turntable,
    axes: tuple[str, ...],
    rate_hz: float,
    sequencer: Sequencer,
    on_row: Callable[[TableRow], None],
    on_lost: Callable[[LinkLost], Awaitable[None]],
) -> None:
    """Read the table and pass rows to ``on_row`` until cancelled.

    DeviceFault when an axis goes to fault, leaves operation, or moves without a command; UntrueReadings when its
    readings contradict its command or each other. The table is read at ``rate_hz``, faster if ``sequencer`` wants it,
    slower if the link is slow. ``on_lost`` reopens a lost link or raises.

    An axis that is driven or turns is read every time. Of the others only the one read longest ago is read, at most
    every 0.4 s, which leaves a slow bus its time for axes that turn: unexpected motion is still seen within a second.
    The last rows are passed on at the end, unless it is ``on_row`` that failed.
    """
    loop = asyncio.get_running_loop()
    guard = MotionGuard(table, sequencer.commanded)
    states = {axis: await table.read(axis) for axis in axes}
    aligner = Aligner(axes)
    due_s = loop.time()
    counter = itertools.count()
    checked_s, read_s = dict.fromkeys(axes, due_s), dict.fromkeys(axes, due_s)
    turned: set[str] = set()
    broken_off = False  # interrupted while a row is recorded: the recorder is not called again

    def give(rows: list[TableRow]) -> None:
        nonlocal broken_off
        for row in rows:
            broken_off = True
            on_row(row)
            broken_off = False

    async def read_once() -> None:
        """Read the axes that need it, check them against their commands, pass on rows, and check the status at times.

        Read are the axes that are driven or turn, one that has just stopped once more, and the one not read for
        longest: always if no other is read, else when its last reading is 0.4 s old. The others keep their last values
        at the new instant. The status of all axes is read with every fifth reading, that of an axis at the latest after
        0.6 s. DeviceFault for a fault, an axis out of operation or motion against a command; UntrueReadings for
        readings that contradict each other; LinkLost for a lost link.
        """
        count = next(counter)
        busy = [a for a in axes if a == sequencer.driven_axis or states[a].rate_rps != 0.0 or a in turned]
        oldest = min((a for a in axes if a not in busy), key=lambda a: read_s[a], default=None)
        if oldest is not None and (not busy or loop.time() - read_s[oldest] >= _IDLE_S):
            busy.append(oldest)
        read_s.update(dict.fromkeys(busy, loop.time()))
        # The angle may be from before the stop, and the rate from after it: read once more.
        turned.clear()
        turned.update(axis for axis in busy if states[axis].rate_rps != 0.0)
        states.update({axis: await table.read(axis) for axis in busy})
        for axis in busy:
            await guard.look(axis, states[axis])
        now_ns = states[busy[0]].angle_t_ns
        for axis in axes:
            if axis not in busy:
                rate_ns = now_ns - states[axis].rate_window_ns // 2
                states[axis] = replace(states[axis], angle_t_ns=now_ns, rate_t_ns=rate_ns, half_width_ns=0)
        give(aligner.add(states))
        for axis in axes:
            if (count + 1) % _STATUS_EVERY == 0 or loop.time() - checked_s[axis] >= _STATUS_AT_LATEST_S:
                await check_axes(table, (axis,))
                checked_s[axis] = loop.time()

    try:
        while True:
            try:
                await read_once()
            except LinkLost as error:
                await on_lost(error)
                await check_axes(table, axes)
            due_s = max(due_s + 1 / max(rate_hz, sequencer.wanted_hz(loop.time())), loop.time())
            await asyncio.sleep(due_s - loop.time())
    finally:
        if not broken_off:
            give(aligner.last())
