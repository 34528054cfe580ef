"""Work spread over an existing Dask cluster; work that its scheduler moves elsewhere ends as if undisturbed."""

import asyncio
import logging
import os
import platform
import queue
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack, closing
from functools import cache
from importlib.metadata import version
from typing import Any, TypeVar
from urllib.parse import urlsplit

from station.bench.plugins import use_effects
from station.campaigns.worker_pool import Ended, attempt, one_line, with_second_try
from station.errors import UsageError

T = TypeVar("T")
R = TypeVar("R")

ANSWER_S = 5.0
"""Within this time a scheduler must answer."""
PATIENCE_S = 30.0
"""A cluster without any worker for this long is given up: enough for one to be started again."""
_LOOK_S = 0.5
_AHEAD = 2  # items handed over, for each thread of the cluster: none idles, and the scheduler's memory stays small


class _GoneError(Exception):
    """The cluster is lost; the message says why."""


def run_on_cluster(
    work: Callable[[T], R], items: Sequence[T], address: str, *, patience_s: float = PATIENCE_S
) -> Generator[Ended[R]]:
    """Yield the result of each item as it ends; closing the iterator cancels what has not begun.

    ``address`` is tcp://HOST:PORT. Items whose worker died are tried once more, alone. If the scheduler is lost, or has
    no worker for ``patience_s``, all remaining items fail with that reason. UsageError if distributed is not installed,
    the address is not of this form, or no scheduler answers there. Logging is off meanwhile.
    """
    distributed = _distributed()
    _check_address(address)
    with ExitStack() as stack:
        stack.callback(logging.disable, logging.root.manager.disable)
        logging.disable()  # distributed's log: important errors come back as a reason
        _check_scheduler(distributed, address)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about versions: each item checks those that matter
            client = distributed.Client(address, timeout=ANSWER_S, set_as_default=False)
        remaining = set(range(len(items)))
        try:
            crew = _Crew(distributed, client, address, patience_s)
            first = crew.round(work, items, range(len(items)))
            with closing(
                with_second_try(first, lambda suspects: crew.round(work, items, suspects, alone=True))
            ) as ends:
                for ended in ends:
                    remaining.discard(ended.index)
                    yield ended
        except _GoneError as gone:
            for index in sorted(remaining):
                yield Ended(index, reason=str(gone))
        finally:
            client.close()


class _Crew:
    """The workers behind a scheduler."""

    def __init__(self, distributed: Any, client: Any, address: str, patience_s: float) -> None:
        self._distributed, self._client, self._address = distributed, client, address
        self._patience_s = patience_s
        self._threads = 0
        self._looked_at = self._seen_at = time.monotonic()

    def round(
        self, work: Callable[[T], R], items: Sequence[T], indices: Sequence[int], *, alone: bool = False
    ) -> Generator[Ended[R]]:
        """Yield the result of each item at ``indices`` as it ends, submitted one at a time if ``alone``.

        Else so many are submitted at once that no thread of the cluster waits. _GoneError if the scheduler or the last
        worker is lost. Submitted items are cancelled when it ends early.
        """
        left = deque(indices)
        futures: dict[str, tuple[int, Any]] = {}
        finished: queue.SimpleQueue[Any] = queue.SimpleQueue()
        try:
            while left or futures:
                self._look()
                while left and len(futures) < (1 if alone else max(_AHEAD * self._threads, 1)):
                    index = left.popleft()
                    future = self._client.submit(_on_worker, _software(), work, index, items[index], pure=False)
                    futures[future.key] = index, future
                    future.add_done_callback(finished.put)
                try:
                    future = finished.get(timeout=_LOOK_S)
                    ended: Ended[R] = self._ended(futures[future.key][0], future)
                except queue.Empty:
                    continue
                except TimeoutError:  # its worker died before the result was fetched: another makes it again
                    finished.put(future)
                    continue
                del futures[future.key]
                yield ended
        finally:
            if futures and self._client.status == "running":
                self._client.cancel([future for _, future in futures.values()])

    def _ended(self, index: int, future: Any) -> Ended[Any]:
        """Return the result of the finished ``future`` of item number ``index``.

        An exception of the work is in that result, as the reason. An item that died with its workers (``died``) or
        could not begin gives an Ended with a reason, too. TimeoutError if the result cannot be fetched now, _GoneError
        if the scheduler is lost (it cancelled the future).
        """
        if future.cancelled():
            raise _GoneError(f"the scheduler at {self._address} no longer answers")
        if future.status != "error":
            ended: Ended[Any] = future.result(timeout=_LOOK_S)
            return ended
        error = future.exception(timeout=_LOOK_S)
        if isinstance(error, self._distributed.KilledWorker):
            return Ended(index, reason="every worker that tried it died", died=True)
        return Ended(index, reason=f"the worker could not begin: {one_line(error)}")

    def _look(self) -> None:
        """Update the number of the cluster's threads, every half second at most, at each call while there is none.

        _GoneError if the scheduler does not answer, or if it has had no worker for the time of patience.
        """
        now = time.monotonic()
        if self._threads and now - self._looked_at < _LOOK_S:
            return
        try:
            self._threads = sum(self._client.nthreads().values())
        except Exception as error:  # its network layers raise anything when the other side is gone
            raise _GoneError(f"the scheduler at {self._address} no longer answers") from error
        self._looked_at = time.monotonic()
        if self._threads:
            self._seen_at = now
        elif now - self._seen_at > self._patience_s:
            raise _GoneError(f"the cluster at {self._address} has had no worker for {self._patience_s:.0f} s")


