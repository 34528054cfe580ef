"""The words and the colour of the bar with STOP."""

from dataclasses import dataclass
from enum import StrEnum

from station.screen.sessions.live_run import SILENCE_S, LiveRun, Stage
from station.views.figures import clock_between

_STOP = "■ STOP  F9"
_PATIENCE_S = 2.0
"""So long a session may take until it is seen to heed STOP."""
_EMERGENCY = "USE THE EMERGENCY STOP"


class StopColour(StrEnum):
    """The colour of the bar, which is also a class of its style."""

    NONE = ""
    ARMED = "armed"
    SENT = "sent"
    REST = "rest"


@dataclass(kw_only=True, frozen=True, slots=True)
class StopView:
    """The bar with STOP."""

    colour: StopColour
    text: str


def stop_view(run: LiveRun | None, other_sessions: int, recording_line: str = "") -> StopView:
    """Return the bar for a run; without one for the number of ``other_sessions``, or the line on a recording."""
    if run is None:
        return _no_run(other_sessions, recording_line)
    if run.stage is Stage.ENDED:
        return _ended(run)
    return _stopping(run) or _running(run)


def _no_run(other_sessions: int, recording_line: str) -> StopView:
    if not other_sessions:
        return StopView(colour=StopColour.NONE, text=recording_line or "no session is running")
    sessions = "your session" if other_sessions == 1 else f"your {other_sessions} sessions"
    return _armed(f"or Ctrl+C: stops {sessions}, not shown here (F3 o: show)")


def _ended(run: LiveRun) -> StopView:
    ended = f"the run has ended: {run.outcome or 'no result'}"
    if run.at_rest:
        return StopView(colour=StopColour.REST, text=f"{ended}, table at rest")
    if run.moved or run.unconfirmed:
        return StopView(colour=StopColour.ARMED, text=f"{ended}; TABLE NOT SEEN AT REST: {_EMERGENCY}")
    return StopView(colour=StopColour.NONE, text=ended)


def _stopping(run: LiveRun) -> StopView | None:
    """Return the bar of a run whose table is at rest or is to come to rest; None if neither.

    It tells the operator to use the emergency stop if rest is not confirmed, or if a STOP has had no reaction for
    ``_PATIENCE_S``.
    """
    if run.at_rest:
        sent = "STOP sent, " if run.stop_asked else ""
        return StopView(colour=StopColour.REST, text=f"{sent}table at rest")
    if run.unconfirmed:
        return _armed(f"THE TABLE DID NOT CONFIRM IT: {_EMERGENCY}")
    if not run.stop_asked:
        return None
    if run.stop_heard:
        return _sent("received; the table is stopping")
    if run.stop_age_s < _PATIENCE_S:
        return _sent("sent; waiting for the session to react")
    return _armed(f"sent {run.stop_age_s:.0f} s ago, NO REACTION: {_EMERGENCY}")


def _running(run: LiveRun) -> StopView:
    if run.stage is Stage.LOST:
        return _armed(f"link to the session lost: {run.trouble}")
    if run.silent_s > SILENCE_S:
        return _armed(f"no data from the session for {run.silent_s:.0f} s")
    return _armed(f"or Ctrl+C, or press here   {_doing(run)}")


def _doing(run: LiveRun) -> str:
    """Return what a run does at present: its phase and the time left, or in manual mode the words of the snapshot.

    "starting" before the first snapshot has come.
    """
    snapshot = run.snapshot
    if snapshot is None:
        return "starting"
    if run.by_hand:
        return f"manual mode, {snapshot.doing}"
    return f"{snapshot.phase}, {clock_between(snapshot.remaining_s, snapshot.longer_s)} left"


def _armed(text: str) -> StopView:
    return StopView(colour=StopColour.ARMED, text=f"{_STOP}   {text}")


def _sent(text: str) -> StopView:
    return StopView(colour=StopColour.SENT, text=f"{_STOP}   {text}")
