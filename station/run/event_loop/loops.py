"""The event loop as the clock: real time, real time scaled, and virtual time.

Code of the station asks ``loop.time()``, sleeps by ``asyncio.sleep`` and limits by ``asyncio.timeout``, and
knows no other clock. Which loop runs decides how fast that clock goes.
"""

import asyncio
import selectors
import sys
import time
from collections.abc import Callable, Coroutine
from concurrent.futures import Executor
from typing import Any, TypeVar

T = TypeVar("T")

_MOST_BREAKS = 100  # of a loop, after which there is no going on
_CAUGHT_UP_S = 0.05  # by a clock that has waited: less than a person notices
_SWITCH_S = 0.0005  # after which a thread that works lets in one that has just received something, to stamp it


class ScaledLoop(asyncio.SelectorEventLoop):
    """A loop whose clock runs ``scale`` times as fast as the wall's; 1 is real time."""

    def __init__(self, scale: float = 1.0) -> None:
        """Start the clock at zero; set how often the threads of the whole process change over."""
        self.scale = scale
        sys.setswitchinterval(_SWITCH_S)
        self._began = time.monotonic()
        super().__init__(_ScaledSelector(scale))

    def time(self) -> float:
        """Return seconds of the loop's clock."""
        return (time.monotonic() - self._began) * self.scale


class PacedLoop(asyncio.SelectorEventLoop):
    """A loop whose clock runs ``scale`` times as fast as the wall's, or slower if this computer cannot keep up.

    Only for links in memory, where nothing happens while the computer is busy: the clock passes no timer that has not
    been served. Delays of up to 50 ms (wall) are made up for.
    """

    def __init__(self, scale: float) -> None:
        """Start the clock at zero, to run at ``scale`` times the speed of the wall's."""
        self.scale = scale
        self.waited_s = 0.0
        """How long the clock has waited for this computer, in seconds of the wall."""
        self._now = 0.0
        self._zero_s = time.monotonic()
        super().__init__(_PacedSelector(self))

    def time(self) -> float:
        """Return seconds of the loop's clock."""
        return self._now

    def wall_s_until(self, seconds: float) -> float:
        """Return the real time to wait until ``seconds`` of this clock have passed, 0 if it is late."""
        return max(self._zero_s + (self._now + seconds) / self.scale - time.monotonic(), 0.0)

    def follow(self) -> None:
        """Advance the clock with the wall's, but not beyond the next timer.

        If it stays behind by more than 50 ms (wall), the rest is never made up for, and is added to ``waited_s``.
        """
        scheduled: list[asyncio.TimerHandle] = self._scheduled  # type: ignore[attr-defined]
        reached_s = (time.monotonic() - self._zero_s) * self.scale
        self._now = max(self._now, min(reached_s, scheduled[0].when()) if scheduled else reached_s)
        excess_s = (reached_s - self._now) / self.scale - _CAUGHT_UP_S
        if excess_s > 0:
            self._zero_s += excess_s
            self.waited_s += excess_s


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop whose clock jumps to the next timer when nothing is left to do.

    Only for links in memory: it waits for no socket, starts no thread, and runs executor jobs at once. Two runs of the
    same program see the same times.
    """

    def __init__(self) -> None:
        """Start the clock at zero."""
        self._now = 0.0
        super().__init__(_VirtualSelector(self))

    def time(self) -> float:
        """Return seconds of the loop's clock."""
        return self._now

    def advance(self, seconds: float | None) -> None:
        """Jump to the next timer, if ``seconds`` until it are more than 0; the number itself does not count.

        RuntimeError if it is None: no timer is set, so nothing can happen any more.
        """
        if seconds is None:
            raise RuntimeError("virtual time stands still: every task waits and no timer is set")
        if seconds > 0:
            # To the timer's own instant, not by a difference: sums of differences drift by rounding.
            scheduled: list[asyncio.TimerHandle] = self._scheduled  # type: ignore[attr-defined]
            self._now = max(self._now, scheduled[0].when())

    def run_in_executor(self, executor: Executor | None, func: Callable[..., Any], *args: Any) -> asyncio.Future[Any]:  # type: ignore[override]
        """Call ``func`` at once, in no thread, which would not share this clock; the future has its result or error."""
        future = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as error:
            future.set_exception(error)
        return future

    def _write_to_self(self) -> None:
        """Nothing sleeps, so nothing needs waking."""


class _ScaledSelector(selectors.DefaultSelector):
    def __init__(self, scale: float) -> None:
        super().__init__()
        self._scale = scale

    def select(self, timeout: float | None = None) -> Any:
        return super().select(None if timeout is None else timeout / self._scale)


class _PacedSelector(selectors.DefaultSelector):
    def __init__(self, loop: PacedLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> Any:
        if timeout == 0:  # something is to be done now, at this instant of the clock
            return super().select(0)
        found = super().select(None if timeout is None else self._loop.wall_s_until(timeout))
        self._loop.follow()
        return found


class _VirtualSelector(selectors.DefaultSelector):
    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> Any:
        self._loop.advance(timeout)
        return []


def is_virtual(loop: asyncio.AbstractEventLoop) -> bool:
    """Return whether this loop's clock jumps."""
    return isinstance(loop, VirtualLoop)


def run_to_end(runner: asyncio.Runner, work: Coroutine[Any, Any, T]) -> T:
    """Run ``work`` until it has ended, whatever callbacks raise meanwhile; return its result, or raise its error.

    KeyboardInterrupt, SystemExit and exceptions of callbacks cancel ``work``, once, with the exception as the message,
    and the loop goes on, so that a table is brought to rest. Such an exception is raised only if ``work`` ends by the
    cancel, or after more than 100 of them.
    """
    try:
        loop = runner.get_loop()
    except BaseException:
        work.close()  # never awaited
        raise
    task = loop.create_task(work)
    broken: list[BaseException] = []

    def cancel(error: BaseException) -> None:
        broken.append(error)
        if len(broken) == 1:
            task.cancel(error)

    def handle(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        if "exception" in context and context.keys() & {"handle", "transport"}:
            cancel(context["exception"])
        else:
            loop.default_exception_handler(context)

    loop.set_exception_handler(handle)
    try:
        while True:
            try:
                return loop.run_until_complete(task)
            except BaseException as error:
                if task.done() or len(broken) > _MOST_BREAKS:
                    if broken and isinstance(error, asyncio.CancelledError):
                        raise broken[0] from None
                    raise
                cancel(error)
    finally:
        loop.set_exception_handler(None)
