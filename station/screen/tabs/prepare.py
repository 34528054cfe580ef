"""Prepare: bench and its devices, script and its plan, operator and device; START once everything is green."""

import asyncio
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from rich.text import Text
from textual import events
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container, Horizontal, Vertical
from textual.suggester import SuggestFromList
from textual.widgets import Button, Input, Label, Static

from station.screen.base import Field, StationScreen
from station.screen.charts import Charts
from station.screen.choices import Choices
from station.screen.dialogs import AskTextDialog
from station.screen.drawings import Drawing, motion_drawing
from station.screen.panes.devices import DevicesView, devices_text
from station.screen.panes.lines import Mark
from station.screen.panes.start import (
    Obstacle,
    ScriptView,
    StartView,
    limits_text,
    ready_text,
    script_text,
    summary_text,
)
from station.screen.sessions.answers import Reply
from station.screen.sessions.link import sessions_on
from station.screen.sessions.live_run import LiveRun
from station.screen.sessions.programs import ask
from station.screen.tabs.prospects import Prospect, look_ahead, matches
from station.views.answers.check import BenchCheck, bench_check_of
from station.views.answers.plan import PlanView, plan_view_of
from station.views.figures import STATE_FIGURES, state_figures

_FIELDS = (
    ("bench", "Bench file", "built-in twins"),
    ("script", "Script file", "the 360 s script"),
    ("operator", "Operator", "your name"),
    ("serial", "Device serial no.", "of the device under test"),
)
_SCAN_GAP_S = 0.03
"""Longest time between two characters of a scanner; nobody types a whole word at that pace."""
_SCAN_LEAST = 4
"""Characters of the shortest scan."""


