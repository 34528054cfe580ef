"""Reads recordings in a process beside the screen that may be given up."""

from __future__ import annotations

import asyncio
import multiprocessing
import os
import sys
from collections.abc import AsyncIterator, Mapping
from concurrent.futures import TimeoutError as TooLong
from contextlib import redirect_stderr, suppress
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from pebble import ProcessExpired, ProcessPool

from station.screen.archive.entries import Entry, Whole

_LIMIT_S = 10.0
_WRITE_LIMIT_S = 120.0


class Archive:
    """Reads recordings one after the other. What takes too long or kills its reader is called damaged."""

    def __init__(self) -> None:
        self._pool: ProcessPool | None = None
        self._turn = asyncio.Lock()
        self._known: dict[tuple[Path, float, int], Entry] = {}

    async def entries(self, folder: Path) -> AsyncIterator[Entry]:
        """Yield the recordings of a folder and its subfolders, those that changed last first."""
        for path, when_utc_s, size in await asyncio.to_thread(_files, folder):
            key = (path, when_utc_s, size)
            if key not in self._known:
                self._known[key] = (await self._read(path, when_utc_s, everything=False)).entry
            if not self._known[key].foreign:
                yield self._known[key]

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


def _files(folder: Path) -> list[tuple[Path, float, int]]:
    found = []
    for path in folder.rglob("*.h5"):
        with suppress(OSError):
            status = path.stat()
            found.append((path, status.st_mtime, status.st_size))
    return sorted(found, key=lambda file: file[1], reverse=True)
