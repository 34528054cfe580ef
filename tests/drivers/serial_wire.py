"""A serial line for tests: two pseudo-terminals whose far ends this relay joins, or one whose far end a test plays."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager


def _open_raw(stack: ExitStack) -> tuple[int, str]:
    """Return the far end of a raw pseudo-terminal and its name; its near end stays open, so that users may go."""
    far, near = os.openpty()
    stack.callback(os.close, far)
    stack.callback(os.close, near)
    tty.setraw(far)
    tty.setraw(near)
    os.set_blocking(far, False)
    return far, os.ttyname(near)


@contextmanager
def peer(received: Callable[[bytes, Callable[[bytes], None]], None]) -> Iterator[str]:
    """Give the name of a port; what is written to it is handed over together with how to answer."""
    loop = asyncio.get_running_loop()
    with ExitStack() as stack:
        far, name = _open_raw(stack)

        def answer(data: bytes) -> None:
            os.write(far, data)

        loop.add_reader(far, lambda: received(os.read(far, 4096), answer))
        stack.callback(loop.remove_reader, far)
        yield name


@contextmanager
def wire(delay_s: Callable[[], float] = lambda: 0.0) -> Iterator[tuple[str, str]]:
    """Give the two ports of a line; what the second says is held back by ``delay_s``, keeping its order."""
    loop = asyncio.get_running_loop()
    with ExitStack() as stack:
        (far_a, a), (far_b, b) = _open_raw(stack), _open_raw(stack)
        last_s = 0.0
        waiting: list[asyncio.TimerHandle] = []

        def late() -> None:
            nonlocal last_s
            last_s = max(last_s, loop.time() + delay_s())
            waiting.append(loop.call_at(last_s, os.write, far_a, os.read(far_b, 4096)))

        loop.add_reader(far_a, lambda: os.write(far_b, os.read(far_a, 4096)))
        stack.callback(loop.remove_reader, far_a)
        loop.add_reader(far_b, late)
        stack.callback(loop.remove_reader, far_b)
        stack.callback(lambda: [handle.cancel() for handle in waiting])
        yield a, b
