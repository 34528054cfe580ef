"""Tasks beside the work of a run, and how their errors end it."""

import asyncio
from collections.abc import Coroutine, Iterator
from typing import Any


def leaves(error: BaseException) -> Iterator[BaseException]:
    """Yield the exceptions within exception groups, and those that a cancel carries as its message."""
    if isinstance(error, BaseExceptionGroup):
        for one in error.exceptions:
            yield from leaves(one)
    elif isinstance(error, asyncio.CancelledError) and error.args and isinstance(error.args[0], BaseException):
        yield from leaves(error.args[0])
    else:
        yield error


def serve(group: asyncio.TaskGroup, service: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Start a coroutine that must run for the whole run; RuntimeError if it ends without being cancelled by the
    group.
    """

    async def served() -> None:
        """Await the service; RuntimeError if it ends by itself, also by a cancellation that was not asked of this
        task.
        """
        task = asyncio.current_task()
        try:
            await service
        except asyncio.CancelledError:
            if task is not None and task.cancelling():
                raise
        raise RuntimeError(f"{name} has ended unexpectedly")

    name = getattr(service, "__qualname__", "a service")
    return group.create_task(served())
