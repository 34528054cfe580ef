"""Every screen in its states, driven by keys, as pictures; what it is shown comes from sessions on twins."""

from __future__ import annotations

import os
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from conftest import HistoryFirst, keys, until
from streams import Replay
from textual.pilot import Pilot
from textual.widgets import Footer

from station.screen.app import StationApp
from station.screen.choices import Choices
from station.screen.sessions.live_run import Stage

Compare = Callable[..., bool]
Before = Callable[[Pilot[None]], Awaitable[None]]

SMALL, WIDE, LARGE = (80, 24), (120, 40), (200, 60)
SIZES = pytest.mark.parametrize("size", [SMALL, WIDE, LARGE], ids=["80x24", "120x40", "200x60"])
CHOICES = Choices(bench="bench.toml", script="short.toml", folder=Path("recordings"))


def attached(app: StationApp, elapsed_s: float, *pressed: str) -> Before:
    """Return what waits until the app shows a run at an instant, and then presses keys."""

    async def before(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: (run := app.shown) and run.snapshot and run.snapshot.elapsed_s >= elapsed_s)
        await drawn(pilot, app)
        await pilot.press("right", "left", *pressed)  # draws the charts anew
        await pilot.pause()

    return before


async def drawn(pilot: Pilot[None], app: StationApp) -> None:
    """Wait until the charts are there."""

    def done() -> bool:
        parts = [part.children for part in app.screen.query("Charts") if part.display]
        charts = [[chart for chart in part if chart.display and chart.size.area] for part in parts]
        return bool(parts) and all(charts) and all(chart.border_title for part in charts for chart in part)

    await until(pilot, done)


def test_prepare_says_what_is_not_green(place: Path, snap_compare: Compare) -> None:
    app = StationApp(Choices("bench.toml", "none.toml", link_options=("--link", "table=tcp://127.0.0.1:1")))

    async def before(pilot: Pilot[None]) -> None:
        await pilot.press(*keys("a. operator"))
        await until(pilot, lambda: "nothing answers" in str(app.screen.query_one("#ready").render()))

    assert snap_compare(app, terminal_size=SMALL, run_before=before)


@SIZES
def test_prepare_is_ready_when_all_is_green(place: Path, snap_compare: Compare, size: tuple[int, int]) -> None:
    app = StationApp(CHOICES)

    async def before(pilot: Pilot[None]) -> None:
        await pilot.press(*keys("A. Operator"), "enter")
        await pilot.press(*keys("SN-0042"))
        await until(pilot, lambda: "READY" in str(app.screen.query_one("#summary").render()).split()[:1])
        await drawn(pilot, app)

    assert snap_compare(app, terminal_size=size, run_before=before)


def test_a_bench_file_that_is_wrong_is_told_with_its_line(place: Path, snap_compare: Compare) -> None:
    bench = place / "bench.toml"
    bench.write_text(bench.read_text().replace("poll_rate =", "pol_rate ="))
    app = StationApp(CHOICES)

    async def before(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: "pol_rate" in str(app.screen.query_one("#ready").render()))

    assert snap_compare(app, terminal_size=SMALL, run_before=before)


@pytest.mark.parametrize(("key", "mode"), [("f3", "run"), ("f4", "result"), ("f5", "history")])
def test_screens_without_anything_to_show(place: Path, snap_compare: Compare, key: str, mode: str) -> None:
    async def before(pilot: Pilot[None]) -> None:
        await pilot.press(key)
        await until(pilot, lambda: app.current_mode == mode and app.screen.query_one(Footer).children)
        await until(pilot, lambda: all(key.size.width for key in app.screen.query_one(Footer).children))

    app = HistoryFirst(CHOICES)
    assert snap_compare(app, terminal_size=SMALL, run_before=before)


@SIZES
def test_a_run(place: Path, snap_compare: Compare, size: tuple[int, int]) -> None:
    with Replay("pass", 36.0):
        app = StationApp(CHOICES, attach=True)
        assert snap_compare(app, terminal_size=size, run_before=attached(app, 35.0))


