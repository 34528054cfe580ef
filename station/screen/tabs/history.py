"""History: the recordings of a folder, by device and date; how a state of a device went over its calibrations."""

import time
from functools import partial
from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal
from textual.widgets import DataTable, Input, Label, Static

from station.screen.archive.entries import NO_LIMITS, Entry
from station.screen.base import Field, StationScreen
from station.screen.plots import trend_plot
from station.views.figures import OUTCOME_STYLES, STATE_FIGURES, number

_COLUMNS = ("when", "device", "script", "outcome", "operator", "accepted", "file")
_SHOWN_EVERY_S = 0.5
_MOST_ROWS = 500  # of more the table would keep its reader waiting: narrow them
_TREND_ROWS = 9


class HistoryScreen(StationScreen):
    """All recordings, and trends."""

    MODE = "history"
    BINDINGS: ClassVar = [
        Binding("f6", "read_again", "Read folder again", key_display="F6"),
        Binding("slash", "filter", "Filter", key_display="/"),
        ("s", "state(1)", "Next state"),
        ("g", "gyro(1)", "Next gyro"),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._entries: list[Entry] = []
        self._shown: list[Entry] = []
        self._reading = False
        self._state = 0
        self._limits = NO_LIMITS

    def body(self) -> ComposeResult:
        with Horizontal(classes="field"):
            yield Label("Device")
            yield Field(id="device", placeholder="any")
            yield Label("Date")
            yield Field(id="date", placeholder="any; 2026-11, 2026-11-21")
        yield Static(id="folder", markup=False)
        yield DataTable(id="recordings", cursor_type="row", zebra_stripes=True)
        yield Static(id="trend", markup=False, classes="block")

    def on_mount(self) -> None:
        self.query_one(DataTable).add_columns(*_COLUMNS)

    def on_screen_resume(self) -> None:
        """Read what is new; what was read before is known."""
        self.action_read_again()
        self.set_focus(self.query_one(DataTable))

    def action_read_again(self) -> None:
        self.station.work(partial(self._read, self.station.choices.folder), "read")

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

    def action_state(self, step: int) -> None:
        self._state = (self._state + step) % len(STATE_FIGURES)
        self.redraw()

    async def _read(self, folder: Path) -> None:
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
            self._limits = (await self.station.archive.read(newest.path)).sizes
            self.redraw()

    def _show(self) -> None:
        device = self.query_one("#device", Input).value.strip().lower()
        date = self.query_one("#date", Input).value.strip()
        self._shown = [e for e in self._entries if device in e.device.lower() and e.when.startswith(date)]
        table = self.query_one(DataTable)
        row = table.cursor_row
        table.clear()
        for entry in self._shown[:_MOST_ROWS]:
            table.add_row(*_cells(entry))
        if self._shown:
            table.move_cursor(row=min(row, len(self._shown) - 1))
        of = "" if len(self._shown) == len(self._entries) else f" of {len(self._entries)}"
        reading = ", reading ..." if self._reading else ""
        most = f", the first {_MOST_ROWS} here" if len(self._shown) > _MOST_ROWS else ""
        words = f"{len(self._shown)}{of} recordings in {self.station.choices.folder}{most}{reading}   (Enter opens one)"
        self.query_one("#folder", Static).update(words)
        self.redraw()

    def redraw(self) -> None:
        if not self.is_mounted:
            return
        table = self.query_one(DataTable)
        chosen = self._shown[table.cursor_row] if table.cursor_row < len(self._shown) else None
        width = max(self.query_one("#body").size.width - 2, 70)
        lines = self._trend(chosen, width) if chosen is not None else []
        self.query_one("#trend", Static).update(Text("\n").join(lines))

    def _trend(self, chosen: Entry, width: int) -> list[Text]:
        if chosen.wrong:
            return [Text(f"{chosen.path.name}: {chosen.wrong}", "red")]
        if not chosen.gyros:
            return [Text(f"{chosen.path.name} came to no calibration", "dim")]
        gyro = chosen.gyros[self.gyro % len(chosen.gyros)]
        points = []
        for entry in sorted(self._entries, key=lambda entry: entry.when_utc_s):
            if entry.same_device(chosen):
                points += [g for g in entry.gyros if (g.source, g.name) == (gyro.source, gyro.name)]
        unit = STATE_FIGURES[self._state]
        values = [point.values[self._state] * unit.factor for point in points]
        sds = [point.sds[self._state] * unit.factor for point in points]
        limit = self._limits[self._state] * unit.factor
        count = f"{len(points)} calibration{'s' * (len(points) != 1)}"
        title = f"{unit.name} ({unit.unit}) of {gyro.name}, {chosen.device or 'this device'}, {count}"
        label = partial(number, digits=unit.digits)
        return trend_plot(title, values, sds, limit, width, _TREND_ROWS, label)


def _cells(entry: Entry) -> list[Text]:
    outcome = entry.texts.get("outcome", "")
    ended = Text(outcome or "-", OUTCOME_STYLES.get(outcome, ""))
    told = [entry.device, *(entry.texts.get(key, "") for key in ("script", "operator", "accepted_by"))]
    if entry.wrong:
        ended, told = Text("UNREADABLE", "red"), ["-"] * 4
    device, script, operator, accepted = map(Text, told)
    return [Text(entry.when), device, script, ended, operator, accepted, Text(entry.path.name)]
