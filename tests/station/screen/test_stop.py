"""STOP and what else goes to a session, and what is left when the screen or the session goes."""

from __future__ import annotations

import json
import math
import threading
from pathlib import Path

import h5py
import pytest
from conftest import HistoryFirst, driven, keys, until
from streams import Replay
from textual import events
from textual.pilot import Pilot

from station.run.snapshot import GyroSnapshot, Phase, Snapshot
from station.screen.app import StationApp
from station.screen.bars import STOP_KEY, StopBar
from station.screen.choices import Choices
from station.screen.dialogs import ChooseDialog
from station.screen.sessions.live_run import LiveRun, Stage
from station.screen.tabs.prospects import Prospect
from station.views.json_values import json_object

PROSPECT = Prospect(bench="built-in twins", all_twins=True)
CHOICES = Choices("bench.toml", "short.toml", Path("recordings"), "A. Operator", "SN-0042", 1.0)


def said_by_bar(app: StationApp) -> str:
    return str(app.screen.query_one(StopBar).render())


def test_one_key_stops_from_everywhere_and_a_stop_that_is_not_heeded_is_told(place: Path) -> None:
    ways = {
        "the run": ["f9"],
        "the other key": ["ctrl+c"],
        "a note": ["n", *keys("door"), "f9", "escape"],
        "a question": ["ctrl+q", "f9", "escape"],
        "a filter": ["f5", "slash", "x", "f9"],
    }
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            for number, (where, way) in enumerate(ways.items(), 1):
                await pilot.press(*way)
                await until(pilot, lambda: len(session.heard) >= number)  # noqa: B023  awaited here
                assert session.heard == [{"do": "stop"}] * number, where
                assert number > 1 or "sent; waiting" in said_by_bar(app)
            await until(pilot, lambda: "NO REACTION: USE THE EMERGENCY STOP" in said_by_bar(app))
            assert app.screen.query_one(StopBar).has_class("-armed")

        driven(app, drive)


def test_stop_does_not_wait_for_an_app_that_is_held_up(place: Path) -> None:
    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            driver = app.get_driver_class()(app)  # as keys come: in a thread of its own
            reads = threading.Thread(target=driver.process_message, args=(events.Key(STOP_KEY, None),))
            reads.start()
            assert session.told.wait(10)  # meanwhile the app's loop does nothing at all
            reads.join()
            await until(pilot, lambda: "sent; waiting" in said_by_bar(app))
            assert session.heard == [{"do": "stop"}]

        driven(app, drive)


def test_stop_reaches_sessions_that_are_not_shown(place: Path) -> None:
    with Replay("stopped", 30.0, after_stop="stopped") as session:
        app = HistoryFirst(CHOICES)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: isinstance(app.screen, ChooseDialog))
            await pilot.press("escape")
            await until(pilot, lambda: "stops your session, not shown here" in said_by_bar(app))
            await pilot.press("f9")
            await until(pilot, lambda: app.shown and app.shown.stage is Stage.ENDED)
            assert app.shown is not None
            assert app.shown.outcome == "ABORTED"

        driven(app, drive)
        assert session.heard == [{"do": "stop"}]


def test_stop_right_after_start_starts_nothing(place: Path) -> None:
    app = HistoryFirst(CHOICES)

    async def drive(pilot: Pilot[None]) -> None:
        app.start_run(PROSPECT)
        app.action_stop()
        await pilot.pause()
        assert app.shown is None
        assert all(worker.is_finished for worker in app.workers if worker.group == "start")

    driven(app, drive)
    assert not Path("recordings").exists()


def test_who_attaches_late_sees_how_the_estimates_went() -> None:
    early = {"t_s": 1.0, "sensors": {"s g": [[0.1] * 4, [1.0] * 4]}}
    late = {"t_s": 2.0, "sensors": {"s g": [[0.2] * 4, [0.5] * 4], "unknown": [[None] * 4, [1.0] * 4]}}
    run = LiveRun()
    gyro = GyroSnapshot("g", "s", (0.3,) * 4, (0.4,) * 4, 1.0)
    run.take({"kind": "snapshot", **json_object(Snapshot(Phase.RUNNING, "x", 2.0, 1, 1, 0, 1.0, gyros=(gyro,)))})
    run.take({"kind": "course", "points": [early, late]})
    for damaged in (
        [{}],
        [{"t_s": 3.0, "sensors": [1.0]}],
        [1.0],
        None,
        [{"t_s": 3.0, "sensors": {"s g": [1.0, 1.0]}}],
    ):
        run.take({"kind": "course", "points": damaged})
    assert run.trends["s g"].times_s == [1.0, 2.0]
    assert [values[0] for values in run.trends["s g"].values] == [0.1, 0.2]
    assert set(run.trends) == {"s g"}


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
        await pilot.press("f4")  # not opened by itself, but what has just ended
        await until(pilot, lambda: "ABORTED" in str(second.screen.query_one("#verdict").render()))

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
        await until(pilot, lambda: "it has no [[step]]" in str(app.screen.query_one("#progress").render()))

    driven(app, drive)


@pytest.mark.parametrize(
    ("label", "longer_s", "left"),
    [
        ("estimating", 0.0, "0:22"),
        ("coming to rest", 0.0, "0:22"),
        ("table at rest", 0.0, "0:22"),
        ("soaking", 300.0, "0:22 to 5:22"),
    ],
)
def test_a_label_of_a_step_says_nothing_of_the_run(place: Path, label: str, longer_s: float, left: str) -> None:
    with Replay("pass", 20.0, label=label, longer_s=longer_s) as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await pilot.press("f3")
            await until(pilot, lambda: f"running, {left} left" in said_by_bar(app))
            await until(pilot, lambda: label in str(app.screen.query_one("#progress").render()))
            assert f"{left} left of " in str(app.screen.query_one("#progress").render())
            if longer_s:  # where steps begin is then not known, but seen: all have one label here
                assert app.shown is not None
                assert len(app.shown.steps_begin_s) == 1
            await pilot.press("f9")
            await until(pilot, lambda: "sent; waiting" in said_by_bar(app))
            session.vanish()
            await until(pilot, lambda: "TABLE NOT SEEN AT REST: USE THE EMERGENCY STOP" in said_by_bar(app))

        driven(app, drive)


