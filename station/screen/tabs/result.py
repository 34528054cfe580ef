"""Result: the verdict, the states, their change since the last calibration, effects not in the model, advice."""

import asyncio
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import ClassVar

from rich.console import Group, RenderableType
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container, Horizontal, VerticalScroll
from textual.widgets import Button, Static

from station.atomic_write import free_path
from station.render.archive.moved import moved_since
from station.screen.archive.entries import INVESTIGATION, Entry, ReadRecording, last_comparable, moves
from station.screen.base import StationScreen
from station.screen.charts import Charts
from station.screen.dialogs import AskDialog, ChooseDialog
from station.screen.drawings import STATE_CHARTS, Drawing, StateLimit, state_drawing
from station.screen.panes.calibrated import calibrated_text
from station.screen.panes.lines import joined
from station.screen.panes.states import ChangeView, change_text
from station.screen.panes.verdict import VerdictView, record_text, verdict_text
from station.screen.sessions.answers import InvestigationAnswer
from station.screen.sessions.programs import ask, done
from station.screen.tabs.facts import fill_in
from station.views.figures import figures_from
from station.views.history import Move

_MOST_OFFERED = 20
_LOOKING = "looking for errors that the model misses"
_NONE, _ALL = "none", "all"  # choices of runs that judge, besides the number of one
_BLOCKS = ("verdict", "states", "change", "model", "record")
_BUTTONS = (
    ("accept", "Accept  A"),
    ("investigate", "Investigate  I"),
    ("repeat", "Repeat  R"),
    ("next", "Drive next script  D"),
)


