"""The app: its screens, the session that it shows, and STOP, which goes to the socket wherever a key is pressed."""

import asyncio
import gc
import os
import sys
import time
from collections.abc import Callable, Coroutine, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, cast

from textual import events
from textual.app import App, ScreenStackError, SystemCommand
from textual.binding import Binding
from textual.css.query import NoMatches
from textual.driver import Driver
from textual.message import Message
from textual.screen import Screen
from textual.theme import Theme
from textual.worker import WorkType

from drivers.packaged import packaged_toml
from station.screen.archive.archive import Archive
from station.screen.bars import SCREENS, STOP_KEY, Small, StopBar
from station.screen.base import LEAST_HEIGHT, LEAST_WIDTH, StationScreen, hung_up, keys_of
from station.screen.choices import Choices, load_by_processor, twin_scale
from station.screen.dialogs import AskDialog, ChooseDialog, HelpDialog, StationDialog
from station.screen.memory import REMEMBERED, Remembered, load_remembered, save_remembered, whole
from station.screen.panes.tray import mount_question
from station.screen.sessions.link import SessionLink, session_lines, sessions_beside, sessions_on, stop_session
from station.screen.sessions.live_run import LiveRun, Stage
from station.screen.sessions.programs import SessionProcess
from station.screen.sessions.tray import NO_RESULT, RUNNING, WAITING, Tray, TrayItem
from station.screen.tabs.history import HistoryScreen
from station.screen.tabs.manual import begin_manual
from station.screen.tabs.prepare import PrepareScreen
from station.screen.tabs.prospects import Prospect
from station.screen.tabs.recording_actions import offered
from station.screen.tabs.result import ResultScreen
from station.screen.tabs.run import RunScreen
from station.screen.tabs.tray import MountDialog, TrayScreen

_TICK_S = 0.1
_YIELD_S = 0.001  # after which a chart that is being drawn lets the thread go on that has read STOP
_HANGUP_S = 0.5
_OTHERS_S = 2.0
_SETTLED_S = 2.0
_MEANT_S = 3.0  # after STOP for one run the key, which may be held, is for no other
_STOP_KEYS = (STOP_KEY, "ctrl+c")


class _StopFirst(Driver):
    """A driver that sends STOP in the thread that reads keys, as the app may be waiting for a terminal or a disk."""

    def process_message(self, message: Message) -> None:
        if isinstance(message, events.Key) and message.key in _STOP_KEYS:
            cast(StationApp, self._app).stop_from_thread()
        super().process_message(message)


