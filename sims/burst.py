"""How a stream of samples reaches a host: in bursts, as an operating system hands them over."""

import asyncio

from drivers.loop_scale import loop_scale

_BURST_S = 0.01


def burst_of(rate_hz: float) -> int:
    """Return how many samples go together: those of 10 ms of the wall's clock, whatever the loop's runs at."""
    return max(round(rate_hz * _BURST_S * loop_scale(asyncio.get_running_loop())), 1)
