"""How far a run is, how it ended, and the bar of manual mode below."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from drivers.types import AxisLimits
from station.run.snapshot import PAUSED, Snapshot
from station.screen.panes.lines import Part, bar, joined, line
from station.screen.sessions.live_run import SILENCE_S, LiveRun, Stage
from station.views.figures import OUTCOME_STYLES, clock, clock_between, number

_REASON_ROWS = 4
_OMITTED = " ..."
_BOLD, _DIM, _ALARM = "bold", "dim", "bold red"


@dataclass(kw_only=True, frozen=True, slots=True)
class DrivenAxis:
    """An axis that can be driven by hand, with its limits; ``angle_rad`` is NaN where it is not known."""

    name: str
    angle_rad: float
    limits: AxisLimits


@dataclass(kw_only=True, frozen=True, slots=True)
class ManualView:
    """The axes of a table that is driven by hand, which one is chosen, and the rate of its jog."""

    axes: Sequence[DrivenAxis]
    chosen: str
    rate_dps: float

    @property
    def chosen_axis(self) -> DrivenAxis:
        """The axis that the keys drive."""
        return next(axis for axis in self.axes if axis.name == self.chosen)


@dataclass(kw_only=True, frozen=True, slots=True)
class ProgressView:
    """The run that is shown, None for none; then ``others`` is the number of sessions that run."""

    run: LiveRun | None
    others: int
    width: int
    manual: ManualView | None


def progress_text(view: ProgressView) -> Text:
    """Return how far the run is, or how it ended, and the bar of manual mode while the table is driven by hand."""
    lines = [line(_no_run(view.others))] if view.run is None else _run_lines(view.run, view.width)
    if view.manual is not None:
        lines += _manual_lines(view.manual)
    return joined(lines)


def _no_run(other_sessions: int) -> str:
    running = (
        f"{other_sessions} of your sessions are running: o shows one." if other_sessions else "No session is running."
    )
    return f"{running} F2 prepares one, m starts manual mode."


def _run_lines(run: LiveRun, width: int) -> list[Text]:
    """Return the lines on a run, fitted to ``width`` columns: ended, lost, silent, starting, by hand, or under way.

    The last line is the path of the recording, except by hand and under way.
    """
    recording = f"recording: {run.recording}"
    if run.stage is Stage.ENDED:
        begun = run.hello is not None
        return [*_ended(run, width), line(f"{recording}   (F4: result)" if begun else recording)]
    if run.stage is Stage.LOST:
        lost = "LINK LOST: the session continues; the screen is trying to reconnect"
        return [line((lost, _ALARM)), *map(line, _wrapped(run.trouble, width)), line(recording)]
    if run.silent_s > SILENCE_S:
        silent = f"NO DATA FROM THE SESSION for {run.silent_s:.0f} s: the display is out of date"
        return [line((silent, _ALARM)), line(recording)]
    if run.snapshot is None:
        waits = "the session is starting" if run.stage is Stage.STARTING else "connected, waiting for the first figures"
        return [line(waits), line((recording, _DIM))]
    if run.by_hand:
        return [_driven_by_hand(run.snapshot)]
    return _under_way(run, run.snapshot, width)


def _wrapped(text: str, width: int) -> list[str]:
    """Return a reason in a few lines of ``width`` or, in a very narrow pane, of the width of the mark of omission."""
    width = max(width, len(_OMITTED))
    return textwrap.wrap(text, width=width, max_lines=_REASON_ROWS, placeholder=_OMITTED)


def _ended(run: LiveRun, width: int) -> list[Text]:
    """Return the outcome with its reason, or that there is no result and why, in four lines of ``width`` at most."""
    head = "NO RESULT" if run.result is None else run.outcome
    reason = run.trouble if run.result is None else run.result.reason
    first, *others = _wrapped(f"{head}  {reason}", width) or [head]
    style = OUTCOME_STYLES.get(head, _ALARM)
    return [line((head, style), first[len(head) :]), *map(line, others)]


def _driven_by_hand(snapshot: Snapshot) -> Text:
    elapsed = clock(snapshot.elapsed_s)
    judged = f"   manual mode, {elapsed} min: nothing is judged; "
    return line((snapshot.doing, _BOLD), judged, ("e", _BOLD), " ends it")


def _under_way(run: LiveRun, snapshot: Snapshot, width: int) -> list[Text]:
    """Return two lines: what the run does, the time left, its script and newest event; its bar of ``width`` columns.

    The first one also says that it is paused, or will be after the step.
    """
    left = clock_between(snapshot.remaining_s, snapshot.longer_s)
    total = clock_between(snapshot.elapsed_s + snapshot.remaining_s, snapshot.longer_s)
    parts: list[Part] = [(snapshot.doing, _BOLD), f"   {left} left of {total}"]
    if snapshot.paused:
        pauses = "PAUSED" if snapshot.paused == PAUSED else "will pause after this step"
        parts.append((f"   {pauses}: p resumes", "bold yellow"))
    parts.append(f"   {run.script}")
    if run.events:
        t_s, text = run.events[-1]
        parts.append((f"   {t_s:.1f} s  {text}", _DIM))
    share = f" {snapshot.share * 100:4.0f}%"
    return [line(*parts), line((bar(snapshot.share, width - len(share)), "green"), share)]


def _manual_lines(view: ManualView) -> list[Text]:
    """Return three lines: the axes with their angles in deg, rate and limits of the chosen axis, and the keys."""
    names: list[Part] = [(" MANUAL ", "bold reverse"), "  "]
    for axis in view.axes:
        style = "bold reverse" if axis.name == view.chosen else ""
        names += [(f" {axis.name} {number(math.degrees(axis.angle_rad), 3)} deg ", style), "  "]
    jog = (f"jog {view.rate_dps:g} deg/s", _BOLD)
    return [line(*names), line(jog, f"   {view.chosen}: {_axis_limits(view.chosen_axis)}"), _keys()]


def _axis_limits(axis: DrivenAxis) -> str:
    rate = f"up to {math.degrees(axis.limits.rate_rps):.4g} deg/s"
    acceleration = f"{math.degrees(axis.limits.acceleration_rps2):.4g} deg/s2"
    if axis.limits.travel_rad is None:
        return f"{rate}, {acceleration}, no end of travel"
    low, high = map(math.degrees, axis.limits.travel_rad)
    return f"{rate}, {acceleration}, travel {low:.5g} to {high:.5g} deg"


def _keys() -> Text:
    """Return the line of keys of manual mode; the words of ``manual.toml`` are longer, for the help."""
    keys = (
        (", .", "jog - +   "),
        ("a", "axis  "),
        ("s f", "slower faster  "),
        ("t", "go to  "),
        ("h", "home  "),
        ("SPACE", "hold"),
    )
    parts: list[Part] = ["held: "]
    for key, words in keys:
        parts += [(key, _BOLD), f" {words}"]
    return line(*parts)
