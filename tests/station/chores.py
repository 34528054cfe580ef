"""Work for other processes, in a module that they import within milliseconds."""

from __future__ import annotations

import os
import signal
from typing import Any


def square(number: int) -> int:
    return number * number


def square_but_three(number: int) -> int:
    if number == 3:
        raise ValueError("three is\nnot wanted")
    return number * number


def die_at_three(number: int) -> int:
    if number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def unwelcome(number: int) -> Any:
    return (lambda: number) if number == 3 else number


def own_threads(number: int) -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")
