"""Tray: serial numbers are scanned into a list, whose devices are then mounted and run one after another."""

from pathlib import Path
from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal
from textual.widgets import DataTable, Input, Label, Static

from station.screen.base import Field, ScanField, StationScreen
from station.screen.figures import templated
from station.screen.memory import whole
from station.screen.sessions.link import sessions_there
from station.screen.sessions.tray import NO_RESULT, RUNNING, SKIPPED, WAITING, Spot
from station.views.figures import OUTCOME_STYLES

_COLUMNS = ("", "serial no.", "script", "state", "recording")
_STYLES = {**OUTCOME_STYLES, RUNNING: "bold", SKIPPED: "dim", NO_RESULT: "red"}


class TrayScreen(StationScreen):
    """What is to be run, what runs, and what became of it."""

    MODE = "tray"
    BINDINGS: ClassVar = [
        Binding("f7", "start", "Next", key_display="F7"),
        ("delete", "remove", "Remove"),
        Binding("minus", "move(-1)", "Up", key_display="-"),
        Binding("plus", "move(1)", "Down", key_display="+"),
        ("s", "skip", "Skip, or again"),
        ("c", "clear", "Clear what is done"),
    ]
    _shown: list[Spot] | None = None

    def body(self) -> ComposeResult:
        with Horizontal(classes="field"):
            yield Label("Scripts")
            yield Field(id="scripts", placeholder="the 360 s script; of several: a.toml, b.toml")
        with Horizontal(classes="field"):
            yield Label("Scan")
            yield ScanField(id="scan", placeholder="serial number of a device, then Enter or Tab")
        yield Static(id="next", markup=False, classes="block")
        yield DataTable(id="spots", cursor_type="row", zebra_stripes=True)

    def on_mount(self) -> None:
        self.set_focus(self.query_one("#scan"))

    def on_screen_resume(self) -> None:
        """Show the tray of the bench that is chosen, as it is now."""
        self.query_one("#scripts", Input).value = self.station.choices.script
        self.station.work(self._look_up, "tray")

    async def _look_up(self) -> None:
        """Find out how runs ended whose end this screen did not see."""
        tray, run = self.station.tray, self.station.shown
        live = {str(hello.get("recording")) for _, hello in await sessions_there()}
        if run is not None and run.active and run.recording is not None:  # it may have no socket yet
            live.add(str(run.recording.resolve()))
        for spot in [spot for spot in tray.spots if spot.state == RUNNING and spot.recording not in live]:
            entry = (await self.station.archive.read(Path(spot.recording))).entry
            tray.end(Path(spot.recording), entry.texts.get("outcome") or NO_RESULT)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Put a device that was scanned onto the tray, once for each script."""
        scan, tray = self.query_one("#scan", Input), self.station.tray
        self.set_focus(scan)
        if event.input is not scan or not event.value:
            return
        for script in self.query_one("#scripts", Input).value.split(","):
            spot = Spot(event.value, whole(script.strip()))
            if any((old.serial, old.script) == (spot.serial, spot.script) for old in tray.spots):
                words = f"{spot.serial} is on the tray with {spot.script_name} already"
                self.notify(words, title="Not added", severity="warning", markup=False)
            else:
                tray.keep([*tray.spots, spot])

    def action_start(self) -> None:
        """Ask for the next device."""
        self.station.next_on_tray()

    def on_data_table_row_selected(self, event: DataTable.RowSelected) -> None:
        for spot in self._chosen():
            if spot.recording:
                self.station.open_recording(Path(spot.recording))

    def _chosen(self) -> list[Spot]:
        row = self.query_one(DataTable).cursor_row
        return self.station.tray.spots[row : row + 1]

    def action_remove(self) -> None:
        chosen = self._chosen()
        self.station.tray.keep([spot for spot in self.station.tray.spots if spot not in chosen])

    def action_clear(self) -> None:
        """Remove what has been run."""
        left = (WAITING, RUNNING, SKIPPED)
        self.station.tray.keep([spot for spot in self.station.tray.spots if spot.state in left])

    def action_move(self, step: int) -> None:
        """Let a spot change places with the one before or after it."""
        spots, row = list(self.station.tray.spots), self.query_one(DataTable).cursor_row
        if row < len(spots) and 0 <= row + step < len(spots):
            spots[row], spots[row + step] = spots[row + step], spots[row]
            self.station.tray.keep(spots)
            self.tick()
            self.query_one(DataTable).move_cursor(row=row + step)

    def action_skip(self) -> None:
        """Skip a spot that waits; let any other wait again. Its last recording stays in the history."""
        for spot in self._chosen():
            self.station.tray.change(spot, state=SKIPPED if spot.state == WAITING else WAITING, recording="")

    def tick(self) -> None:
        tray = self.station.tray
        if not self.query(DataTable) or tray.spots == self._shown:
            return
        self._shown, table = list(tray.spots), self.query_one(DataTable)
        row = table.cursor_row
        table.clear(columns=True)
        table.add_columns(*_COLUMNS)
        for number, spot in enumerate(tray.spots, 1):
            cells = (str(number), spot.serial, spot.script_name, spot.state, Path(spot.recording).name)
            table.add_row(*(Text(cell, _STYLES.get(cell, "")) for cell in cells))
        table.move_cursor(row=min(row, max(len(tray.spots) - 1, 0)))
        self.query_one("#next", Static).update(templated("tray.rich", {"tray": tray}))