@pytest.mark.parametrize("charts", [4, 9], ids=["temperature", "axes"])
def test_another_chart_of_another_gyro_enlarged_at_80_x_24(place: Path, snap_compare: Compare, charts: int) -> None:
    with Replay("pass", 36.0):
        app = StationApp(CHOICES, attach=True)
        assert snap_compare(app, terminal_size=SMALL, run_before=attached(app, 35.0, "right", *"c" * charts, "z"))


def test_a_note_is_asked_for_with_stop_in_sight(place: Path, snap_compare: Compare) -> None:
    with Replay("pass", 20.0):
        app = StationApp(CHOICES, attach=True)
        assert snap_compare(app, terminal_size=SMALL, run_before=attached(app, 19.0, "n", *keys("door opened")))


def test_a_run_that_is_stopped(place: Path, snap_compare: Compare) -> None:
    with Replay("stopped", 30.0, after_stop="stopped") as session:
        app = StationApp(CHOICES, attach=True)

        async def before(pilot: Pilot[None]) -> None:
            await attached(app, 29.0)(pilot)
            await pilot.press("f9")
            await until(pilot, lambda: app.shown and app.shown.stage is Stage.ENDED)
            await pilot.press("right", "left")

        assert snap_compare(app, terminal_size=SMALL, run_before=before)
        assert session.heard == [{"do": "stop"}]


@pytest.mark.parametrize(
    ("end", "stage"), [(Replay.hang_up, Stage.LOST), (Replay.vanish, Stage.ENDED)], ids=["lost", "killed"]
)
def test_a_run_whose_session_is(
    place: Path, snap_compare: Compare, end: Callable[[Replay], None], stage: Stage
) -> None:
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def before(pilot: Pilot[None]) -> None:
            await attached(app, 19.0)(pilot)
            end(session)
            await until(pilot, lambda: app.shown and app.shown.stage is stage)
            if stage is Stage.ENDED:
                await until(pilot, lambda: app.shown and "Its recording" in app.shown.trouble)

        assert snap_compare(app, terminal_size=SMALL, run_before=before)


def test_a_fault_of_the_table(place: Path, snap_compare: Compare) -> None:
    with Replay("fault", 1e9):
        app = StationApp(CHOICES, attach=True)

        async def before(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.stage is Stage.ENDED)
            await pilot.press("right", "left")

        assert snap_compare(app, terminal_size=LARGE, run_before=before)


@pytest.mark.parametrize(("name", "size"), [("first", LARGE), ("second", WIDE), ("second", SMALL)])
def test_a_result(recordings: Path, snap_compare: Compare, name: str, size: tuple[int, int]) -> None:
    app = HistoryFirst(Choices(folder=Path("recordings"), operator="A. Operator"))

    async def before(pilot: Pilot[None]) -> None:
        app.open_recording(Path(f"recordings/{name}.h5"))
        expected = "none of it" if name == "first" else "first.h5"
        await until(pilot, lambda: app.current_mode == "result" and app.screen.query("#change"))
        await drawn(pilot, app)
        await until(pilot, lambda: expected in str(app.screen.query_one("#change").render()))
        if size == SMALL:  # why a FAIL is not accepted
            await pilot.press("a")
            await until(pilot, lambda: app.screen.query("Toast"))

    assert snap_compare(app, terminal_size=size, run_before=before)


@SIZES
def test_history(recordings: Path, snap_compare: Compare, size: tuple[int, int]) -> None:
    app = HistoryFirst(Choices(folder=Path("recordings")))

    async def before(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: "4 recordings in recordings   (" in str(app.screen.query_one("#folder").render()))
        await pilot.press("down", "down")
        await drawn(pilot, app)
        await until(pilot, lambda: "2 calibrations" in str(app.screen.query_one("#trend").render()))

    assert snap_compare(app, terminal_size=size, run_before=before)


def test_a_terminal_that_is_too_small_keeps_stop_in_sight(place: Path, snap_compare: Compare) -> None:
    with Replay("pass", 20.0):
        app = StationApp(CHOICES, attach=True)
        assert snap_compare(app, terminal_size=(60, 15), run_before=attached(app, 19.0))


def test_without_colours_every_state_is_a_word(
    place: Path, snap_compare: Compare, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(os.environ, "NO_COLOR", "1")
    with Replay("pass", 20.0):
        app = StationApp(CHOICES, attach=True)
        assert snap_compare(app, terminal_size=SMALL, run_before=attached(app, 19.0))
