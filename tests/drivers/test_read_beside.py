"""The clock of a source is read in one thread while another fits it."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from drivers.clocks.sampling import CounterClock

_SECONDS = 3000


@pytest.fixture(autouse=True)
def switching_often() -> Iterator[None]:
    """Let threads take turns as often as the interpreter can."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def errors_beside(work: Callable[[], None], look: Callable[[], object]) -> tuple[int, list[str]]:
    """Return how often ``look`` came to an end while another thread did ``work``, and how it failed."""
    looks, errors = 0, list[str]()
    done = threading.Event()

    def worker() -> None:
        try:
            work()
        finally:
            done.set()

    thread = threading.Thread(target=worker)
    thread.start()
    while not done.is_set():
        try:
            look()
        except Exception as error:
            errors.append(f"{type(error).__name__}: {error}")
        looks += 1
    thread.join()
    return looks, errors


def test_a_counted_clock_is_read_while_it_is_fitted() -> None:
    clock = CounterClock(1.0, 1 << 32, 1)

    def fit() -> None:
        for at_s in range(_SECONDS):
            clock.stamp(np.array([at_s]), np.array([at_s * 1_000_000_000 + at_s % 7 * 1000]))

    looks, errors = errors_beside(fit, lambda: clock.alignment)
    assert looks > 100
    assert errors == []
    assert clock.alignment is not None