def _on_worker(software: tuple[str, ...], work: Callable[[T], R], index: int, item: T) -> Ended[R]:
    """Do item number ``index`` on a worker, and return its result or the reason of its failure.

    It fails if the worker's versions differ from ``software``, or its environment does not limit BLAS to one thread, as
    the digits would differ, too.
    """
    if _software() != software:
        return Ended(index, reason=f"the worker has {', '.join(_software())}; here it is {', '.join(software)}")
    if os.environ.get("OPENBLAS_NUM_THREADS", os.environ.get("OMP_NUM_THREADS")) != "1":
        return Ended(index, reason="the worker may use several BLAS threads: start it with OMP_NUM_THREADS=1")
    use_effects()
    return attempt(work, index, item)


@cache
def _software() -> tuple[str, ...]:
    python = "Python " + ".".join(platform.python_version_tuple()[:2])
    return python, *(f"{name} {version(name)}" for name in ("turntable-station", "numpy", "scipy", "h5py"))


def _distributed() -> Any:
    try:
        import distributed
    except ImportError:
        raise UsageError("--scheduler needs Dask: pip install 'turntable-station[cluster]'") from None
    return distributed


def _check_address(address: str) -> None:
    """Raise UsageError unless ``address`` is tcp://HOST:PORT, without a path."""
    try:
        parts = urlsplit(address)
        whole = bool(parts.scheme == "tcp" and parts.hostname and parts.port) and not parts.path
    except ValueError:
        whole = False
    if not whole:
        raise UsageError(f"--scheduler {address}: write tcp://HOST:PORT, for instance tcp://127.0.0.1:8786")


def _check_scheduler(distributed: Any, address: str) -> None:
    """Raise UsageError unless a Dask scheduler answers at ``address`` within 5 s, and not another part of Dask.

    A client might wait for anything else for ever. ``distributed`` is the module. Call it where no event loop runs.
    """

    async def ask() -> Any:
        async with distributed.rpc(address, timeout=ANSWER_S) as scheduler:
            return await scheduler.identity()

    try:
        found = asyncio.run(asyncio.wait_for(ask(), ANSWER_S))
    except Exception as error:  # a foreign service's bytes can make anything of its decoder
        raise UsageError(f"--scheduler {address}: no Dask scheduler answers within {ANSWER_S:.0f} s") from error
    if found.get("type") != "Scheduler":
        raise UsageError(f"--scheduler {address}: a Dask {found.get('type')} answers, not the scheduler")