class StationApp(App[None]):
    """The operator's screen."""

    TITLE = "turntable station"
    CSS_PATH = Path(__file__).with_name("station.tcss")
    MODES: ClassVar = {s.MODE: s for s in (PrepareScreen, RunScreen, ResultScreen, HistoryScreen, TrayScreen)}
    DEFAULT_MODE: str = "prepare"  # type: ignore[misc]  # it depends on how the app is begun
    BINDINGS: ClassVar = [
        *(Binding(key.lower(), f"switch_mode('{mode}')", name, show=False) for mode, key, name in SCREENS),
        Binding(",".join(_STOP_KEYS), "stop", "STOP", show=False, priority=True),
        Binding("ctrl+q", "quit", "Quit", show=False, priority=True),
        Binding("f1", "help", "Help", key_display="F1"),
    ]

    def __init__(self, choices: Choices, *, attach: bool = False) -> None:
        """Fill empty ``choices`` from the last entries, and load the theme; ``attach``: begin on the run screen."""
        if attach:
            self.DEFAULT_MODE = "run"
        super().__init__()
        self.remembered: Remembered = load_remembered()
        self.register_theme(Theme(**packaged_toml("station.screen", "themes.toml")))  # in addition to those of textual
        self.theme = self.remembered.theme if self.remembered.theme in self.available_themes else self.theme
        entered = {key: getattr(choices, key) or getattr(self.remembered, key) for key in REMEMBERED}
        self.choices = replace(choices, **entered)
        self.operator_utc_s = time.time() if choices.operator else self.remembered.operator_utc_s
        self.bench_recalled = bool(self.remembered.bench) and not choices.bench
        self.archive = Archive()
        self.shown: LiveRun | None = None
        self.mounted = False
        self.others = 0
        self._link: SessionLink | None = None
        self._begins_attached = attach
        self._told_by_key = False
        self._for_one_s = float("-inf")
        self._leaving = False
        self._to_open: tuple[Path, bool] | None = None

    @property
    def busy(self) -> bool:
        return self.shown is not None and self.shown.active

    @property
    def tray(self) -> Tray:
        """The stored tray of the chosen bench: another screen may have changed it."""
        return Tray(whole(self.choices.bench))

    async def on_event(self, event: events.Event) -> None:
        """Let the preparation see each key first: a scanner types wherever the focus is."""
        if isinstance(event, events.Key) and self._running and isinstance(self.screen, PrepareScreen):
            self.screen.note_key(event)
        await super().on_event(event)

    def get_driver_class(self) -> type[Driver]:
        return type("StopFirstDriver", (_StopFirst, super().get_driver_class()), {})

    def on_mount(self) -> None:
        sys.setswitchinterval(_YIELD_S)
        self.set_timer(_SETTLED_S, gc.enable)  # not while it starts
        self.set_interval(_TICK_S, self._tick)
        self.set_interval(_HANGUP_S, self._watch_terminal)
        self.set_interval(_OTHERS_S, partial(self.work, self._count_others, "others"))
        self.work(self._find_sessions, "sessions")

    async def on_unmount(self) -> None:
        if self._link is not None:
            self._link.close()
        await self.archive.close()

    def action_stop(self) -> None:
        """Bring the table to rest at once, without any question.

        A run about to start, also that of a mounted device, is cancelled, and the operator told. An active session that
        is shown is stopped, or reported as out of reach. Without one, if the bar is about none, all others are stopped.
        """
        sent, self._told_by_key = self._told_by_key, False
        for_one = sent or self._run_on_bar is not None
        mounted, self.mounted = self.mounted, False
        if self.workers.cancel_group(self, "start") or mounted:
            self.notify("the run was not started", title="STOP", severity="warning")
        if self._link is not None and self.busy:
            if not (sent or self._link.stop()):
                self.notify("the session cannot be reached: use the emergency stop of the table", severity="error")
        elif not for_one:
            self.work(self._stop_others, "stop")
        if for_one:
            self._for_one_s = time.monotonic()
        self.show_stop()

    def stop_from_thread(self) -> None:
        """Send STOP to the session that is shown, from the thread that reads keys; ``action_stop`` does the rest."""
        link = self._link
        if link is not None and self.busy:
            self._told_by_key = link.stop()

    async def _stop_others(self) -> None:
        """Stop all sessions not shown, show the newest, and say how many they were; nothing if there are none."""
        sockets = await sessions_beside(self._link)
        if sockets:
            run = LiveRun()
            run.ask_to_stop()
            self._follow(run, socket=sockets[0])  # which sends STOP, and shows how it comes to rest
            await asyncio.gather(*map(stop_session, sockets[1:]))
            self.notify(f"{len(sockets)} told to stop", title="STOP", severity="warning")

    def action_help(self) -> None:
        """Show all keys of the screen, in groups; nothing if a dialog is on top."""
        screen = self.screen
        if not isinstance(screen, StationScreen):
            return
        name = {mode: name for mode, _, name in SCREENS}[screen.MODE]
        everywhere = [binding for binding in keys_of(type(self)) if binding.action != "stop"]
        groups = {
            "STOP, on every screen": [binding for binding in keys_of(type(self)) if binding.action == "stop"],
            f"This screen: {name}": screen.keys(),
            "Charts (Tab or c gives one the focus)": screen.chart_keys(),
            "Everywhere": [*everywhere, Binding("ctrl+p", "command_palette", "Commands, themes")],
        }
        self.push_screen(HelpDialog(groups))

    def get_system_commands(self, screen: Screen[Any]) -> Iterable[SystemCommand]:
        """Yield actions on the recording shown, manual mode, and textual's except "Keys"; on a dialog only the last."""
        if isinstance(screen, StationScreen) and screen.recording is not None:
            yield from offered(self, screen.recording)
        if isinstance(screen, StationScreen):
            yield SystemCommand(
                "Manual mode", "Drive the table by hand, without a script", partial(begin_manual, screen)
            )
        yield from (command for command in super().get_system_commands(screen) if command.title != "Keys")

    async def action_quit(self) -> None:
        """Leave the screen; if a session runs, ask whether to stop it, or to stay. An open dialog is closed instead."""
        if isinstance(self.screen, StationDialog):
            self.screen.dismiss(None)
            return
        if not self.busy:
            self.exit()
            return
        answers = [("back", "Back"), ("leave", "Leave it running"), ("stop", "STOP it and leave")]
        question = "A session is running. It continues without the screen; `station ui --attach` shows it again."
        self.push_screen(AskDialog(question, answers), self._left)

    def _left(self, answer: str | None) -> None:
        if answer == "stop" and self.busy:
            self._leaving = True  # once the table is at rest
            self.action_stop()
        elif answer in ("leave", "stop"):
            self.exit()

    def start_run(self, prospect: Prospect) -> None:
        """Start a session with the chosen bench and script, store the entries, and show the session."""
        self._remember()
        self.work(partial(self._start, prospect), "start")

    async def _start(self, prospect: Prospect) -> None:
        """Start and follow a session for the prepared run, or notify why not.

        That is if the session shown is active, on any bench, another one is on this bench, or it cannot be started.
        Its item on the tray becomes running, or waits again; a manual run has none. Twins are fast without a scale.
        """
        others = await sessions_on(prospect.bench, self.choices.bench)
        if self.busy or others:
            session = f"process {others[0]}" if others else "it is on F3"
            self.notify(f"a session is already running on this bench: {session}", title="Not started", severity="error")
            return
        choices = self.choices.by_hand(prospect.all_twins) if prospect.manual else self.choices
        recording = await asyncio.to_thread(lambda: choices.new_recording().absolute())
        scale = choices.scale or (twin_scale(load_by_processor()) if prospect.all_twins else None)
        if not prospect.manual:
            spot = TrayItem(choices.serial, whole(choices.script))
            self.tray.change(spot, state=RUNNING, recording=str(recording.resolve()))
        try:
            process = SessionProcess(choices.run_arguments(recording, scale))
        except OSError as error:
            self.tray.end(recording, WAITING)
            self.notify(str(error), title="Not started", severity="error", markup=False)
            return
        self._follow(LiveRun(recording, choices.script), process=process)

    def pause_run(self) -> None:
        if self._link is not None and self.busy:
            self._link.pause()

    def drive(self, action: str, **given: str | float) -> None:
        if self._link is not None and self.busy:
            self._link.drive(action, **given)

    def note_run(self, text: str | None) -> None:
        if not text:
            return
        if self.busy and self._link is not None and self._link.note(text):
            self.notify(text, title="Note sent to the recording", markup=False)
        else:
            self.notify(f"no session accepts it: {text}", title="Note NOT kept", severity="error", markup=False)

    def watch_theme(self) -> None:
        if self.is_running and self.theme != self.remembered.theme:
            self.remembered = replace(self.remembered, theme=self.theme)
            save_remembered(self.remembered)

    def _remember(self) -> None:
        bench, script = whole(self.choices.bench), whole(self.choices.script)
        self.remembered = Remembered(self.choices.operator, bench, script, self.operator_utc_s, self.theme)
        save_remembered(self.remembered)

    def prepare(self, script: str | None) -> None:
        """Show the preparation, which takes over the choices again; ``script`` replaces the chosen one unless None."""
        if script is not None:
            self.choices = replace(self.choices, script=script)
        if self.current_mode == "prepare":
            self.screen.post_message(events.ScreenResume())
        else:
            self.switch_mode("prepare")

    def action_next_on_tray(self, scanned: str = "") -> None:
        """Ask that the next device of the tray be mounted, unless a session runs; ``scanned``: another one was."""
        spot = self.tray.next
        if spot is not None and not self.busy:
            dialog = MountDialog(mount_question(spot, scanned), begun=spot.serial)
            self.push_screen(dialog, partial(self._mount, spot))

    def _mount(self, spot: TrayItem, serial: str | None) -> None:
        """Prepare the run of a mounted device, which then starts by itself; None cancels, another number asks again."""
        if serial == spot.serial:
            self.mounted = True
            self.choices = replace(self.choices, serial=serial)
            self.prepare(spot.script)
        elif serial is not None:
            self.action_next_on_tray(serial)

    def open_recording(self, path: Path) -> None:
        self._to_open = path, False
        self.switch_mode("result")

    def choose_session(self) -> None:
        self.work(self._choose, "sessions")

    async def _find_sessions(self) -> None:
        """Offer running sessions, not if the screen is small; with --attach show a single one, or prepare if none."""
        if not self._begins_attached:
            if not self._is_small:
                await self._choose(quiet=True)
            return
        found = await sessions_beside(None)
        if len(found) == 1:
            self._follow(LiveRun(), socket=found[0])
        elif found:
            await self._choose()
        else:
            self.notify("no session is running: prepare one", severity="warning")
            self.switch_mode("prepare")

    async def _choose(self, *, quiet: bool = False) -> None:
        """Count the sessions not shown; offer all, or say there are none. ``quiet``: only offer, if none is active."""
        found = await session_lines()
        self.others = sum(self._link is None or path != self._link.socket for path, _ in found)
        if found and not (quiet and self.busy):
            lines = [(str(path), words) for path, words in found]
            question = "These sessions are running. Enter shows one, Escape closes this list."
            self.push_screen(ChooseDialog(question, lines), self._chosen)
        elif not quiet:
            self.notify("no session runs", severity="warning")

    async def _count_others(self) -> None:
        """Count the sessions that are not shown; a small screen shows the only one, if none was shown so far."""
        sessions = await sessions_beside(self._link)
        self.others = len(sessions)
        if self._is_small and len(sessions) == 1 and self.shown is None:  # a telephone has no key for it
            self._chosen(str(sessions[0]))

    @property
    def _is_small(self) -> bool:
        return self.size.width < LEAST_WIDTH or self.size.height < LEAST_HEIGHT

    def _chosen(self, socket: str | None) -> None:
        if socket is not None:
            self._follow(LiveRun(), socket=Path(socket))

    def work(self, task: Callable[[], Coroutine[Any, Any, None]], group: str) -> None:
        """Run ``task`` in the background, cancelling earlier work of the same group.

        An exception in it is only reported, so that STOP stays available.
        """

        async def guarded() -> None:
            try:
                await task()
            except Exception as error:
                words = f"{type(error).__name__}: {error}"
                self.notify(words, title="Defect of the screen, please report it", severity="error", markup=False)

        worker: WorkType[None] = guarded
        self.run_worker(worker, group=group, exclusive=True)

    def _follow(self, run: LiveRun, *, process: SessionProcess | None = None, socket: Path | None = None) -> None:
        """Show ``run`` on the run screen, and follow it by its process or socket; an earlier link is closed."""
        if self._link is not None:
            self._link.close()
        self.shown = run
        self._link = SessionLink(run, process=process, socket=socket)
        self.switch_mode("run")
        # Present objects stay: without examining them again and again nothing delays STOP for long.
        self.set_timer(_SETTLED_S, gc.freeze)
        self.work(partial(self._link.follow, self._changed), "session")

    def _changed(self) -> None:
        """Update the screen after a new stage of the session, and count the others; once it has ended, the tray, too.

        An item whose session never greeted waits again. PASS, ESTIMATED or FAIL leads from the run screen to the result
        and, without STOP, to the next of the tray. A run without a result is looked up in its recording. The app ends
        if the operator is leaving and the table rests.
        """
        run = self.shown
        self._tick()
        self.work(self._count_others, "others")  # which the session that is shown is not, now that its socket is known
        if run is None or run.stage is not Stage.ENDED:
            return
        if self._leaving and run.at_rest:
            self.exit()
        ended = WAITING if run.hello is None else run.outcome or NO_RESULT
        ran = self.tray.end(run.recording, ended) if run.recording is not None else None
        if run.recording is None or run.hello is None:
            return
        self._to_open = run.recording, True
        if run.result is None:
            self.work(partial(self._look_into, run, run.recording), "ended")
        elif run.outcome in ("PASS", "ESTIMATED", "FAIL") and isinstance(self.screen, RunScreen):
            self.switch_mode("result")
            if ran is not None and not run.stop_asked:
                self.action_next_on_tray()

    async def _look_into(self, run: LiveRun, recording: Path) -> None:
        """Complete the state of a session that ended without a message from its recording."""
        entry = (await self.archive.read(recording)).entry
        self.tray.end(recording, entry.texts.get("outcome") or NO_RESULT)
        reason = entry.wrong or f"{entry.texts.get('outcome', '')}  {entry.texts.get('reason', '')}"
        run.trouble = f"{run.trouble}. Its recording: {reason}"

    def take_recording(self) -> tuple[Path, bool] | None:
        """Return the recording that is to be shown and was not yet, and whether it is of a run that has just ended."""
        found, self._to_open = self._to_open, None
        return found

    def _tick(self) -> None:
        """Update STOP, report refusals in place of other notes, and update the screens, also those below a dialog."""
        self.show_stop()
        while self.shown is not None and self.shown.refusals:
            self.clear_notifications()  # a key that is held is refused again and again
            self.notify(self.shown.refusals.popleft(), title="The session refused", severity="warning", markup=False)
        with suppress(ScreenStackError, NoMatches):  # the screen is on its way in, or the app on its way out
            for screen in self.screen_stack:  # also below a question
                if isinstance(screen, StationScreen):
                    screen.tick()

    @property
    def _below(self) -> StationScreen | None:
        """The screen in sight, also below a dialog; none while it is on its way in."""
        with suppress(ScreenStackError):
            return next((screen for screen in self.screen_stack if isinstance(screen, StationScreen)), None)
        return None

    @property
    def _run_on_bar(self) -> LiveRun | None:
        """The run that the bar is about; without one, or if it is settled and not of the screen in sight, none.

        For a few seconds after a STOP for it, it stays.
        """
        run, below = self.shown, self._below
        if run is None or not run.settled or below is None or below.shows(run.recording):
            return run
        return run if time.monotonic() < self._for_one_s + _MEANT_S else None

    def show_stop(self) -> None:
        """Show the run in bars and small view; without one other sessions, or the line of the screen."""
        with suppress(ScreenStackError):
            run, below = self._run_on_bar, self._below
            line = below.recording_line if below is not None and run is None else ""
            for bar in (bar for screen in self.screen_stack for bar in screen.query(StopBar)):
                bar.show(run, self.others, line)
            if below is not None and below.small:
                for small in below.query(Small):  # none before it is laid out
                    small.show_run(run, self.others, line)

    def _watch_terminal(self) -> None:
        """End the process if the terminal is gone: a killed server of the screen sends no message."""
        if self.is_headless or not hung_up(sys.__stdin__):
            return
        os._exit(0)
