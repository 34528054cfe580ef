"""How fast the loop's clock runs: what waits for a host, and not for physics, is stretched by it."""

from __future__ import annotations

import asyncio


def loop_scale(loop: asyncio.AbstractEventLoop) -> float:
    """Return how many seconds of the loop's clock pass in one of the wall's; 1 for a loop that does not say."""
    return float(getattr(loop, "scale", 1.0))
