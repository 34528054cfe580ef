"""Charts of a run: all that there is room for, one after the other where there is little, back in time on demand."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from conftest import HistoryFirst, driven, keys, until
from streams import STREAMS, Replay
from textual.binding import Binding
from textual.command import CommandList
from textual.pilot import Pilot
from textual.widget import Widget
from textual.widgets import DataTable, Input

from station.run.snapshot import snapshot_of
from station.screen.app import StationApp
from station.screen.bars import StopBar
from station.screen.choices import Choices
from station.screen.tabs.history import HistoryScreen

CHOICES = Choices(bench="bench.toml", script="short.toml", folder=Path("recordings"))


def charts(app: StationApp) -> list[Widget]:
    """Return the charts that are in sight, whole."""
    found = [chart for chart in app.screen.query("Chart") if chart.visible and chart.region.area]
    return [chart for chart in found if app.screen.find_widget(chart).visible_region == chart.region]


def title(chart: Widget) -> str:
    """Return what is said above a chart."""
    return str(chart.border_title)


def test_a_snapshot_tells_rate_and_residual_of_each_gyro_and_one_of_before_is_read() -> None:
    lines = [json.loads(line) for line in (STREAMS / "pass.jsonl").read_text().splitlines()]
    said = [line for line in lines if line["kind"] == "snapshot"]
    turning = next(line for line in said if line["label"].startswith("x at 40") and 9 < line["elapsed_s"] < 12)
    snapshot = snapshot_of(turning)
    largest = max(abs(gyro.rate_rps) for gyro in snapshot.gyros)
    assert largest == pytest.approx(math.radians(40), rel=0.1)  # no gyro is quite along x
    assert all(abs(gyro.residual) < 5 for gyro in snapshot.gyros)
    for gyro in turning["gyros"]:
        del gyro["rate_rps"], gyro["residual"]
    old = snapshot_of(turning)
    assert old.gyros[0].values == snapshot.gyros[0].values
    assert math.isnan(old.gyros[0].rate_rps)


def test_what_a_device_appends_gets_a_chart_of_its_own_by_itself(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    column = {"device": "chamber", "column": "temperature_c", "unit": "degC", "value": 26.5}
    lines = [json.loads(line) for line in (STREAMS / "pass.jsonl").read_text().splitlines()]
    for line in lines:
        if line["kind"] == "snapshot":
            line["series"] = [column]
    monkeypatch.setattr("streams._lines", lambda name: lines)

    async def drive(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: any("temperature_c" in title(chart) for chart in charts(app)))
        (chart,) = [chart for chart in charts(app) if "temperature_c" in title(chart)]
        assert title(chart).startswith(" temperature_c (degC) ")
        assert "26.50" in title(chart)
        assert not any(chart.region.overlaps(other.region) for other in charts(app) if other is not chart)

    with Replay("pass", 20.0):
        app = StationApp(CHOICES, attach=True)
        driven(app, drive, (200, 60))


@pytest.mark.full
@pytest.mark.parametrize(("size", "count"), [((80, 24), 1), ((120, 40), 9), ((200, 60), 9)])
def test_charts_fill_the_room_there_is(place: Path, size: tuple[int, int], count: int) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: app.shown and app.shown.snapshot and len(charts(app)) == count)
        regions = [chart.region for chart in charts(app)]
        assert min(region.height for region in regions) >= 7
        assert not any(a.overlaps(b) for at, a in enumerate(regions) for b in regions[at + 1 :])

    with Replay("pass", 20.0):
        app = StationApp(CHOICES, attach=True)
        driven(app, drive, size)


def test_a_chart_is_enlarged_and_scrolled_back_while_the_run_goes_on_with_stop_in_sight(place: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: app.shown and app.shown.snapshot and charts(app) and title(charts(app)[0]) != "None")
        first = title(charts(app)[0])
        await pilot.press("c", "c")
        assert len(charts(app)) == 1
        await until(pilot, lambda: title(charts(app)[0]) not in (first, "None"))
        size, small = charts(app)[0].size, charts(app)[0].region
        await pilot.press("z")
        await until(pilot, lambda: charts(app)[0].region.height > 2 * small.height)
        bar = app.screen.query_one(StopBar).region
        assert bar.area
        assert not bar.overlaps(charts(app)[0].region)
        await pilot.press("plus", "plus", "minus", "left")
        await until(pilot, lambda: "of 0:41" in str(app.screen.query_one("#progress").render()))
        await until(pilot, lambda: "0 shows all" in title(charts(app)[0]))
        await pilot.press("0", "escape")
        await until(pilot, lambda: charts(app)[0].size == size)
        assert "0 shows all" not in title(charts(app)[0])
        await pilot.press("f9")
        await until(pilot, lambda: session.heard)

    with Replay("pass", 20.0) as session:
        app = StationApp(CHOICES, attach=True)
        driven(app, drive)


def test_help_names_all_keys_and_a_theme_is_remembered(place: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        await pilot.press("f1")
        await until(pilot, lambda: app.screen.query("#dialog"))
        said = str(app.screen.query_one("#dialog").children[0].render())
        groups = [line for line in said.splitlines() if line and not line.startswith(" ")]
        assert groups[0].startswith("STOP")
        assert [group.partition(" ")[0].strip(",") for group in groups] == ["STOP", "This", "Charts", "Everywhere"]
        described = {key.description for key in (*HistoryScreen.BINDINGS, *StationApp.BINDINGS) if type(key) is Binding}
        assert all(words in said for words in {*described, "Sort", "Gyro", "Earlier", "Enlarge"})
        assert "cursor" not in said.lower()  # editing keys of textual's fields
        assert app.screen.query_one(StopBar).region.area
        await pilot.press("escape")
        app.theme = "high-contrast"
        await pilot.pause()

    app = HistoryFirst(CHOICES)
    driven(app, drive)
    assert HistoryFirst(CHOICES).theme == "high-contrast"


def test_a_path_is_completed(place: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        field = app.screen.query_one("#script", Input)
        field.focus()
        field.value = "sho"
        await until(pilot, lambda: field._suggestion == "short.toml")
        field.cursor_position = 3
        await pilot.press("right")
        assert field.value == "short.toml"

    app = StationApp(Choices("none.toml", "none.toml"))
    driven(app, drive)


@pytest.mark.full
def test_history_is_sorted_and_filtered_by_any_word_and_gives_out_what_is_asked_for(recordings: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        table = app.screen.query_one(DataTable)
        files = lambda: [str(table.get_row_at(row)[-1]) for row in range(table.row_count)]  # noqa: E731
        await until(pilot, lambda: files() == ["torn.h5", "later.h5", "second.h5", "first.h5"])
        await pilot.press(*["s"] * 6)
        assert files() == ["first.h5", "later.h5", "second.h5", "torn.h5"]
        app.screen.query_one("#device", Input).value = "fail"
        await until(pilot, lambda: files() == ["second.h5"])
        app.screen.query_one("#device", Input).value = "first"
        await until(pilot, lambda: files() == ["first.h5"])
        table.focus()
        await pilot.press("ctrl+p", *keys("as csv"))
        await until(pilot, lambda: "CSV" in str(app.screen.query_one(CommandList).get_option_at_index(0).prompt))
        await pilot.press("enter")
        await until(pilot, lambda: (recordings / "first.csv").exists())

    app = HistoryFirst(Choices(folder=Path("recordings")))
    driven(app, drive, (120, 40))
