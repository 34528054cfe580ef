"""Signals that end a run politely, and the hang-up that need not."""

import asyncio
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

_HANG_UP = getattr(signal, "SIGHUP", None)


@contextmanager
def heeded_signals(stop: Callable[[str], None], hang_up: Callable[[], None] | None = None) -> Iterator[None]:
    r"""Call ``stop(name)`` on the running loop for Ctrl-C, SIGTERM, SIGHUP, Ctrl-\ and Ctrl-Z, within this context.

    ``name`` is one of these, as the operator reads it. For SIGHUP call ``hang_up()`` instead if given; output to the
    terminal that is gone is then discarded. Ctrl-Z counts, as a frozen process would leave the table turning. Nothing
    is installed outside the main thread. The handlers before are restored at the end.
    """
    loop = asyncio.get_running_loop()
    terminals = [stream for stream in (0, 1, 2) if os.isatty(stream)]
    names = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
    if _HANG_UP is not None:
        names |= {_HANG_UP: "SIGHUP (the terminal is gone)", signal.SIGQUIT: "Ctrl-\\", signal.SIGTSTP: "Ctrl-Z"}

    def handle(number: int, _frame: Any) -> None:
        if number == _HANG_UP:
            _to_nowhere(terminals)
        if number == _HANG_UP and hang_up is not None:
            loop.call_soon_threadsafe(hang_up)
        else:
            loop.call_soon_threadsafe(stop, names[signal.Signals(number)])

    before = {}
    for number in names:
        try:
            before[number] = signal.signal(number, handle)
        except ValueError:  # not the main thread: signals are handled elsewhere
            break
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _to_nowhere(descriptors: Iterable[int]) -> None:
    """Discard output to a terminal that is gone: writing would fail, and hide how the run ended."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    for descriptor in descriptors:
        os.dup2(nowhere, descriptor)
    os.close(nowhere)


def ignore_hang_up() -> None:
    """Have SIGHUP do nothing from now on, before and after the run too."""
    if _HANG_UP is not None:
        signal.signal(_HANG_UP, signal.SIG_IGN)
