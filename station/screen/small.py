"""What a terminal, or the browser of a telephone, shows that is too small for the screens: verdict, step, time left."""

import math

from rich.text import Text

from station.errors import sentence
from station.screen.bars import Lines
from station.screen.sessions.live_run import LiveRun
from station.views.figures import OUTCOME_STYLES, clock, number


class Small(Lines):
    """The run in a few lines, in place of everything but STOP."""

    def __init__(self, least: tuple[int, int]) -> None:
        """``least`` are the columns and rows that the screens need."""
        super().__init__(id="small")
        self._needs = sentence("screen.too_small", width=least[0], height=least[1])

    def show_run(self, run: LiveRun | None, said: str) -> None:
        """Show a run, or if there is none what is ``said`` of the recording that is chosen."""
        lines = Text("\n").join([*_lines(run, said), Text(), Text(self._needs, style="dim")])
        self.show(lines, len(lines.split()))


def _lines(run: LiveRun | None, said: str) -> list[Text]:
    """Return what is most wanted to be known of a run, most of all first."""
    if run is None:
        return [Text(said or "no session runs", style="bold")]
    if run.outcome:
        reason = str((run.result or {}).get("reason", ""))
        style = OUTCOME_STYLES.get(run.outcome, "")
        return [Text.assemble((run.outcome, f"bold {style}"), f"  {reason}")]
    snapshot = run.snapshot
    if snapshot is None:
        return [Text("starting", style="bold")]
    left = f"{clock(snapshot.remaining_s)} left, {snapshot.share:.0%} done"
    turning = [f"{axis.name} at {number(math.degrees(axis.angle_rad), 1)} deg" for axis in snapshot.axes]
    return [
        Text(snapshot.doing, style="bold"),
        Text(left),
        Text(f"NIS {number(snapshot.nis_recent, 2)} (near 1 is good), {snapshot.lost} samples lost"),
        Text(", ".join(turning)),
    ]
