"""Work spread over processes of this machine, one item at a time each; a process that dies costs its item only."""

import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, as_completed
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.util import Finalize
from typing import Any, Generic, TypeVar

from pebble import ProcessExpired, ProcessPool

from station.bench.plugins import use_effects
from station.campaigns import ONE_BLAS_THREAD

T = TypeVar("T")
R = TypeVar("R")
_BEFORE_ALL = 1000  # other finalizers of a process have at most 100


@dataclass(frozen=True, slots=True)
class Ended(Generic[R]):
    """The result of the item at ``index``: its value, or the reason why there is none; ``died`` if its process ended
    with it.
    """

    index: int
    value: R | None = None
    reason: str | None = None
    died: bool = False


def attempt(work: Callable[[T], R], index: int, item: T) -> Ended[R]:
    """Do one item in this process."""
    try:
        return Ended(index, work(item))
    except Exception as error:  # an error of one item must not cost the others
        return Ended(index, reason=one_line(error))


def one_line(error: BaseException) -> str:
    """Return the text of an error in one line; Python's own errors with their type, since few explain themselves."""
    text, name = " ".join(str(error).split()), type(error).__name__
    if type(error).__module__ in ("builtins", "pickle", "_pickle"):
        return f"{name}: {text}" if text else name
    return text or name


def run_in_processes(work: Callable[[T], R], items: Sequence[T], count: int) -> Generator[Ended[R]]:
    """Yield how each item ended, as they end, from ``count`` processes; closing the iterator stops them."""
    first = _results_of_round(work, items, range(len(items)), count)
    return with_second_try(first, lambda suspects: _results_of_round(work, items, suspects, 1))


def with_second_try(
    first: Generator[Ended[R]], again: Callable[[Sequence[int]], Generator[Ended[R]]]
) -> Generator[Ended[R]]:
    """Yield the results of ``first``; items whose process died are tried once more, by ``again``, when the others are
    done.

    ``again`` gets their numbers and does these one at a time: an item that was killed for lack of memory, or because of
    another, then has the whole machine, and one that kills its process every time is identified.
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


def _results_of_round(
    work: Callable[[T], R], items: Sequence[T], indices: Sequence[int], count: int
) -> Generator[Ended[R]]:
    """Yield the results of the items at ``indices`` from ``count`` new processes, as they end.

    The processes have one BLAS thread each, and are stopped at the end, also if it is ended early.
    """
    # Pickled once, and unpickled where a failure can be reported: an error in a starting process is only a traceback.
    do = partial(_done, pickle.dumps(work))
    # Spawned: no state of this process, threads and locks least of all.
    spawn = multiprocessing.get_context("spawn")
    with _one_blas_thread(), ProcessPool(count, context=spawn, initializer=_begin_worker) as pool:
        try:
            with _without_ctrl_c():
                places: dict[Future[Ended[bytes]], int] = {
                    pool.schedule(do, args=(index, items[index])): index for index in indices
                }
            for future in as_completed(places):
                yield _result_of(places[future], future)
        finally:
            pool.stop()  # type: ignore[no-untyped-call]


def _result_of(index: int, future: Future[Ended[bytes]]) -> Ended[Any]:
    """Return the result of the finished ``future`` of item number ``index``, unpickled.

    A failure with the reason if its process ended with it (``died``), or the result could not be pickled or unpickled.
    """
    try:
        ended = future.result()
    except ProcessExpired as error:
        return Ended(index, reason=_last_words(error.exitcode), died=True)
    except Exception as error:  # results that cannot be pickled
        return Ended(index, reason=one_line(error))
    return ended if ended.value is None else attempt(pickle.loads, index, ended.value)


def _done(packed: bytes, index: int, item: object) -> Ended[bytes]:
    """Do an item in this process of the pool by the pickled function ``packed``; return its result, pickled.

    Any exception is a failure of the item, also when function or result cannot be unpickled or pickled. Asked to leave,
    the process ends with code 1.
    """
    try:
        return attempt(lambda item: pickle.dumps(pickle.loads(packed)(item)), index, item)
    except SystemExit:  # asked to leave; its files are closed by now
        os._exit(1)


def _begin_worker() -> None:
    """Prepare a process of the pool: own process group, no Ctrl-C, an orderly end on SIGTERM and with its parent,
    plug-ins.
    """
    # A group of its own: the parent passes on the terminal's Ctrl-C, and child processes can be ended with it.
    os.setpgid(0, 0)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that files are closed and subprocesses ended
    # The first thing at its end, so that a process that ends by itself is not interrupted in that.
    Finalize(None, signal.signal, args=(signal.SIGTERM, signal.SIG_IGN), exitpriority=_BEFORE_ALL)
    end_with_parent()
    use_effects()


def end_with_parent() -> None:
    """Start a thread that sends SIGTERM to this process of a pool when its parent has ended in any way.

    Call it only in a process that multiprocessing has started.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


def _last_words(code: int | None) -> str:
    if code is None or code >= 0:
        return f"its process ended with exit code {code}"
    hint = ", as happens when memory runs out" if code == -signal.SIGKILL else ""
    return f"its process was ended by signal {-code} ({signal.strsignal(-code)}{hint})"


@contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """Keep Ctrl-C from threads that are started here, and from their processes until these can ignore it."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _one_blas_thread() -> Iterator[None]:
    """Let processes that are started within this context have one BLAS thread each.

    It is by the environment, which is restored afterwards: forked processes would not heed it.
    """
    before = {name: os.environ.get(name) for name in ONE_BLAS_THREAD}
    os.environ.update(ONE_BLAS_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value