class ResultScreen(StationScreen):
    """One recording and its results."""

    MODE = "result"
    BINDINGS: ClassVar = [
        *(Binding(words[-1].lower(), name, words[:-3], show=False) for name, words in _BUTTONS),
        ("g,right", "gyro(1)", "Gyro"),
        Binding("left", "gyro(-1)", "Previous gyro", show=False),
        ("f", "facts", "Facts of the certificate"),
    ]

    def __init__(self) -> None:
        """Start without a recording, and nothing under way."""
        super().__init__()
        self._whole: ReadRecording | None = None
        self._same: list[Entry] = []
        self._moves: list[Move] = []
        self._investigation: InvestigationAnswer | None = None
        self._model: Sequence[RenderableType] = ()
        self._busy = ""
        self._said = ""

    @property
    def recording_line(self) -> str:
        """Warning on a run that ended unexpectedly: whether its table came to rest is unknown. Else empty."""
        entry = self._whole.entry if self._whole is not None else None
        if entry is None or entry.wrong or entry.texts.get("outcome"):
            return ""
        return "this recording has no outcome because its session ended unexpectedly. Check that the table is at rest"

    def body(self) -> ComposeResult:
        with Container(id="columns"):
            with VerticalScroll(id="figures", can_focus=False):
                for name in _BLOCKS:
                    yield Static(id=name, markup=False, classes="block")
            yield Charts(STATE_CHARTS, self._drawing)

    def row_below(self) -> ComposeResult:
        with Horizontal(id="actions", classes="buttons"):
            for name, words in _BUTTONS:
                yield Button(words, id=name, compact=True, disabled=True, action=f"screen.{name}")

    def _open(self, path: Path, fresh: bool) -> None:
        """Forget what is shown, and read and show the recording; one that failed and is ``fresh`` is investigated."""
        self.recording = path
        self.gyro = 0
        self._whole = None
        self._same = []
        self._moves = []
        self._investigation = None
        self._busy = "reading"
        self._said = ""
        self.redraw()
        self.station.work(partial(self._read, path, fresh), "open")

    async def _read(self, path: Path, fresh: bool) -> None:
        """Read and show a recording, then others of the same device around it, and what moved since them.

        For a ``fresh`` one that has a calibration and the outcome FAIL, start an investigation.
        """
        whole = await self.station.archive.read(path)
        self._whole, self._busy = whole, ""
        await self._take_investigation(whole.investigation)
        entry = whole.entry
        if fresh and entry.texts.get("outcome") == "FAIL" and entry.gyros:
            self._look_for_cause([])
        self._same = [e async for e in self.station.archive.entries(path.parent) if entry.same_calibrated(e)]
        self._moves = moves([*self._same, entry]).get(entry.file, [])
        self.redraw()

    async def _take_investigation(self, answer: InvestigationAnswer | None) -> None:
        self._investigation = answer
        self._model = () if answer is None else await asyncio.to_thread(_investigation_shown, answer)
        self.redraw()

    def action_investigate(self) -> None:
        """Look for errors that the model misses; notify why if that is not possible.

        If there are other runs of the device, ask first what should verify them: none, all, or one of at most 20.
        """
        if not self._may("investigate"):
            return
        if not self._same:
            self._look_for_cause([])
            return
        lines = [(_NONE, "this run itself, step by step (cross-validation)")]
        if len(self._same) > 1:
            lines.append((_ALL, f"all {len(self._same)} other runs of this device together"))
        for n, e in enumerate(self._same[:_MOST_OFFERED]):
            words = f"{e.when}  {e.texts.get('outcome', ''):7} {e.texts.get('script', '')}  {e.path.name}"
            lines.append((str(n), words))
        self.app.push_screen(ChooseDialog("Which data should verify a cause?", lines), self._judged_by)

    def _judged_by(self, chosen: str | None) -> None:
        if chosen is not None and not self._obstacle("investigate"):
            runs = {_NONE: [], _ALL: self._same}.get(chosen)
            self._look_for_cause([self._same[int(chosen)]] if runs is None else runs)

    def _look_for_cause(self, judging: Sequence[Entry]) -> None:
        """Investigate in a separate process; ``judging`` are the runs that verify the result."""
        if self.recording is not None:
            self._tell(_LOOKING)
            self.station.work(
                partial(self._investigate, self.recording, [entry.path for entry in judging]), "investigate"
            )

    async def _investigate(self, path: Path, judging: Sequence[Path]) -> None:
        """Run `station investigate` on a recording, verified by ``judging``, and show its result or why there is none.

        Without any ``judging`` the recording is cross-validated. The result is stored beside the recording, as is the
        next script, both under free names. Nothing is shown if another recording is open by then.
        """
        kept = await asyncio.to_thread(free_path, path.with_name(f"{path.stem}{INVESTIGATION}.h5"))
        script = await asyncio.to_thread(free_path, path.with_name(f"{path.stem}-next.toml"))
        verify = ["--verify", *map(str, judging)] if judging else []
        files = ["--output", str(kept), "--next-script", str(script)]
        arguments = ["investigate", str(path), *verify, "--json", *files]
        answer = await ask(arguments, InvestigationAnswer.read, lambda line: self._tell(f"{_LOOKING}: {line}"))
        if path != self.recording:
            return
        self._busy = ""
        self._said = f"no verdict: {answer.reason}" if answer.value is None else ""
        await self._take_investigation(answer.value)

    def _tell(self, busy: str) -> None:
        self._busy = busy
        self.redraw()

    def action_accept(self) -> None:
        """Ask whether to accept the calibration; if so, record who did and write the certificate.

        Notify why instead if it cannot be accepted.
        """
        if not self._may("accept") or self._whole is None:
            return
        operator = self.station.choices.operator
        question = f"Accept the calibration of {self._whole.entry.device or 'this device'} as {operator}?"
        answers = [("no", "Back"), ("yes", "Accept and write the certificate")]
        self.app.push_screen(AskDialog(question, answers), self._accepted)

    def _accepted(self, answer: str | None) -> None:
        if answer == "yes" and self.recording is not None:
            self._tell("writing the certificate")
            self.station.work(partial(self._certify, self.recording), "accept")

    async def _certify(self, path: Path) -> None:
        """Record the acceptance by the operator, write the certificate, and show what succeeded.

        Without a certificate the acceptance stands. Nothing is shown if another recording is open by then.
        """
        now = datetime.now(UTC).isoformat(timespec="seconds")
        wrong = await self.station.archive.accept(
            path, {"accepted_by": self.station.choices.operator, "accepted_utc": now}
        )
        if wrong:
            outcome = f"NOT ACCEPTED: {wrong}"
        else:
            certificate = await asyncio.to_thread(free_path, path.with_suffix(".html"))
            answer = await done(["report", str(path), "--output", str(certificate)])
            outcome = f"accepted; certificate: {certificate}"
            if answer.code:
                outcome = f"accepted, but NO CERTIFICATE: {answer.reason}"
        whole = await self.station.archive.read(path)
        if path == self.recording:
            self._busy, self._said, self._whole = "", outcome, whole
            self.redraw()

    def action_facts(self) -> None:
        """Open the form for the facts that the certificate states beside the measurement."""
        if self._may("facts") and self._whole is not None:
            self.station.work(partial(fill_in, self.app, self._whole), "facts")

    def action_repeat(self) -> None:
        if self._may("repeat"):
            self.station.prepare(None)

    def action_next(self) -> None:
        if self._may("next"):
            self.station.prepare(self._next_script)

    @property
    def _next_script(self) -> str | None:
        """The script that the investigation needs, None if it needs none."""
        return self._investigation.next_script if self._investigation is not None else None

    def _may(self, action: str) -> bool:
        """Return whether an action is possible, and notify why not."""
        obstacle = self._obstacle(action)
        if obstacle:
            self.notify(obstacle, severity="warning", markup=False)
        return not obstacle

    def _obstacle(self, action: str) -> str:
        """Return why ``action`` is not possible, "" if it is.

        Names of actions are "accept", "investigate", "facts", "repeat" and "next". No action is without a recording
        that can be read, or while another one works. Accept needs a PASS or ESTIMATED that is not accepted, and an
        operator; investigate and facts need a calibration. Repeat and next need that no session runs, and next a script
        of the investigation.
        """
        entry = self._whole.entry if self._whole is not None else None
        if entry is None or entry.wrong:
            return "no recording is open"
        if self._busy:
            return f"wait: {self._busy}"
        if action == "accept":
            return self._not_to_accept(entry)
        if action in ("investigate", "facts"):
            return "" if entry.gyros else "there is no calibration in this recording"
        if action == "next" and not self._next_script:
            return "no investigation needs another script (I investigates)"
        return "a session runs: F3 shows it" if self.station.busy else ""

    def _not_to_accept(self, entry: Entry) -> str:
        outcome = entry.texts.get("outcome", "")
        if outcome not in ("PASS", "ESTIMATED"):
            return f"only a PASS can be accepted; this is {outcome or 'without an outcome'}: repeat it, or investigate"
        if entry.texts.get("accepted_by"):
            return f"accepted by {entry.texts['accepted_by']}"
        return "" if self.station.choices.operator else "accepting needs an operator: F2, enter the name"

    def on_screen_resume(self) -> None:
        """Open a recording that a run has left, and update the buttons."""
        to_open = self.station.take_recording()
        if to_open is not None:
            self._open(*to_open)
        self.redraw()

    def redraw(self) -> None:
        """Show the recording in all blocks, and enable the buttons whose action is possible; nothing before the screen
        is built.
        """
        if not self.query(Charts):
            return
        for name, _ in _BUTTONS:
            self.query_one(f"#{name}", Button).disabled = bool(self._obstacle(name))
        whole, charts = self._whole, self.query_one(Charts)
        charts.display = bool(whole and whole.curves)
        self._block("verdict", self._verdict(whole))
        shown = self._blocks(whole) if whole is not None and not whole.entry.wrong else {}
        for name in _BLOCKS[1:]:
            self._block(name, shown.get(name))
        charts.draw()

    def _verdict(self, recording: ReadRecording | None) -> Text:
        """Return the verdict, and what moved since the last comparable run, if anything."""
        view = VerdictView(path=self.recording, whole=recording, busy=self._busy, message=self._said)
        moved = Text.from_markup(moved_since(self._moves), emoji=False)
        return joined(filter(None, (verdict_text(view), moved)))

    def _blocks(self, recording: ReadRecording) -> Mapping[str, RenderableType]:
        """Return the other blocks that a recording has, by their names; without a calibration the record alone."""
        if not recording.entry.gyros:
            return {"record": record_text(recording)}
        model = self._model or [Text("I looks for errors beyond the four states", "dim")]
        return {
            "states": calibrated_text(recording),
            "change": change_text(self._change(recording.entry)),
            "model": Group(Text("Investigation", "bold underline"), *model),
            "record": record_text(recording),
        }

    def _change(self, entry: Entry) -> ChangeView:
        """Return the change of a calibration since the last comparable one; without one it has no values before."""
        last = last_comparable(entry, self._same)
        since = "" if last is None else f"{last.when} ({last.path.name}, {last.texts.get('outcome', '')})"
        return ChangeView(
            figures=figures_from(entry.units),
            gyros=entry.gyros,
            comparable=entry.series is not None,
            failed=entry.failed,
            since=since,
            before=() if last is None else last.gyros,
            moved=frozenset(move.gyro for move in self._moves),
        )

    def _block(self, name: str, shown: RenderableType | None) -> None:
        block = self.query_one(f"#{name}", Static)
        block.display = shown is not None
        block.update("" if shown is None else shown)

    def _drawing(self, name: str) -> Drawing | None:
        """Return the chart of the state ``name`` of the chosen gyro, with the calibration's figure; None without
        curves.

        The curve is that of the live filter; so is the figure if the gyro was not calibrated.
        """
        whole = self._whole
        if whole is None or not whole.curves:
            return None
        index = STATE_CHARTS.index(name)
        gyro, curve = list(whole.curves.items())[self.gyro % len(whole.curves)]
        limit = StateLimit(whole.sizes[index], whole.written[index])
        drawing = state_drawing(index, curve, limit, figures=figures_from(whole.entry.units))
        calibrated = next((found for found in whole.entry.gyros if found.full_name == gyro), None)
        if calibrated is None:
            return drawing
        # The curve is that of the live filter; the figure is that of the calibration, as in the table beside it.
        state, _, *others = drawing.words
        figure = figures_from(whole.entry.units)[index].figure(calibrated.values[index], calibrated.sds[index])
        return drawing._replace(words=[state, (figure, "line"), *others])


def _investigation_shown(answer: InvestigationAnswer) -> list[RenderableType]:
    """Return the lines and tables of `station investigate` from its JSON; a hint if it is damaged or of another
    version.

    Call it in a thread: it loads a library first.
    """
    from station.render.investigation_printed import investigation_shown
    from station.views.investigation import investigation_of

    shown = None
    with suppress(Exception):  # a file made by hand
        shown = investigation_shown(investigation_of(answer.view), "d drives it")
    if shown is None:
        return [Text("damaged, or written by another version of the station: I investigates again", "yellow")]
    return [Text.from_markup(line, emoji=False) if isinstance(line, str) else line for line, _ in shown]
