"""How far long work is, on stderr: a bar in a terminal, a few lines elsewhere, nothing when quiet."""

import time
from collections.abc import Callable
from typing import Any

from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn

from station.render.terminal import HarmlessConsole
from station.run.snapshot import Snapshot
from station.views.figures import clock_between, number

_REFRESH_S = 0.1  # of the wall's clock: a person watches, however fast the loop's clock runs


def _green_bar() -> BarColumn:
    return BarColumn(complete_style="green", finished_style="green")  # red, rich's default, is for errors


class Bar(Progress):
    """A progress bar of one task; prints lines if there is no terminal, and nothing if quiet."""

    _EVERY = 0.1
    """Without a terminal: one line each tenth of the work."""

    def __init__(
        self,
        quiet: bool,
        *columns: ProgressColumn,
        begins: str,
        total: float = 1.0,
        auto_refresh: bool = True,
        transient: bool = False,
        **fields: Any,
    ) -> None:
        """Prepare a bar on stderr, hidden if ``quiet`` or if that is no terminal.

        ``begins`` is the first description of its task, which is done at ``total``; ``fields`` are further values for
        the columns. A ``transient`` bar is removed at the end. Without ``auto_refresh`` it is drawn only when it is
        updated.
        """
        console = HarmlessConsole(stderr=True)
        self._quiet, self._at_once = quiet, not auto_refresh
        hidden = quiet or not console.is_terminal
        super().__init__(*columns, console=console, auto_refresh=auto_refresh, transient=transient, disable=hidden)
        self._shown_share = 0.0
        self._task = self.add_task(begins, total=total, **fields)

    def _tell(self, line: str, share: float, due: bool | None = None, **values: Any) -> None:
        """Show ``values`` in the bar; without a bar print ``line`` if ``due``, nothing when quiet.

        By default a line is due when ``share``, 0 to 1, is ``_EVERY`` or more beyond that of the last line.
        """
        if not self.disable:
            self.update(self._task, refresh=self._at_once, **values)
        elif not self._quiet and (share - self._shown_share >= self._EVERY if due is None else due):
            self._shown_share = share
            self.console.print(line, highlight=False)


class RunProgress(Bar):
    """Progress of a run."""

    def __init__(self, quiet: bool) -> None:
        """Show nothing if quiet."""
        columns = (TextColumn("{task.description:<18}"), _green_bar(), TextColumn("{task.fields[detail]}"))
        super().__init__(quiet, *columns, begins="connecting", auto_refresh=False, detail="")
        self._shown_at = 0.0
        self._shown_share = -1.0

    def show(self, look: Callable[[], Snapshot]) -> None:
        """Show the progress of a run, at most ten times a second, without a terminal a line for each tenth of it.

        ``look`` gives the state of the run; it is called only if something may be shown, never when quiet.
        """
        now = time.monotonic()
        if self._quiet or now - self._shown_at < _REFRESH_S:
            return
        self._shown_at = now
        snapshot = look()
        left = clock_between(snapshot.remaining_s, snapshot.longer_s)
        detail = f"{left} left   {snapshot.samples} samples, {snapshot.lost} lost   NIS {number(snapshot.nis_mean, 2)}"
        line = f"{snapshot.share:4.0%}  {snapshot.doing:<18} {detail}"
        self._tell(line, snapshot.share, description=snapshot.doing, completed=snapshot.share, detail=detail)


class TracingProgress(Bar):
    """Progress of an investigation."""

    _EVERY = 0.25

    def __init__(self, quiet: bool, *, transient: bool = False) -> None:
        """Show nothing if quiet; a ``transient`` bar is taken away at the end."""
        columns = (TextColumn("{task.percentage:>3.0f} %"), _green_bar(), TextColumn("{task.description}"))
        super().__init__(quiet, *columns, begins="tracing", transient=transient)

    def show(self, share: float, text: str) -> None:
        """Show the share done, 0 to 1, and the current step."""
        self._tell(f"{share:4.0%}  {text}", share, completed=share, description=text)
