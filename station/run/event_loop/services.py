"""Tasks beside the work of a run, and how their errors end it."""

import asyncio
from collections.abc import Coroutine, Iterator
from typing import Any


def leaves(error: BaseException) -> Iterator[BaseException]:
    """Yield the exceptions within exception groups, at any depth, and those that a cancel carries as its message.

    Any other exception is yielded itself.
    """
    if isinstance(error, BaseExceptionGroup):
        for one in error.exceptions:
            yield from leaves(one)
    elif isinstance(error, asyncio.CancelledError) and error.args and isinstance(error.args[0], BaseException):
        yield from leaves(error.args[0])
    else:
        yield error


def serve(group: asyncio.TaskGroup, service: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Start a coroutine that must run for the whole run, as a task of the group.

    RuntimeError, in the task, if it returns or is cancelled from within; its exceptions pass through.
    """

    async def served() -> None:
        """Await the service; RuntimeError if it ends by itself, or by a cancel that was not asked of this task."""
        task = asyncio.current_task()
        try:
            await service
        except asyncio.CancelledError:
            if task is not None and task.cancelling():
                raise
        raise RuntimeError(f"{name} has ended unexpectedly")

    name = getattr(service, "__qualname__", "a service")
    return group.create_task(served())
