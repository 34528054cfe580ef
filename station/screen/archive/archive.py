"""Recordings as the screen shows them, read by a child process that may be given up."""

from __future__ import annotations

import asyncio
import json
import math
import subprocess
import sys
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from station.run.snapshot import of_type

_LIMIT_S = 10.0
_WRITE_LIMIT_S = 120.0
_MOST_BYTES = 64 * 1024 * 1024
INVESTIGATION = "-investigation"
"""What is added to the name of a recording for the file of its investigation."""


@dataclass(frozen=True, slots=True)
class GyroEntry:
    """One gyro of a recording: its states (k, b_rps, sigma_j_rad, sigma_k_rad) and their sigmas."""

    name: str
    source: str
    states: tuple[float, ...]
    sds: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Entry:
    """One recording of a folder. ``wrong`` says why it cannot be read, and then nothing else is known of it.

    ``foreign``: it is no recording at all, but some other HDF5 file.
    """

    path: Path
    when_utc_s: float
    wrong: str = ""
    foreign: bool = False
    texts: Mapping[str, str] = field(default_factory=dict)
    devices: tuple[str, ...] = ()
    gyros: tuple[GyroEntry, ...] = ()

    @property
    def when(self) -> str:
        """Date and time of day here."""
        return f"{datetime.fromtimestamp(self.when_utc_s):%Y-%m-%d %H:%M}"

    @property
    def serial(self) -> str:
        """Serial number of the device under test, as the operator gave it."""
        return self.texts.get("device_serial", "")

    @property
    def device(self) -> str:
        """What identifies the device: its serial number, or else the names of the devices of the bench."""
        return self.serial or ", ".join(device for device in self.devices if device)

    def same_device(self, other: Entry) -> bool:
        """Whether both are of one device: the same serial number or, where neither has one, the same gyros."""
        if self.serial or other.serial:
            return self.serial == other.serial
        return bool(self.gyros) and self._gyro_names() == other._gyro_names()

    def same_calibrated(self, other: Entry) -> bool:
        """Whether the other is another recording of the device, with a calibration of the same gyros."""
        same_gyros = bool(self.gyros) and self._gyro_names() == other._gyro_names()
        return same_gyros and self.path != other.path and self.same_device(other)

    def _gyro_names(self) -> set[tuple[str, str]]:
        return {(gyro.source, gyro.name) for gyro in self.gyros}


@dataclass(frozen=True, slots=True)
class Whole:
    """A recording opened: its entry and everything that the result screen shows of it."""

    entry: Entry
    found: Mapping[str, Any]

    @property
    def limits(self) -> dict[str, float]:
        """Limits of its bench in SI, infinite where there is none."""
        given = self.found.get("limits") or {}
        return {key: math.inf if value is None else float(value) for key, value in given.items()}


class Archive:
    """Reads recordings one after the other. What takes too long or kills its reader is called damaged."""

    def __init__(self) -> None:
        """Nothing is started yet."""
        self._process: asyncio.subprocess.Process | None = None
        self._turn = asyncio.Lock()
        self._known: dict[tuple[Path, float, int], Entry] = {}

    async def entries(self, folder: Path) -> AsyncIterator[Entry]:
        """Yield the recordings of a folder and its subfolders, those that changed last first."""
        for path, when_utc_s, size in await asyncio.to_thread(_files, folder):
            key = (path, when_utc_s, size)
            if key not in self._known:
                self._known[key] = _entry(path, when_utc_s, await self._ask("entry", path))
            if not self._known[key].foreign:
                yield self._known[key]

    async def read(self, path: Path) -> Whole:
        """Return a whole recording; its entry says what is wrong, if something is."""
        try:
            when_utc_s = (await asyncio.to_thread(path.stat)).st_mtime
        except OSError as error:
            return Whole(Entry(path, 0.0, wrong=error.strerror or "it cannot be read"), {})
        found = await self._ask("whole", path)
        return Whole(_entry(path, when_utc_s, found), found)

    async def accept(self, path: Path, attributes: Mapping[str, str]) -> str:
        """Write who accepted a recording into it; return what went wrong, empty if nothing did."""
        found = await self._ask("accept", path, _WRITE_LIMIT_S, attributes=dict(attributes))
        if found.get("wrong"):
            async with self._turn:  # HDF5 does not get over a write that failed
                await self.close()
        return str(found.get("wrong", ""))

    async def close(self) -> None:
        """End the process that reads."""
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.kill()
            await self._process.wait()
        self._process = None

    async def _ask(self, what: str, path: Path, limit_s: float = _LIMIT_S, **more: Any) -> dict[str, Any]:
        async with self._turn:
            try:
                async with asyncio.timeout(limit_s):
                    line = await self._exchange(json.dumps({"do": what, "path": str(path), **more}))
            except TimeoutError:
                await self.close()
                return {"wrong": f"it is damaged, or its disk hangs: no end within {limit_s:g} s"}
            except asyncio.CancelledError:
                await self.close()  # else the next question would be given this one's answer
                raise
            except OSError:
                line = b""
            if not line:
                await self.close()
                return {"wrong": "it is damaged: the HDF5 library failed on it"}
            found = json.loads(line)
            return found if isinstance(found, dict) else {}

    async def _exchange(self, request: str) -> bytes:
        if self._process is None:
            self._process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "station.screen.archive.reader_process",
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                limit=_MOST_BYTES,
                start_new_session=True,
            )
        process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(request.encode() + b"\n")
        await process.stdin.drain()
        return await process.stdout.readline()


def last_before(entry: Entry, others: Sequence[Entry]) -> Entry | None:
    """Return the last of the others before this one."""
    earlier = [other for other in others if other.when_utc_s < entry.when_utc_s]
    return max(earlier, key=lambda other: other.when_utc_s, default=None)


def _files(folder: Path) -> list[tuple[Path, float, int]]:
    found = []
    for path in folder.rglob("*.h5"):
        with suppress(OSError):
            status = path.stat()
            found.append((path, status.st_mtime, status.st_size))
    return sorted(found, key=lambda file: file[1], reverse=True)


def _entry(path: Path, when_utc_s: float, found: Mapping[str, Any]) -> Entry:
    if found.get("wrong"):
        return Entry(path, when_utc_s, str(found["wrong"]), bool(found.get("foreign")))
    gyros = tuple(of_type(GyroEntry, {**gyro, "sds": gyro["sd"]}) for gyro in found.get("gyros", []))
    texts = {key: value for key, value in found.items() if isinstance(value, str)}
    began = found.get("began_utc_s")
    when = when_utc_s if began is None else float(began)
    return Entry(path, when, "", False, texts, tuple(found.get("devices", [])), gyros)
