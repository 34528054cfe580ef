"""Whose turn it is on a link."""

import asyncio
from types import TracebackType


class Turn:
    """A lock that is free again when the task that held it has ended, however that came: no stop must wait for it."""

    def __init__(self) -> None:
        """Be free."""
        self._lock = asyncio.Lock()
        self._holder: asyncio.Task[None] | None = None

    async def __aenter__(self) -> None:
        """Wait for the others."""
        this = asyncio.current_task()
        if self._holder is not None and self._lock.locked() and (self._holder.done() or self._holder is this):
            self._lock.release()
        await self._lock.acquire()
        self._holder = this

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._lock.locked():
            self._lock.release()
