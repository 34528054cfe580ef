"""Reads recordings in a process beside the screen that may be given up."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import sys
import time
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import TimeoutError as TooLong
from contextlib import redirect_stderr, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from station.screen.archive.entries import Entry, Whole
from station.screen.archive.index import File, keep, load

if TYPE_CHECKING:
    from pebble import ProcessPool

_LIMIT_S = 10.0
_WRITE_LIMIT_S = 120.0
_TICK_NS = 50_000_000  # a file that changed less ago may change again under the same date


class Archive:
    """Reads recordings one after the other. What takes too long or kills its reader is called damaged."""

    def __init__(self) -> None:
        self._pool: ProcessPool | None = None
        self._turn = asyncio.Lock()
        self._known: dict[File, Entry] = {}
        self.unread = 0

    async def entries(self, folder: Path) -> AsyncIterator[Entry]:
        """Yield the recordings of a folder and its subfolders: known ones, then ``unread`` others.

        Of both those that changed last come first. What is read is indexed at once; what cannot be read is tried again
        by the next program.
        """
        files = await asyncio.to_thread(_files, folder)
        if not self._known.keys() >= set(files):
            self._known |= await asyncio.to_thread(load, folder)
        others = {file for file in files if file not in self._known}
        self.unread = len(others)
        for file in sorted(files, key=others.__contains__):
            if file not in self._known:
                settled = abs(time.time_ns() - file[1]) > _TICK_NS
                entry = (await self._read(Path(file[0]), file[1] * 1e-9, everything=False)).entry
                self._known[file], self.unread = entry, self.unread - 1
                if settled and (entry.foreign or not entry.wrong):
                    await asyncio.to_thread(keep, folder, file, entry)  # the disk may be slow, and no key waits for it
            if not self._known[file].foreign:
                yield self._known[file]

    async def read(self, path: Path) -> Whole:
        """Return a whole recording; its entry says what is wrong, if something is."""
        try:
            when_utc_s = (await asyncio.to_thread(path.stat)).st_mtime
        except OSError as error:
            return Whole(Entry(path, 0.0, wrong=error.strerror or "it cannot be read"))
        return await self._read(path, when_utc_s, everything=True)

    async def accept(self, path: Path, attributes: Mapping[str, str]) -> str:
        """Write who accepted a recording into it; return what went wrong, empty if nothing did."""
        async with self._turn:
            wrong = str(await self._do("accept", path, dict(attributes), limit_s=_WRITE_LIMIT_S))
            if wrong:  # HDF5 does not get over a write that failed
                await self.close()
        return wrong

    async def close(self) -> None:
        """End the process that reads."""
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()  # type: ignore[no-untyped-call]
            await asyncio.to_thread(pool.join)

    async def _read(self, path: Path, when_utc_s: float, *, everything: bool) -> Whole:
        async with self._turn:
            found = await self._do("read", path, when_utc_s, everything)
        return Whole(Entry(path, when_utc_s, wrong=found)) if isinstance(found, str) else found

    async def _do(self, work: str, *about: Any, limit_s: float = _LIMIT_S) -> Any:
        """Return what a function of ``reading`` comes to, or in words why it came to nothing."""
        from pebble import ProcessExpired, ProcessPool  # not before the first picture

        if self._pool is None:
            with redirect_stderr(sys.__stderr__):  # its process gets a file; textual's stand-in is none
                resource_tracker.ensure_running()
            spawn = multiprocessing.get_context("spawn")
            self._pool = ProcessPool(1, context=spawn, initializer=_begin)
        try:
            return await asyncio.wrap_future(self._pool.schedule(_done, (work, *about), timeout=limit_s))
        except TooLong:
            return f"it is damaged, or its disk hangs: no end within {limit_s:g} s"
        except ProcessExpired:
            return "it is damaged: the HDF5 library failed on it"


def _begin() -> None:
    """Leave the terminal to the screen: what HDF5 says of errors, too."""
    os.setsid()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def _done(work: str, *about: Any) -> Any:
    from station.screen.archive import reading  # with HDF5, which the screen itself does without

    return getattr(reading, work)(*about)


def _files(folder: Path) -> list[File]:
    found = []
    for path in (os.path.join(top, name) for top, _, names in os.walk(folder) for name in names):
        with suppress(OSError):
            if path.endswith(".h5"):
                found.append((path, (status := os.stat(path)).st_mtime_ns, status.st_size))
    return sorted(found, key=lambda file: file[1], reverse=True)
