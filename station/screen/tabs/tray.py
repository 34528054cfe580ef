"""Tray: serial numbers are scanned into a list, whose devices are then mounted and run one after another."""

from pathlib import Path
from typing import ClassVar

from textual import events
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Horizontal
from textual.widgets import Input, Label, OptionList, Static

from station.screen.base import Field, StationScreen
from station.screen.dialogs import AskTextDialog
from station.screen.memory import whole
from station.screen.panes.tray import TrayView, tray_head, tray_lines
from station.screen.sessions.link import sessions_there
from station.screen.sessions.tray import NO_RESULT, RUNNING, SKIPPED, WAITING, TrayItem


class ScanField(Field):
    """A field for a scanner: Enter or Tab submits its text, and it is free for the next at once."""

    def on_key(self, event: events.Key) -> None:
        """Submit the text on Enter or Tab, before the next character is read, and clear the field.

        Nothing is submitted without text; Tab then goes to the next field.
        """
        text = self.value.strip()
        if event.key == "enter" or (event.key == "tab" and text):
            event.stop()
            event.prevent_default()
            if text:
                self.post_message(self.Submitted(self, text))
                self.clear()


class MountDialog(AskTextDialog):
    """Asks to mount a device; only its number confirms it, no other key that a scanner sends."""

    BINDINGS: ClassVar = [Binding("f8", "mounted", "It is mounted", key_display="F8")]

    def answers(self) -> ComposeResult:
        yield ScanField(placeholder=self._begun)

    def action_mounted(self) -> None:
        self.dismiss(self._begun)


class TrayScreen(StationScreen):
    """The devices and scripts to run, the one that runs, and the results."""

    MODE = "tray"
    BINDINGS: ClassVar = [
        Binding("f7", "app.next_on_tray", "Next", key_display="F7"),
        ("delete", "remove", "Remove"),
        Binding("minus", "move(-1)", "Up", key_display="-"),
        Binding("plus", "move(1)", "Down", key_display="+"),
        ("s", "skip", "Skip/again"),
        ("c", "clear", "Clear done"),
    ]
    _shown: list[TrayItem] | None = None

    def body(self) -> ComposeResult:
        """Yield the fields for scripts and scans, the next item, and the list."""
        with Horizontal(classes="field"):
            yield Label("Scripts")
            yield Field(id="scripts", placeholder="the 360 s script; of several: a.toml, b.toml")
        with Horizontal(classes="field"):
            yield Label("Scan")
            yield ScanField(id="scan", placeholder="serial number of a device, then Enter or Tab")
        yield Static(id="next", markup=False)
        yield OptionList(id="spots", compact=True)

    def on_mount(self) -> None:
        self.query_one("#scripts", Input).value = self.station.choices.script
        self.set_focus(self.query_one("#scan"))

    def on_screen_resume(self) -> None:
        self.station.work(self._look_up, "tray")

    async def _look_up(self) -> None:
        """Find out how runs ended whose end no screen saw."""
        live = {hello.recording for _, hello in await sessions_there() if hello is not None}
        for spot in [spot for spot in self.station.tray.spots if spot.state == RUNNING and spot.recording not in live]:
            if not self.station.busy:  # a session that this screen has just started is in no list yet
                entry = (await self.station.archive.read(Path(spot.recording))).entry
                self.station.tray.end(Path(spot.recording), entry.texts.get("outcome") or NO_RESULT)

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Add a scanned device to the tray, once for each script; report items that are there or cannot be stored.

        Scripts are separated by commas; an empty one is the built-in script. Enter in the field for scripts only moves
        the focus to the scan.
        """
        scan, tray = self.query_one("#scan", Input), self.station.tray
        self.set_focus(scan)
        for script in self.query_one("#scripts", Input).value.split(",") if event.input is scan and event.value else ():
            spot = TrayItem(event.value, whole(script.strip()))
            if any((old.serial, old.script) == (spot.serial, spot.script) for old in tray.spots):
                self.notify(
                    f"{spot.serial} is on the tray already", title="Not added", severity="warning", markup=False
                )
            else:
                self._report(tray.keep([*tray.spots, spot]))

    def _report(self, wrong: str) -> bool:
        """Report why the tray could not be stored; return whether it was, which is so if ``wrong`` is empty."""
        if wrong:
            self.notify(wrong, title="NOT kept", severity="error", markup=False)
        return not wrong

    def on_option_list_option_selected(self, event: OptionList.OptionSelected) -> None:
        for spot in self._chosen():
            if spot.recording:
                self.station.open_recording(Path(spot.recording))

    def _chosen(self) -> list[TrayItem]:
        row = self.query_one(OptionList).highlighted
        return [spot for n, spot in enumerate(self.station.tray.spots) if n == row and spot.state != RUNNING]

    def action_remove(self) -> None:
        """Remove the highlighted item, unless it runs."""
        self._report(self.station.tray.keep([spot for spot in self.station.tray.spots if spot not in self._chosen()]))

    def action_clear(self) -> None:
        """Remove the items that have been run."""
        left = (WAITING, RUNNING, SKIPPED)
        self._report(self.station.tray.keep([spot for spot in self.station.tray.spots if spot.state in left]))

    def action_move(self, step: int) -> None:
        """Swap the highlighted item with the one before (``step`` -1) or after it (1), and store the tray.

        Nothing if no item is highlighted, or there is none before or after it.
        """
        spots, row = list(self.station.tray.spots), self.query_one(OptionList).highlighted
        if row is not None and 0 <= row + step < len(spots):
            spots[row], spots[row + step] = spots[row + step], spots[row]
            if self._report(self.station.tray.keep(spots)):
                self.tick()
                self.query_one(OptionList).highlighted = row + step

    def action_skip(self) -> None:
        """Skip a spot that waits; let any other wait again. Its last recording stays in the history."""
        for spot in self._chosen():
            state = SKIPPED if spot.state == WAITING else WAITING
            self._report(self.station.tray.change(spot, state=state, recording=""))

    def tick(self) -> None:
        """Show list and next item anew if the tray has changed; the highlighted row stays, at first it is the top."""
        tray = self.station.tray
        if self.query("#spots") and tray.spots != self._shown:
            view = TrayView(spots=tray.spots, next=tray.next)
            lines = tray_lines(view)
            self._shown = list(tray.spots)
            table = self.query_one(OptionList)
            row = table.highlighted
            table.clear_options().add_options(lines)
            table.highlighted = row if row is not None or not lines else 0
            self.query_one("#next", Static).update(tray_head(view))
