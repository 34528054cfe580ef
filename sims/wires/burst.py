"""How a stream of samples reaches a host: in bursts, as an operating system hands them over."""

import asyncio

import numpy as np

from drivers.clocks.loop_scale import loop_scale
from drivers.types import Ints

_BURST_S = 0.01


def burst_of(rate_hz: float) -> int:
    """Return how many samples go together: those of 10 ms of the wall's clock, whatever the loop's runs at."""
    return max(round(rate_hz * _BURST_S * loop_scale(asyncio.get_running_loop())), 1)


def copies_sent(random: np.random.Generator, count: int, dropped: float, doubled: float) -> Ints:
    """Return how often each of so many samples is sent, where these shares of them are dropped and doubled."""
    if not dropped and not doubled:
        return np.ones(count, dtype=np.int64)
    none, twice = random.random(count) < dropped, random.random(count) < doubled
    return np.where(none, 0, np.where(twice, 2, 1))
