"""A place of its own for each test of the screen; stored recordings; how to wait for what is shown."""

from __future__ import annotations

import asyncio
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import forks
import h5py
import pytest
from textual.css.query import NoMatches
from textual.pilot import Pilot

from station.screen.app import StationApp

sys.path.insert(0, str(Path(__file__).parent))

from streams import SCRIPT, STREAMS, TINY, bench_text

_DAY_S = 86_400
_LOOKS_S = 0.02
_NOON_S = 1_795_262_400  # 2026-11-21 12:00:00 UTC


class HistoryFirst(StationApp):
    """An app that does not begin by asking devices."""

    DEFAULT_MODE = "history"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty working folder with a bench and a short script; nothing remembered, no sessions, UTC.

    What a screen in this process asks other commands is answered by forks.
    """
    with tempfile.TemporaryDirectory(prefix="st-") as sockets:  # a socket's address must be short
        for name, value in {
            "XDG_RUNTIME_DIR": sockets,
            "TMPDIR": sockets,
            "XDG_STATE_HOME": str(tmp_path / "state"),
            "TZ": "UTC",
        }.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setattr(tempfile, "tempdir", None)
        monkeypatch.setattr(sys, "executable", forks.interpreter())
        monkeypatch.delenv("NO_COLOR", raising=False)
        monkeypatch.chdir(tmp_path)
        time.tzset()
        (tmp_path / "bench.toml").write_text(bench_text())
        (tmp_path / "short.toml").write_text(SCRIPT)
        yield tmp_path
        monkeypatch.undo()
        time.tzset()


@pytest.fixture(scope="session")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of two stored recordings of one device, first.h5 passed, second.h5 failed, and their script."""
    folder = tmp_path_factory.mktemp("runs")
    (folder / "tiny.toml").write_text(TINY)
    for name in ("first", "second"):
        shutil.copy(STREAMS / f"{name}.h5", folder)
    return folder


@pytest.fixture
def recordings(place: Path, runs: Path) -> Path:
    """Return a folder of recordings: a pass, a fail a day later, one of another format version, one damaged."""
    folder = place / "recordings"
    folder.mkdir()
    for name in ("first", "second"):
        shutil.copy(runs / f"{name}.h5", folder)
    shutil.copy(runs / "first.h5", folder / "later.h5")
    with h5py.File(folder / "later.h5", "r+") as file:
        file.attrs["format_version"] = 99
    whole = (folder / "first.h5").read_bytes()
    (folder / "torn.h5").write_bytes(whole[: len(whole) // 2])
    for days, name in enumerate(("first", "second", "later", "torn")):
        os.utime(folder / f"{name}.h5", (_NOON_S + days * _DAY_S,) * 2)
    return folder


async def until(pilot: Pilot[None], holds: Callable[[], object], limit_s: float = 60.0) -> None:
    """Let the app go on until something holds. What asks for a part of a screen that is on its way in does not yet."""
    async with asyncio.timeout(limit_s):
        while not _holds(holds):
            await asyncio.sleep(_LOOKS_S)  # not the pilot's pause, which has every widget answer and draws anew
    await pilot.pause()


def _holds(holds: Callable[[], object]) -> bool:
    try:
        return bool(holds())
    except NoMatches:
        return False


def keys(text: str) -> list[str]:
    """Return the keys that type a text."""
    return [{" ": "space", ".": "full_stop", "-": "minus"}.get(letter, letter) for letter in text]


def driven(app: StationApp, drive: Callable[[Pilot[None]], Awaitable[None]], size: tuple[int, int] = (80, 24)) -> None:
    """Drive an app in a terminal of a size."""

    async def run() -> None:
        async with app.run_test(size=size) as pilot:
            await drive(pilot)

    asyncio.run(run())
