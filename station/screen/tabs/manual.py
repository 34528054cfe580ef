"""Manual mode on the screen: its start, the chosen axis and rate, and its keys."""

import asyncio
import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

from textual import events
from textual.binding import Binding

from drivers.packaged import packaged_toml
from station.screen.base import StationScreen
from station.screen.dialogs import AskDialog, AskTextDialog
from station.screen.panes.progress import DrivenAxis, ManualView
from station.screen.tabs.prospects import look_ahead

_KNOWN: dict[str, Any] = packaged_toml("station.screen", "manual.toml")
_RATES_DPS: list[float] = _KNOWN["rates_dps"]
_STALE_S = 0.25


def begin_manual(screen: StationScreen) -> None:
    """Ask for confirmation, then start manual mode on the chosen bench, which homes the table; refuse if something is
    wrong.

    Real hardware that is only remembered from the last run must be opened first.
    """
    station = screen.station

    async def begin() -> None:
        """Start a manual run on the bench of the choices, or notify why not.

        That is if bench or folder is wrong, or the bench is recalled and real hardware.
        """
        prospect = await asyncio.to_thread(look_ahead, station.choices)
        wrong = prospect.bench_wrong or prospect.folder_wrong
        if station.bench_recalled and not prospect.all_twins:
            wrong = f"bench {prospect.bench} was used in the last run and is real hardware: F6 on Prepare opens it"
        if wrong:
            screen.notify(wrong, title="Not started", severity="error", markup=False)
        else:
            station.start_run(replace(prospect, manual=True))

    question = (
        f"Manual mode on {station.choices.bench or 'the built-in twins'}: driven by hand, recorded but not judged."
    )
    dialog = AskDialog(question, [("back", "Back"), ("begin", "Start: the table moves to its home")])
    screen.app.push_screen(dialog, lambda answer: station.work(begin, "begin") if answer == "begin" else None)


class ManualScreen(StationScreen):
    """A screen whose keys drive the table while a session in manual mode is shown."""

    BINDINGS: ClassVar = [
        Binding("m", "manual", "Manual mode", show=False),
        *(
            Binding(k, f"drive('{word}')", says, key_display=shown, show=False)
            for k, word, shown, says in _KNOWN["keys"]
        ),
    ]
    _axis = 0
    _rate = _RATES_DPS.index(_KNOWN["begin_dps"])

    @property
    def axes(self) -> Sequence[DrivenAxis]:
        """The axes of a session in manual mode, in order of their names; none if there is none or it has ended.

        Angles are NaN before the first snapshot.
        """
        run = self.station.shown
        if run is None or not run.active or run.hello is None or not run.hello.manual:
            return ()
        angles = {axis.name: axis.angle_rad for axis in run.snapshot.axes} if run.snapshot is not None else {}
        return [
            DrivenAxis(name=name, angle_rad=angles.get(name, math.nan), limits=limits)
            for name, limits in sorted(run.hello.axes.items())
        ]

    def manual_view(self) -> ManualView | None:
        """Return the bar of manual mode; None for a session in another mode."""
        axes = self.axes
        if not axes:
            return None
        return ManualView(axes=axes, chosen=axes[self._axis % len(axes)].name, rate_dps=_RATES_DPS[self._rate])

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Have the keys that drive in manual mode only."""
        return action != "drive" or bool(self.axes)

    def on_key(self, event: events.Key) -> None:
        """Ignore a driving key that waited too long: it may have been released."""
        if event.key in ("comma", "full_stop") and time.monotonic() - event.time > _STALE_S:
            event.stop()

    def action_manual(self) -> None:
        """Begin manual mode."""
        begin_manual(self)

    def action_drive(self, word: str) -> None:
        """Carry out ``word``: axis, slower, faster, go, hold, end or home; any other is a sign, to jog.

        The first three change the chosen axis, or the rate up to that of the axis; ``go`` asks for an angle. The others
        are sent to the session, with axis and rate where they need them. Nothing without a table to drive.
        """
        view = self.manual_view()
        if view is None:
            return
        axis = view.chosen
        rate_dps = view.rate_dps
        drive = self.station.drive
        if word == "axis":
            self._axis += 1
        elif word in ("slower", "faster"):
            most_dps = math.degrees(view.chosen_axis.limits.rate_rps)
            fit = [n for n, rate in enumerate(_RATES_DPS) if rate <= most_dps or not n]
            self._rate = min(max(self._rate + (1 if word == "faster" else -1), 0), fit[-1])
        elif word == "go":
            question = f"Angle of axis {axis} from home, in deg, to go to at {rate_dps:g} deg/s"
            self.app.push_screen(AskTextDialog(question), partial(self._go, axis, rate_dps))
        elif word in ("hold", "end"):
            drive(word)
        elif word == "home":
            drive(word, axis=axis, rate_rps=math.radians(rate_dps))
        else:
            drive("jog", axis=axis, rate_rps=math.radians(float(f"{word}{rate_dps}")))
        self.tick()

    def _go(self, axis: str, rate_dps: float, text: str | None) -> None:
        try:
            angle_rad = math.radians(float(text or ""))
            self.station.drive("go", axis=axis, angle_rad=angle_rad, rate_rps=math.radians(rate_dps))
        except ValueError:
            if text:
                self.notify(f"{text!r} is not an angle in deg", severity="warning", markup=False)
