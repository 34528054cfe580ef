"""The app: four screens, the session that it shows, and STOP, which goes to the socket wherever a key is pressed."""

from __future__ import annotations

import gc
import os
import select
import sys
from collections.abc import Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from textual.app import App, ScreenStackError
from textual.binding import Binding
from textual.css.query import NoMatches
from textual.worker import WorkType

from station.screen.archive import Archive
from station.screen.bars import STOP_KEY, StopBar
from station.screen.base import StationScreen
from station.screen.choices import TWIN_SCALE, Choices
from station.screen.dialogs import AskDialog, ChooseDialog
from station.screen.history import HistoryScreen
from station.screen.link import SessionLink, sessions_on, sessions_there
from station.screen.live_run import LiveRun, Stage
from station.screen.memory import Remembered, load_remembered, save_remembered
from station.screen.prepare import PrepareScreen
from station.screen.programs import SessionProcess
from station.screen.prospects import Prospect
from station.screen.result import ResultScreen
from station.screen.run import RunScreen

_TICK_S = 0.1
_HANGUP_S = 0.5
_SETTLED_S = 2.0


class StationApp(App[None]):
    """The operator's screen."""

    TITLE = "turntable station"
    CSS_PATH = Path(__file__).with_name("station.tcss")
    ENABLE_COMMAND_PALETTE = False
    MODES: ClassVar = {
        "prepare": PrepareScreen,
        "run": RunScreen,
        "result": ResultScreen,
        "history": HistoryScreen,
    }
    DEFAULT_MODE: str = "prepare"  # type: ignore[misc]  # it depends on how the app is begun
    BINDINGS: ClassVar = [
        Binding("f2", "switch_mode('prepare')", "Prepare", show=False),
        Binding("f3", "switch_mode('run')", "Run", show=False),
        Binding("f4", "switch_mode('result')", "Result", show=False),
        Binding("f5", "switch_mode('history')", "History", show=False),
        Binding(f"{STOP_KEY},ctrl+c", "stop", "STOP", show=False, priority=True),
        Binding("ctrl+q", "leave", "Quit", show=False, priority=True),
    ]

    def __init__(self, choices: Choices, *, attach: bool = False) -> None:
        """``attach``: begin with a session that runs."""
        if attach:
            self.DEFAULT_MODE = "run"
        super().__init__()
        self.remembered: Remembered = load_remembered()
        self.choices = replace(
            choices,
            operator=choices.operator or self.remembered.operator,
            bench=choices.bench or self.remembered.bench,
            script=choices.script or self.remembered.script,
        )
        self.archive = Archive()
        self.shown: LiveRun | None = None
        self._link: SessionLink | None = None
        self._begins_attached = attach

    @property
    def busy(self) -> bool:
        """Whether a session runs."""
        return self.shown is not None and self.shown.active

    def on_mount(self) -> None:
        """Begin to tick, and look for sessions."""
        self.set_interval(_TICK_S, self._tick)
        self.set_interval(_HANGUP_S, self._watch_terminal)
        self._work(self._find_sessions, "sessions")

    async def on_unmount(self) -> None:
        """Hang up; a session goes on."""
        if self._link is not None:
            self._link.close()
        await self.archive.close()

    def action_stop(self) -> None:
        """Bring the table to rest, now: nothing is asked and nothing is waited for."""
        if self._link is None or not self.busy:
            return
        if not self._link.stop():
            self.notify("the session cannot be reached: use the emergency stop of the table", severity="error")
        self._show_stop()

    def action_leave(self) -> None:
        """Leave; if a session runs, ask what is to become of it."""
        if not self.busy:
            self.exit()
            return
        answers = [("back", "Back"), ("leave", "Leave it running"), ("stop", "STOP it and leave")]
        question = "A session runs. It goes on without the screen; `station ui --attach` shows it again."
        self.push_screen(AskDialog(question, answers), self._left)

    def _left(self, answer: str | None) -> None:
        if answer == "stop":
            self.action_stop()
        if answer in ("leave", "stop"):
            self.exit()

    def start_run(self, prospect: Prospect) -> None:
        """Start a session with what was chosen on a bench, keep what was entered, and show the session."""
        self._remember(prospect.bench)
        self._work(partial(self._start, prospect), "start")

    async def _start(self, prospect: Prospect) -> None:
        others = await sessions_on(prospect.bench, self.choices.bench)
        if self.busy or others:
            said = f"process {others[0]}" if others else "it is on F3"
            self.notify(f"a session runs on this bench already: {said}", title="Not started", severity="error")
            return
        recording = self.choices.new_recording().absolute()
        scale = self.choices.scale or (TWIN_SCALE if prospect.all_twins else None)
        process = SessionProcess(self.choices.run_arguments(recording, scale), recording)
        self._follow(LiveRun(recording, self.choices.script), process=process)

    def pause_run(self) -> None:
        """Hold the run after the step under way, or let it go on."""
        if self._link is not None and self.busy:
            self._link.pause()

    def note_run(self, text: str | None) -> None:
        """Have a note recorded."""
        if text and self._link is not None:
            self._link.note(text)

    def _remember(self, bench: str) -> None:
        serials = {**self.remembered.serials, bench: self.choices.serial}
        bench, script = (
            str(Path(path).absolute()) if path else "" for path in (self.choices.bench, self.choices.script)
        )
        self.remembered = Remembered(self.choices.operator, bench, script, serials)
        save_remembered(self.remembered)

    def prepare(self, script: str | None) -> None:
        """Show the preparation, with another script if one is given."""
        if script is not None:
            self.choices = replace(self.choices, script=script)
        self.switch_mode("prepare")
        self.call_after_refresh(self._prepare_again)

    def _prepare_again(self) -> None:
        if isinstance(self.screen, PrepareScreen):
            self.screen.prepare(self.choices.script)

    def open_recording(self, path: Path, *, fresh: bool = False) -> None:
        """Show the result of a recording."""
        self.switch_mode("result")
        self.call_after_refresh(self._open, path, fresh)

    def _open(self, path: Path, fresh: bool) -> None:
        if isinstance(self.screen, ResultScreen):
            self.screen.open(path, fresh=fresh)

    async def _find_sessions(self) -> None:
        found = await sessions_there()
        if self._begins_attached and len(found) == 1:
            self._follow(LiveRun(), socket=found[0][0])
        elif self._begins_attached and not found:
            self.notify("no session runs: prepare one", severity="warning")
            self.switch_mode("prepare")
        elif found and not self.busy:
            lines = [
                (str(path), f"{hello['bench']}, process {hello['pid']}, {hello['recording']}") for path, hello in found
            ]
            self.push_screen(
                ChooseDialog("A session runs. Enter shows it, Escape leaves it alone.", lines), self._chosen
            )

    def _chosen(self, socket: str | None) -> None:
        if socket is not None:
            self._follow(LiveRun(), socket=Path(socket))

    async def guarded(self, what: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do something beside the screen; a defect in it must not take STOP away, so it is only told."""
        try:
            await what()
        except Exception as error:
            words = f"{type(error).__name__}: {error}"
            self.notify(words, title="Defect of the screen, please report it", severity="error", markup=False)

    def _work(self, what: Callable[[], Coroutine[Any, Any, None]], group: str) -> None:
        work: WorkType[None] = partial(self.guarded, what)
        self.run_worker(work, group=group, exclusive=True)

    def _follow(self, run: LiveRun, *, process: SessionProcess | None = None, socket: Path | None = None) -> None:
        if self._link is not None:
            self._link.close()
        self.shown = run
        self._link = SessionLink(run, process=process, socket=socket)
        self.switch_mode("run")
        # What is there by now stays: without looking it through again and again nothing holds STOP up for long.
        self.set_timer(_SETTLED_S, gc.freeze)
        self._work(partial(self._link.follow, self._changed), "session")

    def _changed(self) -> None:
        run = self.shown
        self._tick()
        if run is None or run.stage is not Stage.ENDED or run.recording is None:
            return
        if run.outcome in ("PASS", "FAIL") and self.current_mode == "run":
            self.open_recording(run.recording, fresh=True)

    def _tick(self) -> None:
        self._show_stop()
        with suppress(ScreenStackError, NoMatches):  # the screen is on its way in, or the app on its way out
            if isinstance(self.screen, StationScreen):
                self.screen.tick()

    def _show_stop(self) -> None:
        with suppress(ScreenStackError):
            for bar in self.screen.query(StopBar):
                bar.show(self.shown)

    def _watch_terminal(self) -> None:
        """End when nobody is at the other end: a server of the screen that was killed says nothing."""
        if self.is_headless or not _hung_up(sys.__stdin__):
            return
        os._exit(0)


def _hung_up(stream: object) -> bool:
    descriptor = getattr(stream, "fileno", None)
    if descriptor is None:
        return False
    poll = select.poll()
    try:
        poll.register(descriptor(), 0)
    except (OSError, ValueError):
        return True
    return any(happened & (select.POLLHUP | select.POLLERR | select.POLLNVAL) for _, happened in poll.poll(0))