class PrepareScreen(StationScreen):
    """Everything that must be entered and checked before a run."""

    MODE = "prepare"
    BINDINGS: ClassVar = [
        Binding("f6", "look_again", "Check again", key_display="F6"),
        Binding("f7", "start", "START", key_display="F7"),
        Binding("f8", "confirm_serial", show=False),
        # Before the field gets them, so that text typed or scanned right after them goes to the next field.
        Binding("enter", "enter", priority=True, show=False),
        Binding("tab", "app.focus_next", priority=True, show=False),
        Binding("shift+tab", "app.focus_previous", priority=True, show=False),
    ]

    def __init__(self) -> None:
        """Start with nothing read, checked or planned."""
        super().__init__()
        self._prospect: Prospect | None = None
        self._check: Reply[BenchCheck] | None = None
        self._plan: Reply[PlanView] | None = None
        self._checking = ""
        self._looked_for: tuple[str, str] | None = None
        self._confirmed = ("", "", "")  # number as entered, number reported by the device, reason why both are right
        self._run_before: LiveRun | None = None
        self._chosen: Choices | None = None  # choices shown in the fields
        self._burst = ""  # text typed in one burst so far
        self._burst_at_s = 0.0
        self._burst_pattern = ""  # of serial numbers, by then
        self._before_burst: tuple[Input | None, str] = None, ""  # the field that got it, and its text before

    def body(self) -> ComposeResult:
        """Yield the entries, the blocks of answers, and the chart of the motion."""
        with Container(id="columns"):
            with Vertical(id="entries"):
                for name, words, placeholder in _FIELDS:
                    with Horizontal(classes="field"):
                        yield Label(words)
                        yield Field(id=name, placeholder=placeholder, select_on_focus=name == "serial")
                yield Static(id="ready", markup=False, classes="block")
                yield Static(id="limits", markup=False, classes="block")
            with Vertical(id="answers"):
                yield Static(id="check", markup=False, classes="block")
                yield Static(id="plan", markup=False, classes="block")
        yield Charts(("motion",), self._drawing)

    def row_below(self) -> ComposeResult:
        with Horizontal(id="start-row"):
            yield Button("START  F7", id="start", compact=True, disabled=True, action="screen.start")
            yield Static(id="summary", markup=False)

    def on_mount(self) -> None:
        """Fill in the choices."""
        self._chosen = choices = self.station.choices
        with self.prevent(Input.Changed):
            for name, *_ in _FIELDS:
                self.query_one(f"#{name}", Input).value = getattr(choices, name)
        self.set_focus(self.query_one("#operator" if not choices.operator else "#serial", Input))

    def on_input_changed(self, event: Input.Changed) -> None:
        """Take over the text; bench and script are read only on Enter, and until then there is no prospect of changed
        ones.

        A mounted device is mounted no longer. A changed operator counts as confirmed now.
        """
        self.station.mounted = False
        if event.input.id == "operator":
            self.station.operator_utc_s = time.time()
        self._take_over()
        if self._looked_for != self._files():  # otherwise this shows the result of an earlier check
            self._prospect = None
        self.redraw()

    def action_enter(self) -> None:
        """Go to the next field or press the focused button; a scanned serial number is put into its field instead.

        In a field with an operator this confirms who it is.
        """
        at = self.focused
        if self._take_scan():
            return
        if isinstance(at, Button):
            at.press()
        elif isinstance(at, Input):
            if at.id == "operator" and at.value:
                self.station.operator_utc_s = time.time()
            self.focus_next()
            self.redraw()

    def note_key(self, event: events.Key) -> None:
        """Collect characters that come as fast as a scanner's, wherever the focus is, until Enter or Tab is pressed.

        Called before any other handling of the key. A pause or another key begins anew. With the first character the
        focused field, its text before, and the pattern of serial numbers are noted for ``_take_scan``.
        """
        gap_s = event.time - self._burst_at_s
        self._burst_at_s = event.time
        if gap_s > _SCAN_GAP_S:
            self._burst = ""
        if not event.is_printable or event.character is None:
            if event.key not in ("enter", "tab"):
                self._burst = ""
            return
        if not self._burst:
            field = self.focused if isinstance(self.focused, Input) else None
            self._before_burst = field, field.value if field is not None else ""
            self._burst_pattern = self._prospect.serial_pattern if self._prospect is not None else ""
        self._burst += event.character

    def _take_scan(self) -> bool:
        """Move a serial number that was scanned into another field to its own; return whether there was one.

        A scan is a burst of ``_SCAN_LEAST`` characters or more that look like a serial number. Once the field has seen
        the last of them it gets its text back. The burst is forgotten in any case.
        """
        text, self._burst = self._burst.strip(), ""
        field, before = self._before_burst
        serial = self.query_one("#serial", Input)
        if len(text) < _SCAN_LEAST or field is serial or not self._is_serial(text, field, before):
            return False

        def put() -> None:
            """Restore the field that was scanned into, put the number into the serial field, and select it.

            An enlarged chart goes back.
            """
            if field is not None:
                field.value = before
            if self.maximized is not None:  # the scan held the key that enlarges a chart
                self.minimize()
            serial.value = text
            self.set_focus(serial)
            serial.select_all()  # the next scan takes its place
            self.redraw()

        (field or self).call_later(put)  # once the field has seen the last of the characters
        return True

    def _is_serial(self, text: str, field: Input | None, before: str) -> bool:
        """Return whether a text typed at once, into ``field`` or none, can be a serial number.

        It must match the pattern, if one is known. In an operator field that was empty ``before`` it is a badge and no
        number; in other fields it must be neither a file nor look like one.
        """
        pattern = self._burst_pattern
        if pattern and not matches(pattern, text):
            return False
        if field is not None and field.id == "operator":
            return bool(before)  # into the empty field: a badge
        if field is not None:
            return not text.endswith(".toml") and "/" not in text and not Path(text).exists()
        return True

    def on_input_blurred(self, event: Input.Blurred) -> None:
        """Check bench and script when their fields lose the focus."""
        if event.input.id in ("bench", "script") and self._prospect is None:
            self.action_look_again()

    def on_screen_resume(self) -> None:
        """Read bench and script after the first picture; again if a session has ended.

        If others were chosen they are filled in first.
        """
        ended = self.station.shown is not self._run_before and not self.station.busy
        if self.station.choices is not self._chosen:
            self.on_mount()
            self._look_at_both()
        elif self._prospect is None or ended:
            self.call_after_refresh(self._look_at_both)
        self.redraw()

    def on_screen_suspend(self) -> None:
        """Cancel an automatic start when the screen is left."""
        self.station.mounted = False

    def action_look_again(self) -> None:
        """Open the bench that is named, whichever that is."""
        self.station.bench_recalled = self.station.mounted = False
        self._look_at_both()

    def _look_at_both(self) -> None:
        """Read bench and script, check the devices, and plan, in the background; earlier answers are dropped."""
        self._take_over()
        self._looked_for = self._files()
        self._prospect = self._check = self._plan = None
        self._checking = ""
        self._run_before = self.station.shown
        self.redraw()
        self.station.work(partial(self._look, self.station.choices), "look")

    def action_start(self) -> None:
        """Start the run, or report what prevents it; nothing if the screen is too small for its texts."""
        if self.small:  # no start by something that cannot be seen
            return
        self._take_over()
        obstacles = self._obstacles()
        if obstacles or self._prospect is None:
            self.notify(
                "; ".join(each.text for each in obstacles), title="Not started", severity="warning", markup=False
            )
            self.redraw()
        else:
            self.station.start_run(self._prospect)

    async def _look(self, choices: Choices) -> None:
        """Read bench and script, then check the devices and plan at the same time; stops if the bench is invalid.

        The fields of both suggest the files found.
        """
        found = await asyncio.to_thread(look_ahead, choices)
        self._prospect = found
        for field in ("#bench", "#script"):
            self.query_one(field, Input).suggester = SuggestFromList(found.files)
        self.redraw()
        if found.bench_wrong:
            return
        await asyncio.gather(self._look_at_devices(choices, found), self._look_at_plan(choices, found))

    async def _look_at_devices(self, choices: Choices, prospect: Prospect) -> None:
        """Run `station check` and suggest the serial number that it reports.

        Only why not is shown if a session uses the bench, or it is hardware that is only remembered from the last run.
        """
        if self.station.bench_recalled and not prospect.all_twins:
            self._checking = f"bench {prospect.bench} was used in the last run and is real hardware: F6 opens it"
            self.redraw()
            return
        others = await sessions_on(prospect.bench, choices.bench)
        if others or self.station.busy:  # a port that two programs read loses samples of both
            self._checking = "a session is running on this bench, so its devices are not checked (F6 checks again)"
            self.redraw()
            return
        self._checking = ""
        self._check = await ask(choices.check_arguments(prospect.all_twins), bench_check_of, self._tell)
        self._suggest()
        self.redraw()

    async def _look_at_plan(self, choices: Choices, prospect: Prospect) -> None:
        if not prospect.script_wrong:
            self._plan = await ask(choices.plan_arguments(), plan_view_of)
            self.redraw()

    def _tell(self, line: str) -> None:
        self._checking = line
        self.redraw()

    def _reported_serial(self) -> str:
        """Return the serial number reported by the only device under test; empty for several devices or none."""
        if self._check is None or self._check.value is None:
            return ""
        under_test = self._check.value.devices[1:]
        return under_test[0].identity.serial if len(under_test) == 1 else ""

    def _suggest(self) -> None:
        """Fill in the serial number reported by the only device under test, if none was entered and it matches."""
        field, reported = self.query_one("#serial", Input), self._reported_serial()
        if reported and not field.value and self._prospect and matches(self._prospect.serial_pattern, reported):
            field.value = reported
            field.select_all()  # the next scan, at any time, replaces it

    def action_confirm_serial(self) -> None:
        """Ask why a device that reports another number is the right one; the reason is recorded.

        Nothing unless a number was entered, one is reported, and they differ.
        """
        entered, device = self.station.choices.serial, self._reported_serial()
        if device and entered and entered != device:
            both = f"The device reports {device}, but you entered {entered}"
            question = f"{both}. Why are both right? (Also for the certificate.)"

            def keep(reason: str | None) -> None:
                self._confirmed = entered, device, reason or ""
                self._take_over()
                self.redraw()

            self.app.push_screen(AskTextDialog(question), keep)

    def _files(self) -> tuple[str, str]:
        return self.station.choices.bench, self.station.choices.script

    def _take_over(self) -> None:
        """Take the entries of the fields as choices."""
        entered: dict[str, Any] = {name: self.query_one(f"#{name}", Input).value.strip() for name, *_ in _FIELDS}
        if self._reported_serial():
            both = entered["serial"], self._reported_serial()
            entered["serial_reason"] = self._confirmed[2] if self._confirmed[:2] == both else ""
        self._chosen = self.station.choices = replace(self.station.choices, **entered)

    def _obstacles(self) -> list[Obstacle]:
        """Return what prevents a start: a running session, the entries, bench, script, folder, devices and plan.

        Devices and plan are left out if the bench is wrong, devices also during a session, the plan also if the script
        is wrong. Before bench and script are read there is only that they are, after session and entries.
        """
        prospect = self._prospect
        found = [_wait("a session is running: F3 shows it")] if self.station.busy else []
        found += self._entry_obstacles()
        if prospect is None:
            return [*found, _wait("bench and script are being read (Enter)")]
        found += [_wrong(text) for text in (prospect.bench_wrong, prospect.script_wrong, prospect.folder_wrong) if text]
        if not prospect.bench_wrong and not self.station.busy:
            found += self._device_obstacles()
        if not prospect.bench_wrong and not prospect.script_wrong:
            if self._plan is None:
                found.append(_wait("the plan is being computed"))
            elif self._plan.value is None:
                found.append(_wrong(f"plan: {self._plan.reason}"))
        return found

    def _entry_obstacles(self) -> list[Obstacle]:
        """Return what is wrong with operator and serial number: empty, not of the bench's pattern, or not confirmed.

        An operator has to confirm after a shift; a serial number needs a reason if the device reports another.
        """
        found: list[Obstacle] = []
        prospect = self._prospect
        choices = self.station.choices
        for name, text, pattern in (
            ("operator", choices.operator, prospect and prospect.operator_pattern),
            ("device serial number", choices.serial, prospect and prospect.serial_pattern),
        ):
            if not text:
                found.append(_wrong(f"{name}: enter it"))
            elif pattern and not matches(pattern, text):
                found.append(_wrong(f"{name} {text!r} does not match the pattern of the bench file: {pattern}"))
        age_s = time.time() - self.station.operator_utc_s
        if prospect is not None and choices.operator and age_s > prospect.shift_s:
            found.append(_wrong(f"is the operator still {choices.operator}? Press Enter in the field to confirm"))
        reported = self._reported_serial()
        if reported and choices.serial and choices.serial != reported and not choices.serial_reason:
            found.append(_wrong(f"the device reports serial no. {reported}: correct it, or confirm with a reason (F8)"))
        return found

    def _device_obstacles(self) -> list[Obstacle]:
        if self._check is None:
            return [_wait(self._checking or "the devices are being checked")]
        if self._check.value is None:
            return [_wrong(f"check: {self._check.reason}")]
        return [_wrong(f"{each.device}: {wrong}") for each in self._check.value.devices for wrong in each.wrong]

    def redraw(self) -> None:
        """Show all answers; nothing before the screen is built.

        A mounted device's run is started if nothing prevents it; if something is wrong, that is reported. In both cases
        the device counts as mounted no longer.
        """
        if not self.query(Charts):
            return
        obstacles = self._obstacles()
        self.query_one("#start", Button).disabled = bool(obstacles)
        for name, text in self._blocks(obstacles).items():
            self.query_one(f"#{name}", Static).update(text)
        self.query_one(Charts).draw()
        looked_at = self.station.mounted and self.station.choices is self._chosen
        if looked_at and (not obstacles or any(each.mark is Mark.WRONG for each in obstacles)):
            self.station.mounted = False
            self.action_start()  # or reports its obstacles

    def _blocks(self, obstacles: Sequence[Obstacle]) -> Mapping[str, Text]:
        """Return the texts of all blocks, by their names: summary, ready, limits, check and plan."""
        prospect = self._prospect or Prospect()
        figures = STATE_FIGURES if prospect.limits is None else state_figures(prospect.limits.units)
        plan = self._plan.value if self._plan is not None else None
        missed = plan.missed if plan is not None else ()
        start = StartView(obstacles=obstacles, missed=missed, mounted=self.station.mounted)
        devices = DevicesView(bench=prospect.bench, check=self._check, checking=self._checking)
        return {
            "summary": summary_text(start),
            "ready": ready_text(start),
            "limits": limits_text(prospect.limits),
            "check": devices_text(devices),
            "plan": script_text(ScriptView(prospect=prospect, plan=self._plan, figures=figures)),
        }

    def _drawing(self, name: str) -> Drawing | None:
        motion = self._prospect.motion if self._prospect is not None else None
        return None if motion is None else motion_drawing(motion.gimbals, motion.t_s, motion.rate_rps)


def _wrong(text: str) -> Obstacle:
    return Obstacle(mark=Mark.WRONG, text=text)


def _wait(text: str) -> Obstacle:
    return Obstacle(mark=Mark.WAIT, text=text)