def test_the_bar_says_nothing_of_a_run_that_is_not_the_one_on_the_screen(place: Path, runs: Path) -> None:
    """A PASS from History stood above a green "the run has ended: FAULT, table at rest"."""
    with Replay("fault", math.inf):
        app = StationApp(Choices(bench="bench.toml", script="short.toml", folder=runs), attach=True)

        def said() -> str:
            return str(app.screen.query_one(StopBar).render())

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: "the run has ended: FAULT" in said())
            await pilot.press("f5")
            await until(pilot, lambda: app.current_mode == "history" and app.screen.query_one("DataTable").row_count)
            await pilot.press("enter")
            await until(pilot, lambda: app.current_mode == "result" and app.screen.query("#figures"))
            await until(pilot, lambda: said() and "FAULT" not in said())
            await pilot.press("f3")
            await until(pilot, lambda: "the run has ended: FAULT" in said())

        driven(app, drive)


async def open_another(app: StationApp, pilot: Pilot[None]) -> None:
    """Open the first recording of the history once the run that is shown has ended."""
    await until(pilot, lambda: app.shown and app.shown.settled)
    await pilot.press("f5")
    await until(pilot, lambda: app.current_mode == "history" and app.screen.query_one("DataTable").row_count)
    await pilot.press("enter")
    await until(pilot, lambda: app.current_mode == "result" and app.screen.query("#figures"))


def test_stop_reaches_a_session_that_begins_after_the_shown_run_has_ended(place: Path, runs: Path) -> None:
    with Replay("fault", math.inf) as ended:
        app = StationApp(Choices(bench="bench.toml", script="short.toml", folder=runs), attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await open_another(app, pilot)
            before = app.shown
            with Replay("stopped", 30.0, after_stop="stopped", pid=4243) as session:
                await until(pilot, lambda: "stops your session, not shown here" in said_by_bar(app))
                await pilot.press("f9")
                await until(pilot, lambda: app.shown is not before and app.shown and app.shown.stage is Stage.ENDED)
                assert app.shown is not None
                assert app.shown.outcome == "ABORTED"
                assert session.heard == [{"do": "stop"}]

        driven(app, drive)
        assert not ended.heard


def test_sessions_are_counted_without_the_one_whose_run_was_shown(place: Path, runs: Path) -> None:
    with Replay("fault", math.inf):
        app = HistoryFirst(Choices(bench="bench.toml", script="short.toml", folder=runs))

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: isinstance(app.screen, ChooseDialog))
            await pilot.press("enter")
            await open_another(app, pilot)
            await until(pilot, lambda: "not shown here" not in said_by_bar(app))
            with Replay("pass", 20.0, pid=4243), Replay("pass", 20.0, pid=4244):
                await until(pilot, lambda: "stops your 2 sessions, not shown here" in said_by_bar(app))
            await until(pilot, lambda: "not shown here" not in said_by_bar(app))

        driven(app, drive)


def test_stop_is_for_no_other_session_while_the_bar_is_about_a_run_that_has_ended(place: Path) -> None:
    """One more press, when the table is at rest, must not end what runs on another bench."""
    with Replay("stopped", 30.0, after_stop="stopped") as session:
        app = StationApp(CHOICES, attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            await pilot.press("f9")
            await until(pilot, lambda: "the run has ended: ABORTED, table at rest" in said_by_bar(app))
            stopped = app.shown
            with Replay("pass", 20.0, pid=4243) as other:
                await until(pilot, lambda: app.others)
                await pilot.press("f9")
                await until(pilot, lambda: all(w.is_finished for w in app.workers if w.group in ("sessions", "stop")))
                assert app.shown is stopped
                assert not other.heard

        driven(app, drive)
        assert session.heard == [{"do": "stop"}]


def test_a_stop_that_was_sent_to_the_run_shown_is_for_no_other_when_the_app_is_late(place: Path, runs: Path) -> None:
    with Replay("stopped", 30.0, after_stop="stopped") as session:
        app = StationApp(Choices(bench="bench.toml", script="short.toml", folder=runs), attach=True)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: app.shown and app.shown.snapshot)
            app.stop_from_thread()
            await until(pilot, lambda: app.shown and app.shown.at_rest)
            await open_another(app, pilot)
            with Replay("pass", 20.0, pid=4243) as other:
                await until(pilot, lambda: app.others)
                app.action_stop()
                await until(pilot, lambda: all(w.is_finished for w in app.workers if w.group in ("sessions", "stop")))
                assert not other.heard

        driven(app, drive)
        assert session.heard == [{"do": "stop"}]


def test_a_small_terminal_says_how_many_sessions_it_does_not_show(place: Path) -> None:
    with Replay("pass", 20.0), Replay("pass", 20.0, pid=4243):
        app = HistoryFirst(CHOICES)

        async def drive(pilot: Pilot[None]) -> None:
            await until(pilot, lambda: "stops your 2 sessions" in said_by_bar(app))
            await until(pilot, lambda: "sessions not shown: 2" in str(app.screen.query_one("#small").render()))

        driven(app, drive, (50, 12))
