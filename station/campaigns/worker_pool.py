"""Work spread over processes of this machine, one item at a time each; a process that dies costs its item only."""

import multiprocessing
import os
import pickle
import signal
import sys
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Generic, TypeVar

T = TypeVar("T")
R = TypeVar("R")

_STOP_S = 3.0
ONE_BLAS_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""The environment in which numpy must be imported: sums shared among threads differ in their last digits."""


@dataclass(frozen=True, slots=True)
class Ended(Generic[R]):
    """How the item at ``index`` ended: its value, or why there is none; ``died`` if it took its process along."""

    index: int
    value: R | None = None
    reason: str | None = None
    died: bool = False


def attempt(work: Callable[[T], R], index: int, item: T) -> Ended[R]:
    """Do one item in this process."""
    try:
        return Ended(index, work(item))
    except Exception as error:  # whatever one item meets must not cost the others
        return Ended(index, reason=one_line(error))


def one_line(error: BaseException) -> str:
    """Return what an error says in one line; Python's own errors with their type, since few explain themselves."""
    text, name = " ".join(str(error).split()), type(error).__name__
    if type(error).__module__ in ("builtins", "pickle", "_pickle"):
        return f"{name}: {text}" if text else name
    return text or name


def run_in_processes(work: Callable[[T], R], items: Sequence[T], count: int) -> Generator[Ended[R]]:
    """Yield how each item ended, as they end, from ``count`` processes; closing the iterator stops them."""
    first = _round(work, items, range(len(items)), count)
    return with_second_try(first, lambda suspects: _round(work, items, suspects, 1))


def with_second_try(
    first: Generator[Ended[R]], again: Callable[[Sequence[int]], Generator[Ended[R]]]
) -> Generator[Ended[R]]:
    """Yield how each item ended; those whose process died are tried once more when the others are done.

    ``again`` does them one at a time: what was killed for want of memory, or because of another, then has all
    there is, and what kills its process every time is known for it.
    """
    suspects: list[int] = []
    with closing(first):
        for ended in first:
            if ended.died:
                suspects.append(ended.index)
            else:
                yield ended
    with closing(again(sorted(suspects))) as second:
        yield from second


def _round(work: Callable[[T], R], items: Sequence[T], indices: Sequence[int], count: int) -> Generator[Ended[R]]:
    left = deque(indices)
    # Pickled once, and unpickled where a failure can be reported: an error in a starting process is only a traceback.
    packed = pickle.dumps(work)
    crew: dict[Connection, _Worker] = {}
    try:
        while left or crew:
            while left and len(crew) < count:
                worker = _Worker(packed)
                crew[worker.connection] = worker
                worker.give(left[0], items[left.popleft()])
            for connection in wait(list(crew)):
                assert isinstance(connection, Connection)
                ended = crew[connection].take()
                if left and not ended.died:
                    crew[connection].give(left[0], items[left.popleft()])
                else:
                    crew.pop(connection).end()
                yield ended
    finally:
        for worker in crew.values():
            worker.interrupt()
        for worker in crew.values():
            worker.end()


class _Worker:
    """A process that does one item after another, as given."""

    def __init__(self, packed: bytes) -> None:
        context = multiprocessing.get_context("spawn")  # no state of this process, threads and locks least of all
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, packed), daemon=True)
        with _as_children_start():
            self._process.start()
        theirs.close()
        self._index = -1

    def give(self, index: int, item: object) -> None:
        """Hand over an item; the worker must be idle."""
        self._index = index
        with suppress(BrokenPipeError):  # it died meanwhile: take() tells
            self.connection.send((index, item))

    def take(self) -> Ended[Any]:
        """Wait for the end of the item, be it the end of the process."""
        try:
            ended: Ended[bytes] = self.connection.recv()
        except (EOFError, ConnectionResetError):
            wait([self._process.sentinel], _STOP_S)
            self._signal(signal.SIGKILL)  # what it had started goes with it
            self._process.join()
            return Ended(self._index, reason=_last_words(self._process.exitcode), died=True)
        return ended if ended.value is None else attempt(pickle.loads, ended.index, ended.value)

    def interrupt(self) -> None:
        """Ask it to leave its item, closing files."""
        if self._process.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(self._process.pid, signal.SIGTERM)

    def end(self) -> None:
        """Let it go; by force if it does not."""
        self.connection.close()
        self._process.join(_STOP_S)
        if self._process.exitcode is None:
            self._signal(signal.SIGKILL)
            self._process.join()

    def _signal(self, number: signal.Signals) -> None:
        """Signal the worker's process group; the worker must not have been waited for, or its id may be another's."""
        pid = self._process.pid
        assert pid is not None
        try:
            os.killpg(pid, number)
        except ProcessLookupError:  # it had not come to make its group
            with suppress(ProcessLookupError):
                os.kill(pid, number)


def _serve(connection: Connection, packed: bytes) -> None:
    """Do items until there are no more, or nobody asks any more."""
    # A group of its own: the terminal's Ctrl-C is the parent's to pass on, and what this starts can be ended with it.
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, _leave)
    with suppress(EOFError, ConnectionError):
        while True:
            index, item = connection.recv()
            # A result that cannot be pickled is a failure of its item, too.
            connection.send(attempt(lambda item: pickle.dumps(pickle.loads(packed)(item)), index, item))


def _leave(_number: int, _frame: object) -> None:
    sys.exit(1)  # by exception, so that files are closed and subprocesses ended


def _last_words(code: int | None) -> str:
    if code is None or code >= 0:
        return f"its process ended with exit code {code}"
    hint = ", as for want of memory" if code == -signal.SIGKILL else ""
    return f"its process was ended by signal {-code} ({signal.strsignal(-code)}{hint})"


@contextmanager
def _as_children_start() -> Iterator[None]:
    """Give processes started here one BLAS thread each, and keep Ctrl-C from them until they can ignore it."""
    before = {name: os.environ.get(name) for name in ONE_BLAS_THREAD}
    os.environ.update(ONE_BLAS_THREAD)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
