"""Result: the verdict, the states, their change since the last calibration, effects not in the model, advice."""

import asyncio
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from rich.console import Group, RenderableType
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding
from textual.containers import Container, Horizontal, VerticalScroll
from textual.widgets import Button, Static

from station.atomic_write import free_path
from station.render.archive.moved import moved_since
from station.screen.archive.entries import INVESTIGATION, Entry, Whole, last_comparable, moves
from station.screen.base import StationScreen
from station.screen.charts import Charts
from station.screen.dialogs import AskDialog, ChooseDialog
from station.screen.drawings import STATE_CHARTS, Drawing, StateLimit, state_drawing
from station.screen.figures import templated
from station.screen.sessions.programs import ask
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
        """Start without a recording."""
        super().__init__()
        self._whole: Whole | None = None
        self._same: list[Entry] = []
        self._moves: list[Move] = []
        self._found: Mapping[str, Any] = {}
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
        """Show a recording; a ``fresh`` one that failed is investigated at once."""
        self.recording, self._whole, self._same, self._moves, self._found = path, None, [], [], {}
        self._busy, self._said, self.gyro = "reading", "", 0
        self.redraw()
        self.station.work(partial(self._read, path, fresh), "open")

    async def _read(self, path: Path, fresh: bool) -> None:
        """Read a recording and others of the same device; for a ``fresh`` one that failed, start an investigation."""
        whole = await self.station.archive.read(path)
        self._whole, self._busy = whole, ""
        await self._take_investigation(whole.investigation)
        entry = whole.entry
        if fresh and entry.texts.get("outcome") == "FAIL" and entry.gyros:
            self._look_for_cause([])
        self._same = [e async for e in self.station.archive.entries(path.parent) if entry.same_calibrated(e)]
        self._moves = moves([*self._same, entry]).get(entry.file, [])
        self.redraw()

    async def _take_investigation(self, found: Mapping[str, Any]) -> None:
        self._found = found
        self._model = await asyncio.to_thread(_investigation, found) if found.get("verdict") else ()
        self.redraw()

    def action_investigate(self) -> None:
        """Look for errors that the model misses, after asking which runs should verify them if there are others of the
        device.
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
        """Run `station investigate` on a recording, verified by ``judging``, and show its result if it is still on the
        screen.
        """
        kept = await asyncio.to_thread(free_path, path.with_name(f"{path.stem}{INVESTIGATION}.h5"))
        script = await asyncio.to_thread(free_path, path.with_name(f"{path.stem}-next.toml"))
        verify = ["--verify", *map(str, judging)] if judging else []
        files = ["--output", str(kept), "--next-script", str(script)]
        arguments = ["investigate", str(path), *verify, "--json", *files]
        answer = await ask(arguments, lambda line: self._tell(f"{_LOOKING}: {line}"))
        if path != self.recording:
            return
        self._busy = ""
        self._said = "" if answer.found.get("verdict") else f"no verdict: {answer.reason}"
        await self._take_investigation(answer.found)

    def _tell(self, busy: str) -> None:
        self._busy = busy
        self.redraw()

    def action_accept(self) -> None:
        """Ask whether to accept the calibration; if so, record who did and write the certificate."""
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
        """Record the acceptance, write the certificate, and show what succeeded."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        wrong = await self.station.archive.accept(
            path, {"accepted_by": self.station.choices.operator, "accepted_utc": now}
        )
        if wrong:
            outcome = f"NOT ACCEPTED: {wrong}"
        else:
            certificate = await asyncio.to_thread(free_path, path.with_suffix(".html"))
            answer = await ask(["report", str(path), "--output", str(certificate)])
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
            self.station.prepare(str(self._found["next_script"]))

    def _may(self, what: str) -> bool:
        """Return whether an action is possible, and notify why not."""
        obstacle = self._obstacle(what)
        if obstacle:
            self.notify(obstacle, severity="warning", markup=False)
        return not obstacle

    def _obstacle(self, what: str) -> str:
        """Return why the action ``what`` is not possible, "" if it is."""
        entry = self._whole.entry if self._whole is not None else None
        if entry is None or entry.wrong:
            return "no recording is open"
        if self._busy:
            return f"wait: {self._busy}"
        if what == "accept":
            return self._not_to_accept(entry)
        if what in ("investigate", "facts"):
            return "" if entry.gyros else "there is no calibration in this recording"
        if what == "next" and not self._found.get("next_script"):
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
        values: dict[str, Any] = {"whole": whole, "path": self.recording, "busy": self._busy, "said": self._said}
        values["state_figures"] = figures_from(whole.entry.units if whole is not None else {})
        moved = Text.from_markup(moved_since(self._moves), emoji=False)
        self._block("verdict", Text("\n").join(filter(None, (templated("verdict.rich", values), moved))))
        shown: dict[str, RenderableType] = {}
        if whole is not None and not whole.entry.wrong:
            values |= {"entry": whole.entry, "last": last_comparable(whole.entry, self._same), "moves": self._moves}
            blocks = ("states", "change", "record") if whole.entry.gyros else ("record",)
            shown = {name: templated(f"{name}.rich", values) for name in blocks}
            if whole.entry.gyros:
                lines = self._model or [Text("I looks for errors beyond the four states", "dim")]
                shown["model"] = Group(Text("Investigation", "bold underline"), *lines)
        for name in _BLOCKS[1:]:
            self._block(name, shown.get(name))
        charts.draw()

    def _block(self, name: str, shown: RenderableType | None) -> None:
        block = self.query_one(f"#{name}", Static)
        block.display = shown is not None
        block.update("" if shown is None else shown)

    def _drawing(self, name: str) -> Drawing | None:
        """Return the chart of a state, with the calibration's figure; None without curves."""
        whole = self._whole
        if whole is None or not whole.curves:
            return None
        index = STATE_CHARTS.index(name)
        gyro, curve = list(whole.curves.items())[self.gyro % len(whole.curves)]
        limit = StateLimit(whole.sizes[index], whole.written[index])
        drawing = state_drawing(index, curve, limit, figures=figures_from(whole.entry.units))
        calibrated = next((found for found in whole.entry.gyros if found.name == gyro), None)
        if calibrated is None:
            return drawing
        # The curve is that of the live filter; the figure is that of the calibration, as in the table beside it.
        state, _, *others = drawing.words
        figure = figures_from(whole.entry.units)[index].figure(calibrated.values[index], calibrated.sds[index])
        return drawing._replace(words=[state, (figure, "line"), *others])


def _investigation(found: Mapping[str, Any]) -> list[RenderableType]:
    """Return the lines and tables of `station investigate` from its JSON; a hint if it is damaged or of another
    version.

    Call it in a thread: it loads a library first.
    """
    from station.render.investigation_printed import investigation_shown
    from station.views.investigation import investigation_of

    try:
        shown = investigation_shown(investigation_of(found), "d drives it")
    except Exception:  # a file made by hand
        return [Text("damaged, or written by another version of the station: I investigates again", "yellow")]
    return [Text.from_markup(line, emoji=False) if isinstance(line, str) else line for line, _ in shown]
