"""STOP and what else goes to a session, and what is left when the screen or the session goes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable
from pathlib import Path

import h5py
import pytest
from conftest import HistoryFirst, keys, until
from streams import Replay
from textual.pilot import Pilot

from station.screen.app import StationApp
from station.screen.bars import StopBar
from station.screen.choices import Choices
from station.screen.live_run import Stage
from station.screen.prospects import Prospect

PROSPECT = Prospect(bench="built-in twins", all_twins=True)
CHOICES = Choices("bench.toml", "short.toml", Path("recordings"), "A. Operator", "SN-0042", 1.0)


def driven(app: StationApp, drive: Callable[[Pilot[None]], Awaitable[None]], size: tuple[int, int] = (80, 24)) -> None:
    async def run() -> None:
        async with app.run_test(size=size) as pilot:
            await drive(pilot)

    asyncio.run(run())


@pytest.mark.parametrize(
    "way",
    [["f9"], ["ctrl+c"], ["n", *keys("door"), "f9"], ["f5", "slash", "x", "f9"], ["ctrl+q", "f9"]],
    ids=["run", "ctrl+c", "within a note", "within a filter", "within a question"],
)
def test_one_key_stops_from_everywhere(place: Path, way: list[str]) -> None:
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            await pilot.press(*way)
            await until(pilot, lambda: session.heard)
            assert session.heard == [{"do": "stop"}]
            assert app.screen.query_one(StopBar).has_class("-sent")

        driven(app, drive)


def test_a_press_on_the_bar_stops_also_in_a_terminal_that_is_too_small(place: Path) -> None:
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            await pilot.mouse_down(StopBar)
            await until(pilot, lambda: session.heard)

        driven(app, drive, (50, 12))
        assert session.heard == [{"do": "stop"}]


def test_pause_and_notes_reach_the_session_and_leaving_lets_it_run(place: Path) -> None:
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            await pilot.press("p", "n", *keys("door opened"), "enter")
            await until(pilot, lambda: len(session.heard) == 2)
            await pilot.press("ctrl+q", "tab", "enter")
            await until(pilot, lambda: not app.is_running)

        driven(app, drive)
        assert session.heard == [{"do": "pause"}, {"do": "note", "text": "door opened"}]


def test_a_run_begun_on_the_screen_outlives_it_and_is_shown_and_stopped_by_another(place: Path) -> None:
    first, second = HistoryFirst(CHOICES), StationApp(CHOICES, attach=True)

    async def begin(pilot: Pilot[None]) -> None:
        first.start_run(PROSPECT)
        await until(pilot, lambda: first.shown and first.shown.snapshot)

    async def end(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: second.shown and second.shown.stage is Stage.RUNNING)
        await pilot.press("f9")
        await until(pilot, lambda: second.shown and second.shown.stage is Stage.ENDED)
        assert second.shown is not None
        assert second.shown.outcome == "ABORTED", second.shown.result
        assert second.screen.query_one(StopBar).has_class("-rest")

    driven(first, begin)
    driven(second, end)
    (recording,) = Path("recordings").glob("*.h5")
    with h5py.File(recording) as file:
        assert file.attrs["operator"] == "A. Operator"
        assert file.attrs["device_serial"] == "SN-0042"
        assert file["events/text"][-1] == b"table at rest"
    assert json.loads((place / "state/turntable-station/screen.json").read_text())["operator"] == "A. Operator"


def test_a_run_that_is_refused_says_why(place: Path) -> None:
    (place / "short.toml").write_text("")
    app = HistoryFirst(CHOICES)

    async def drive(pilot: Pilot[None]) -> None:
        app.start_run(PROSPECT)
        await until(pilot, lambda: app.shown and app.shown.stage is Stage.ENDED)
        await until(pilot, lambda: "no [[step]] in it" in str(app.screen.query_one("#progress").render()))

    driven(app, drive)
