"""How fast the loop's clock runs, and how threads reach the loop."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any


def loop_scale(loop: asyncio.AbstractEventLoop) -> float:
    """Return how many seconds of the loop's clock pass in one real second; 1 for a loop without a scale.

    Times that a host takes, and not physics, are multiplied by it.
    """
    return float(getattr(loop, "scale", 1.0))


def call_from_thread(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """Call on the loop; one that has closed needs no more news."""
    with suppress(RuntimeError):
        loop.call_soon_threadsafe(function, *arguments)


def settle(future: asyncio.Future[Any], result: Any) -> None:
    """Set the result of a future, or its exception if ``result`` is an ``Exception``; do nothing if it is done."""
    if future.done():
        return
    if isinstance(result, Exception):
        future.set_exception(result)
    else:
        future.set_result(result)
