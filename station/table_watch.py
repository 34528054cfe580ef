"""Reads the table regularly, puts its readings on common instants, and watches over its condition."""

from __future__ import annotations

import asyncio
import statistics
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceFault
from drivers.seams import AxisState, Turntable

Floats = NDArray[np.float64]

_STATUS_EVERY = 5  # condition is asked for in every so many-th reading
_QUICK, _SLOW = 1.5, 4.0  # times the usual round trip: read again beyond the first, leave out beyond the second
_TRIES = 2
_ALWAYS_QUICK_NS = 1_000_000
_IDLE_EVERY = 4  # while an axis turns, another is looked at in every so many-th reading


class Aligner:
    """Turns readings of single axes, each at its own instant, into rows at one instant.

    An angle is carried to the row's instant by its rate, a rate by interpolation towards the reading before or
    after, so a row is given one reading later.
    """

    def __init__(self, axes: tuple[str, ...]) -> None:
        """Columns are ordered as ``axes``."""
        self._axes = axes
        self._readings: list[dict[str, AxisState]] = []

    def add(self, states: Mapping[str, AxisState]) -> tuple[int, Floats, Floats] | None:
        """Take in one reading of all axes; return the row (t_ns, angles, rates) of the one before, if any."""
        self._readings.append(dict(states))
        return self._row(-2) if len(self._readings) >= 2 else None

    def last(self) -> tuple[int, Floats, Floats] | None:
        """Return the row of the last reading, when no other will come."""
        return self._row(-1) if self._readings else None

    def _row(self, index: int) -> tuple[int, Floats, Floats]:
        states = self._readings[index]
        stamps = [t for s in states.values() for t in (s.angle_t_ns, s.rate_t_ns)]
        at_ns = sum(stamps) // len(stamps)
        angles = np.empty(len(self._axes))
        rates = np.empty(len(self._axes))
        for column, axis in enumerate(self._axes):
            state = states[axis]
            series = [(r[axis].rate_t_ns, r[axis].rate_rps) for r in self._readings]
            times = np.array([t - at_ns for t, _ in series], dtype=np.float64)
            rates[column] = np.interp(0.0, times, [rate for _, rate in series])
            angles[column] = state.angle_rad + state.rate_rps * (at_ns - state.angle_t_ns) * 1e-9
        self._readings = self._readings[-2:]
        return at_ns, angles, rates


async def _read_quickly(table: Turntable, axes: list[str], usual_ns: deque[int]) -> dict[str, AxisState] | None:
    """Read axes; again if the round trip was slow, and None if it stays so that the instant is not known."""
    best: dict[str, AxisState] | None = None
    for _ in range(_TRIES):
        states = {axis: await table.read(axis) for axis in axes}
        usual_ns.append(_slowest_ns(states))
        if best is None or _slowest_ns(states) < _slowest_ns(best):
            best = states
        usual = statistics.median(usual_ns) + _ALWAYS_QUICK_NS
        if _slowest_ns(best) <= _QUICK * usual:
            return best
    return best if best is not None and _slowest_ns(best) <= _SLOW * usual else None


def _slowest_ns(states: Mapping[str, AxisState]) -> int:
    return max(state.half_width_ns for state in states.values())


async def watch_table(
    table: Turntable,
    axes: tuple[str, ...],
    rate_hz: float,
    driven_axis: Callable[[], str | None],
    on_row: Callable[[tuple[int, Floats, Floats]], None],
    on_half_width: Callable[[int], None],
) -> None:
    """Read until cancelled; DeviceFault when an axis goes to fault or leaves operation by itself.

    An axis that is driven or turns is read every time, of the others one in turn: what stands still and has
    not been told to move is still there, and a slow bus has its time for what turns.
    """
    loop = asyncio.get_running_loop()
    states = {axis: await table.read(axis) for axis in axes}
    aligner = Aligner(axes)
    usual_ns: deque[int] = deque(maxlen=51)
    period_s = 1 / rate_hz
    due_s = loop.time()
    count = 0
    try:
        while True:
            busy = [a for a in axes if a == driven_axis() or states[a].rate_rps != 0.0]
            in_turn = axes[count // _IDLE_EVERY % len(axes)]
            if not busy or (count % _IDLE_EVERY == 0 and in_turn not in busy):
                busy.append(in_turn)
            fresh = await _read_quickly(table, busy, usual_ns)
            if fresh is not None:
                on_half_width(_slowest_ns(fresh))
                states.update(fresh)
                now_ns = states[busy[0]].angle_t_ns
                for axis in axes:
                    if axis not in busy:
                        states[axis] = replace(states[axis], angle_t_ns=now_ns, rate_t_ns=now_ns)
                row = aligner.add(states)
                if row is not None:
                    on_row(row)
            count += 1
            if count % _STATUS_EVERY == 0:
                await check_axes(table, axes)
            due_s = max(due_s + period_s, loop.time())
            await asyncio.sleep(due_s - loop.time())
    finally:
        row = aligner.last()
        if row is not None:
            on_row(row)


async def check_axes(table: Turntable, axes: tuple[str, ...]) -> None:
    """See that every axis is in operation; DeviceFault if one is not."""
    for axis in axes:
        status = await table.status(axis)
        if status.fault:
            raise DeviceFault("table", status.fault)
        if not status.enabled:
            raise DeviceFault(
                "table",
                f"axis {axis} has left operation by itself (now {status.text}): its watchdog or an interlock",
            )
