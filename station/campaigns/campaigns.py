"""Many items of work, each on its own: on all cores of this machine, or on a Dask cluster."""

import os
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import TypeVar

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from drivers.plugins import GIVEN
from station.campaigns.worker_pool import Ended, attempt, run_in_processes
from station.errors import UsageError
from station.render.progress import Bar

T = TypeVar("T")
R = TypeVar("R")

_PLAIN_LINES = 10  # without a terminal: the largest number of lines


@dataclass(frozen=True, slots=True)
class Failure:
    """The name of an item that failed, and the reason in one line."""

    item: str
    reason: str


def run_all(
    work: Callable[[T], R],
    items: Sequence[T],
    *,
    label: str,
    scheduler: str | None = None,
    workers: int | None = None,
    quiet: bool = False,
    name_of: Callable[[T], str] = str,
) -> tuple[list[R | None], list[Failure]]:
    """Return ``work(item)`` for each item, in order (None where it failed), and the failures, named by ``name_of``.

    Failures are in the order of the items. An exception of ``work`` is the failure of its item only. ``work``, items
    and results must be picklable. They run in ``workers`` processes (default: one per core; in this process if there is
    one worker or item), or on the cluster at ``scheduler`` (tcp://host:port). The results are the same in each case to
    the last bit, if this process, too, has one BLAS thread. Progress goes to stderr, under ``label``, unless ``quiet``.
    UsageError if there is no such cluster, or plug-in files are in use with one.
    """
    results: list[R | None] = [None] * len(items)
    reasons: dict[int, str] = {}
    with closing(_results_as_they_end(work, items, scheduler, workers)) as ends, _Bar(label, len(items), quiet) as bar:
        for ended in ends:
            if ended.reason is None:
                results[ended.index] = ended.value
            else:
                reasons[ended.index] = ended.reason
            bar.count(len(reasons))
    return results, [Failure(name_of(items[i]), reasons[i]) for i in sorted(reasons)]


def _results_as_they_end(
    work: Callable[[T], R], items: Sequence[T], scheduler: str | None, workers: int | None
) -> Generator[Ended[R]]:
    """Yield the result of each item as it ends: from the cluster ``scheduler``, from ``workers`` processes, or computed
    here.

    Without ``workers``, or with 0, there are as many as cores that this process may use; with a single one, or a single
    item, all is computed here, in order. UsageError as for ``run_all``.
    """
    if scheduler is not None:
        from station.campaigns.cluster import run_on_cluster

        if os.environ.get(GIVEN):
            raise UsageError("--plugin does not work on a cluster: install the plug-in as a package on every worker")
        yield from run_on_cluster(work, items, scheduler)
        return
    count = min(workers or len(os.sched_getaffinity(0)), len(items))
    if count > 1:
        yield from run_in_processes(work, items, count)
        return
    for index, item in enumerate(items):
        yield attempt(work, index, item)


class _Bar(Bar):
    """Progress of a campaign."""

    def __init__(self, label: str, total: int, quiet: bool) -> None:
        """Show nothing if quiet."""
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        super().__init__(quiet, *columns, TextColumn("{task.fields[failed]}"), begins=label, total=total, failed="")
        self._label, self._total = label, total
        self._done = 0

    def count(self, failed: int) -> None:
        """Count one item more, and show how many ended, ``failed`` among them; ten lines in all without a terminal."""
        self._done += 1
        text = f"{failed} failed" if failed else ""
        line = f"{self._label}: {self._done} of {self._total}  {text}".rstrip()
        due = self._done * _PLAIN_LINES // self._total > (self._done - 1) * _PLAIN_LINES // self._total
        self._tell(line, 0.0, due, completed=self._done, failed=text)
