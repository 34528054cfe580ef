"""How a stream of samples reaches a host: in bursts, as an operating system hands them over."""

import asyncio

import numpy as np

from drivers.clocks.loop_scale import loop_scale
from drivers.types import Ints

_BURST_S = 0.01


def burst_of(rate_hz: float) -> int:
    """Return the number of samples sent together: those of 10 ms of real time, whatever the loop's clock."""
    return max(round(rate_hz * _BURST_S * loop_scale(asyncio.get_running_loop())), 1)


def copies_sent(random: np.random.Generator, count: int, dropped: float, doubled: float) -> Ints:
    """Return how often each of ``count`` samples is sent (count,): 0, 1 or 2, by the shares dropped and doubled.

    Nothing is drawn if both are 0.
    """
    if not dropped and not doubled:
        return np.ones(count, dtype=np.int64)
    none, twice = random.random(count) < dropped, random.random(count) < doubled
    return np.where(none, 0, np.where(twice, 2, 1))
