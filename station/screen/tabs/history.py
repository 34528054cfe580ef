"""History: the recordings of a folder, by device and date; how a state of a device went over its calibrations."""

import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal
from textual.widgets import DataTable, Input, Label, Static

from station.screen.archive.entries import Entry
from station.screen.base import Field, StationScreen
from station.screen.charts import Charts
from station.screen.drawings import STATE_CHARTS, Drawing, StateLimit, state_drawing
from station.screen.panes.history import FolderView, TrendView, folder_text, trend_text
from station.screen.sessions.live_run import Trend
from station.views.figures import OUTCOME_STYLES, figures_from

_COLUMNS = ("when", "device", "script", "outcome", "operator", "accepted", "file")
_SHOWN_EVERY_S = 0.5
_MOST_ROWS = 500  # of more the table would keep its reader waiting: narrow them
_DAY_S = 86400.0


class HistoryScreen(StationScreen):
    """All recordings of the folder, and trends."""

    MODE = "history"
    BINDINGS: ClassVar = [
        Binding("f6", "read_again", "Reread", key_display="F6"),
        Binding("slash", "filter", "Filter", key_display="/"),
        ("s", "sort", "Sort"),
        ("g", "gyro(1)", "Gyro"),
    ]

    def __init__(self) -> None:
        """Start without entries, in order of time."""
        super().__init__()
        self._entries: list[Entry] = []
        self._shown: list[Entry] = []
        self._reading = False
        self._sorted = 0
        self._limits = [StateLimit()] * len(STATE_CHARTS)
        self._units: Mapping[str, str] = {}
        self._trend = Trend()
        self._began_utc_s = 0.0  # the first calibration of the trend

    def body(self) -> ComposeResult:
        """Yield the filter, the table of recordings, and the charts."""
        with Horizontal(classes="field"):
            yield Label("Filter")
            yield Field(id="device", placeholder="words of any column: SN-0042 2026-11 FAIL")
        yield Static(id="folder", markup=False)
        yield DataTable(id="recordings", cursor_type="row", zebra_stripes=True)
        yield Static(id="trend", markup=False)
        yield Charts(STATE_CHARTS, self._drawing)

    def on_screen_resume(self) -> None:
        """Read new recordings; those read before are kept."""
        self.action_read_again()
        self.set_focus(self.query_one(DataTable))

    def action_read_again(self) -> None:
        self.station.work(partial(self._read, self.station.choices.folder), "read")

    def _columns(self) -> tuple[str, ...]:
        """Return the columns that there is room for: the file is named below, too."""
        return _COLUMNS if self.has_class("-wide") else _COLUMNS[:-1]

    def action_filter(self) -> None:
        self.set_focus(self.query_one("#device", Input))

    def on_input_changed(self, event: Input.Changed) -> None:
        self._show()

    def on_input_submitted(self, event: Input.Submitted) -> None:
        self.set_focus(self.query_one(DataTable))

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        if event.cursor_row < len(self._shown):
            self.station.open_recording(self._shown[event.cursor_row].path)

    def on_data_table_row_highlighted(self, event: DataTable.RowHighlighted) -> None:
        self.redraw()

    def action_sort(self) -> None:
        """Sort by the next column; at first by date, the newest first."""
        self._sorted = (self._sorted + 1) % len(_COLUMNS)
        self._show()

    def on_data_table_header_selected(self, event: DataTable.HeaderSelected) -> None:
        """Sort by the column whose heading was pressed."""
        self._sorted = event.column_index
        self._show()

    async def _read(self, folder: Path) -> None:
        """Read the entries of a folder, newest first, showing them from time to time; without the recording under way.

        Limits and units become those of the newest calibration.
        """
        self._entries, self._reading, shown_s = [], True, time.monotonic()
        running = self.station.shown
        written = running.recording if running is not None and running.active else None
        async for entry in self.station.archive.entries(folder):
            if written is not None and entry.path.absolute() == written.absolute():
                continue
            self._entries.append(entry)
            if time.monotonic() - shown_s > _SHOWN_EVERY_S:
                self._show()
                shown_s = time.monotonic()
        self._entries.sort(key=lambda entry: entry.when_utc_s, reverse=True)
        self._reading = False
        newest = next((entry for entry in self._entries if entry.gyros), None)
        self._show()
        if newest is not None:
            whole = await self.station.archive.read(newest.path)
            self._limits = list(map(StateLimit, whole.sizes, whole.written))
            self._units = newest.units
            self.redraw()

    def _show(self) -> None:
        """Fill the table with the entries that contain all words of the filter in any column, and redraw the trend.

        They are in order of the chosen column, newest first if that is the date. At most ``_MOST_ROWS`` are in the
        table; the line above says how many match. The cursor stays in its row.
        """
        words = self.query_one("#device", Input).value.lower().split()
        rows = [(entry, _cells(entry)) for entry in self._entries]
        rows = [row for row in rows if all(word in " ".join(map(str, row[1])).lower() for word in words)]
        if self._sorted:
            rows.sort(key=lambda row: str(row[1][self._sorted]))
        self._shown = [entry for entry, _ in rows]
        table = self.query_one(DataTable)
        row = table.cursor_row
        table.clear(columns=True)
        names = self._columns()
        table.add_columns(*(f"{name} ↑" if at and at == self._sorted else name for at, name in enumerate(names)))
        for _, cells in rows[:_MOST_ROWS]:
            table.add_row(*cells[: len(names)])
        if self._shown:
            table.move_cursor(row=min(row, len(self._shown) - 1))
        folder = FolderView(
            folder=self.station.choices.folder,
            count=len(self._entries),
            matching=len(self._shown),
            most=_MOST_ROWS,
            reading=self._reading,
        )
        self.query_one("#folder", Static).update(folder_text(folder))
        self.redraw()

    def redraw(self) -> None:
        """Choose the recording under the cursor, and show the trend of its device for the chosen gyro.

        ``recording`` becomes its path, None without one. Charts are hidden without a calibration. The table is filled
        again if the width has changed its columns. Nothing is done before the screen is built.
        """
        if not self.query(Charts):
            return
        table, self._trend, failed = self.query_one(DataTable), Trend(), 0
        if len(table.columns) not in (0, len(self._columns())):
            self._show()
        chosen = self._shown[table.cursor_row] if table.cursor_row < len(self._shown) else None
        self.recording = chosen.path if chosen is not None else None
        gyro = chosen.gyros[self.gyro % len(chosen.gyros)] if chosen is not None and chosen.gyros else None
        if chosen is not None and gyro is not None:
            alike = sorted(filter(chosen.same_device, self._entries), key=lambda entry: entry.when_utc_s)
            self._began_utc_s = alike[0].when_utc_s
            for entry, own in (
                (e, g) for e in alike for g in e.gyros if (g.source, g.name) == (gyro.source, gyro.name)
            ):
                self._trend.add((entry.when_utc_s - alike[0].when_utc_s) / _DAY_S, own.values, own.sds)
            failed = sum(bool(e.gyros) and e.texts.get("outcome") == "FAIL" for e in alike)
        name = gyro.name if gyro is not None else ""
        trend = TrendView(chosen=chosen, gyro=name, count=len(self._trend.values), failed=failed)
        self.query_one("#trend", Static).update(trend_text(trend))
        charts = self.query_one(Charts)
        charts.display = bool(self._trend.values)
        charts.draw()

    def _drawing(self, name: str) -> Drawing | None:
        index = STATE_CHARTS.index(name)
        if not self._trend.values:
            return None
        figures = figures_from(self._units)
        return state_drawing(index, self._trend, self._limits[index], "days", figures, self._began_utc_s)


def _cells(entry: Entry) -> list[Text]:
    """Return the cells of an entry: date, device, script, outcome, operator, who accepted it, and file.

    An unreadable one has UNREADABLE as outcome and dashes, except for date and file.
    """
    outcome = entry.texts.get("outcome", "")
    ended = Text(outcome or "-", OUTCOME_STYLES.get(outcome, ""))
    cells = [entry.device, *(entry.texts.get(key, "") for key in ("script", "operator", "accepted_by"))]
    if entry.wrong:
        ended, cells = Text("UNREADABLE", "red"), ["-"] * 4
    device, script, operator, accepted = map(Text, cells)
    return [Text(entry.when), device, script, ended, operator, accepted, Text(entry.path.name)]
