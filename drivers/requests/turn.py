"""Whose turn it is on a link."""

import asyncio
from typing import Any, Literal


class Turn(asyncio.Lock):
    """A lock that is free again when its holding task has ended in any way, so that no stop waits for it."""

    _holder: asyncio.Task[Any] | None = None

    async def acquire(self) -> Literal[True]:
        """Wait for the lock; one whose holder is done, or is the current task itself, is released first."""
        this = asyncio.current_task()
        if self._holder is not None and (self._holder.done() or self._holder is this):
            self.release()
        await super().acquire()
        self._holder = this
        return True

    def release(self) -> None:
        """Let the next one have it."""
        if self.locked():
            super().release()
