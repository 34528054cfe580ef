"""Reads recordings in a separate process, which can be abandoned."""

import asyncio
import multiprocessing
import os
import sys
import time
from collections import deque
from collections.abc import AsyncGenerator, Mapping, Sequence
from concurrent.futures import TimeoutError as TooLong
from contextlib import aclosing, redirect_stderr, suppress
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from stat import S_ISREG
from typing import TYPE_CHECKING, Any

from station.screen.archive.entries import Entry, File, ReadRecording, moves
from station.views.history import Move

if TYPE_CHECKING:
    from pebble import ProcessPool

_LIMIT_S = 10.0
_WRITE_LIMIT_S = 120.0
_KEPT_AT_ONCE = 64
_MANY = 200  # files, to read which two processes a core are begun: one waits for its disk while another computes
_TICK_NS = 50_000_000  # a file that changed less ago may change again under the same date


class Archive:
    """Reads recordings in a limited number of processes. One that takes too long or kills its reader counts as
    damaged.
    """

    def __init__(self, count: int = 1) -> None:
        self._count, self._turn = count, asyncio.Semaphore(count)
        self._pool: ProcessPool | None = None
        self._known: dict[File, Entry] = {}
        self.unread = 0

    async def entries(self, folder: Path, *, deep: bool = True) -> AsyncGenerator[Entry]:
        """Yield the recordings of a folder and, if ``deep``, its subfolders: known or indexed ones first, then others.

        Both are in the order of their last change, newest first; ``unread`` counts the others that remain. New entries
        are indexed, except unreadable ones, which the next program tries again, and files that changed just now. HDF5
        files that are not recordings, and files that are gone by then, are left out; folders that cannot be read are
        unreadable entries.
        """
        from station.screen.archive import index  # with SQLite: not before the first picture

        began_ns, files = time.time_ns(), await asyncio.to_thread(_files, folder, deep)
        if not self._known.keys() >= set(files):
            self._known |= await asyncio.to_thread(index.load, folder)
        others = [file for file in files if file not in self._known]
        self.unread, unkept, enough = len(others), dict[File, Entry](), 1
        for entry in [self._known[file] for file in files if file in self._known]:
            if not entry.foreign:
                yield entry
        async with aclosing(self._read_all(others)) as found:
            async for file, entry in found:
                self._known[file], self.unread = entry, self.unread - 1
                if abs(began_ns - file[1]) > _TICK_NS and (entry.foreign or not entry.wrong):
                    unkept[file] = entry
                if len(unkept) >= enough or file == others[-1]:  # the disk may be slow, and no key waits for it
                    kept = await asyncio.to_thread(index.keep, folder, unkept)
                    unkept, enough = ({}, min(2 * enough, _KEPT_AT_ONCE)) if kept else (unkept, 2 * enough)
                if not entry.foreign and os.path.exists(file[0]):  # and was not deleted meanwhile
                    yield entry

    async def read(self, path: Path) -> ReadRecording:
        """Return a whole recording; its entry has the error, if there is one."""
        try:
            when_utc_s = (await asyncio.to_thread(path.stat)).st_mtime
        except OSError as error:
            return ReadRecording(Entry(str(path), 0.0, wrong=error.strerror or "it cannot be read"))
        return await self._read(path, when_utc_s, with_samples=True)

    async def accept(self, path: Path, attributes: Mapping[str, str]) -> str:
        """Write the acceptance into a recording; return the error, empty if there is none.

        After an error all reading processes are ended: the next call begins new ones.
        """
        async with self._turn:
            wrong = str(await self._do("accept", path, dict(attributes), limit_s=_WRITE_LIMIT_S))
            if wrong:  # HDF5 does not get over a write that failed
                await self.close()
        return wrong

    async def close(self) -> None:
        """End the processes that read."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()  # type: ignore[no-untyped-call]
            await asyncio.to_thread(pool.join)

    async def _read_all(self, files: Sequence[File]) -> AsyncGenerator[tuple[File, Entry]]:
        """Yield each file with its entry, in order, a few being read ahead; what is not yielded is cancelled.

        More than 200 files are read by processes of their own, two a core, which are closed at the end.
        """
        many = len(files) > _MANY
        readers, tasks = Archive(2 * (os.cpu_count() or 1)) if many else self, deque[asyncio.Task[ReadRecording]]()
        try:
            for at, file in enumerate(files):
                for path, mtime_ns, _ in files[at + len(tasks) : at + 2 * readers._count]:
                    tasks.append(asyncio.create_task(readers._read(Path(path), mtime_ns * 1e-9, with_samples=False)))
                yield file, (await tasks.popleft()).entry
        finally:
            for task in tasks:
                task.cancel()
            if many:
                await readers.close()

    async def _read(self, path: Path, when_utc_s: float, *, with_samples: bool) -> ReadRecording:
        async with self._turn:
            found = await self._do("read", path, when_utc_s, with_samples)
        return ReadRecording(Entry(str(path), when_utc_s, wrong=found)) if isinstance(found, str) else found

    async def _do(self, work: str, *about: Any, limit_s: float = _LIMIT_S) -> Any:
        """Run the function of ``reading`` that is named ``work`` in a process; return its result.

        Return a text in place of it if it took longer than ``limit_s`` or crashed; its exceptions are raised. ``about``
        are its arguments.
        """
        from pebble import ProcessExpired, ProcessPool  # not before the first picture

        if self._pool is None:
            with redirect_stderr(sys.__stderr__):  # its process gets a file; textual's stand-in is none
                resource_tracker.ensure_running()
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPool(self._count, context=spawn, initializer=_begin)
        try:
            return await asyncio.wrap_future(self._pool.schedule(_done, (work, *about), timeout=limit_s))
        except TooLong:
            return f"it is damaged, or its disk hangs: not read within {limit_s:g} s"
        except ProcessExpired:
            return "it is damaged: the HDF5 library failed on it"


async def moved(recording: Path) -> list[Move]:
    """Return what moved since the last comparable run in the recording's folder, without subfolders.

    Only what is read within ten seconds counts. Empty if nothing moved, or the run is not comparable or not read.
    """
    archive, found = Archive(), list[Entry]()
    entries = archive.entries(recording.absolute().parent, deep=False)
    with suppress(TimeoutError):
        async with asyncio.timeout(_LIMIT_S), aclosing(entries):
            async for entry in entries:
                found.append(entry)
    await archive.close()
    return moves(found).get(str(recording.absolute()), [])


def _begin() -> None:
    """Detach from the terminal, with HDF5's messages discarded, and lower the priority in favour of a run."""
    os.setsid()
    os.nice(10)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def _done(work: str, *about: Any) -> Any:
    from station.screen.archive import reading  # with HDF5, which the screen itself does without

    return getattr(reading, work)(*about)


def _files(folder: Path, deep: bool) -> list[File]:
    """Return path, time of change and size of the .h5 files in a folder and, if ``deep``, below it, newest first.

    Only regular files are listed, also by links to them, and folders that cannot be read, with time and size 0.
    """
    found: list[File] = []
    walk = os.walk(folder, onerror=lambda e: found.extend([(e.filename, 0, 0)] * os.path.exists(e.filename)))  # told
    for path in (os.path.join(top, name) for top, _, names in islice(walk, None if deep else 1) for name in names):
        with suppress(OSError):
            if path.endswith(".h5") and S_ISREG((status := os.stat(path)).st_mode):  # who reads a pipe waits
                found.append((path, status.st_mtime_ns, status.st_size))
    return sorted(found, key=lambda file: file[1], reverse=True)
