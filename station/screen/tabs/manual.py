"""Manual mode on the screen: which axis and rate are chosen, and what its keys say to the session."""

from __future__ import annotations

import math
import time
from typing import Any, ClassVar

from textual import events
from textual.binding import Binding

from station.run.snapshot import Snapshot
from station.screen.base import StationScreen
from station.screen.dialogs import AskTextDialog

_RATES_DPS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)
_BEGIN_DPS = 10
_STALE_S = 0.25
_KEYS = (
    ("comma", ",", "jog -", "Jog backwards while held"),
    ("full_stop", ".", "jog +", "Jog forwards while held"),
    ("a", "A", "axis", "Next axis"),
    ("s", "S", "slower", "Slower"),
    ("f", "F", "faster", "Faster"),
    ("t", "T", "go", "Go to an angle"),
    ("h", "H", "home", "Go home"),
    ("space", "SPACE", "hold", "Hold: come to rest"),
    ("e", "E", "end", "End manual mode"),
)


class ManualScreen(StationScreen):
    """A screen whose keys drive the table while a session in manual mode is shown."""

    BINDINGS: ClassVar = [
        Binding("m", "manual", "Manual"),
        *(Binding(key, f"drive('{word}')", says, key_display=shown, show=False) for key, shown, word, says in _KEYS),
    ]
    _axis = 0
    _rate = _RATES_DPS.index(_BEGIN_DPS)

    @property
    def table(self) -> dict[str, dict[str, Any]]:
        """The limits of each axis of a session in manual mode, empty for another."""
        run = self.station.shown
        found = dict(run.hello.get("table", {})) if run is not None and run.active and run.hello.get("manual") else {}
        return dict(sorted(found.items()))

    def manual_values(self, snapshot: Snapshot | None) -> dict[str, Any]:
        """Return what the bar shows: axes with their limits, which is chosen, the rate in deg/s, angles by axis."""
        table = self.table
        angles = {axis.name: axis.angle_rad for axis in snapshot.axes} if snapshot is not None else {}
        chosen = list(table)[self._axis % len(table)] if table else ""
        return {"table": table, "chosen": chosen, "rate_dps": _RATES_DPS[self._rate], "angles": angles}

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool | None:
        """Show the keys that drive in manual mode only."""
        return bool(self.table) if action == "drive" else True

    def on_key(self, event: events.Key) -> None:
        """Let no key jog that waited for its turn: whoever held it may have let go."""
        if self.table and event.key in ("comma", "full_stop") and time.monotonic() - event.time > _STALE_S:
            event.stop()

    def action_manual(self) -> None:
        """Begin manual mode."""
        self.station.begin_manual()

    def action_drive(self, word: str) -> None:
        """Choose, or say a word to the session with what is chosen."""
        table, run = self.table, self.station.shown
        axis = self.manual_values(None)["chosen"]
        rate_rps = math.radians(_RATES_DPS[self._rate])
        if word == "axis":
            self._axis += 1
        elif word in ("slower", "faster"):
            most = max(n for n, rate in enumerate(_RATES_DPS) if not n or rate <= math.degrees(table[axis]["rate_rps"]))
            self._rate = min(max(self._rate + (1 if word == "faster" else -1), 0), most)
        elif word == "go":
            question = f"Angle of axis {axis} from home, in deg, to go to at {_RATES_DPS[self._rate]:g} deg/s"
            self.app.push_screen(AskTextDialog(question), lambda text: self._go(run, axis, rate_rps, text))
        elif word == "home":
            self.station.drive("home", axis=axis, rate_rps=rate_rps)
        elif word in ("hold", "end"):
            self.station.drive(word)
        else:
            self.station.drive("jog", axis=axis, rate_rps=math.copysign(rate_rps, float(f"{word[-1]}1")))
        self.tick()

    def _go(self, run: object, axis: str, rate_rps: float, text: str | None) -> None:
        """Go to the angle that was typed, if the session is still that which was asked for."""
        try:
            angle_rad = math.radians(float((text or "").removesuffix("deg")))
        except ValueError:
            if text:
                self.notify(f"{text!r} is no angle in deg", severity="warning", markup=False)
            return
        if run is self.station.shown:
            self.station.drive("go", axis=axis, angle_rad=angle_rad, rate_rps=rate_rps)
