"""The tray: devices and scripts to be run one after another on a bench, kept when the screen is closed."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from estimator.errors import MISSHAPEN
from station.screen.memory import load_state, save_state

WAITING, RUNNING, SKIPPED, NO_RESULT = "waiting", "running", "skipped", "no result"
"""States of a spot; once a run has ended its outcome, too."""
_FILE = "trays.json"


@dataclass(frozen=True, slots=True)
class TrayItem:
    """A device and a script, empty for the 360 s script; ``recording`` is that of its last run. Paths are absolute."""

    serial: str
    script: str = ""
    state: str = WAITING
    recording: str = ""


class Tray:
    """The items of one bench in order; every change is stored at once."""

    def __init__(self, bench: str) -> None:
        """Load the stored tray of a bench: ``bench`` is the absolute path of its file, empty for the built-in one."""
        self.bench, self.spots = bench, list[TrayItem]()
        with suppress(*MISSHAPEN):
            stored = load_state(_FILE)[bench]
            self.spots = [TrayItem(*(str(spot.get(key, "")) for key in TrayItem.__slots__)) for spot in stored]

    @property
    def next(self) -> TrayItem | None:
        """The first spot that waits."""
        return next((spot for spot in self.spots if spot.state == WAITING), None)

    def keep(self, spots: Sequence[TrayItem]) -> str:
        """Replace all items and store them; return why they cannot be stored, empty if they are."""
        self.spots = list(spots)
        return save_state(_FILE, {**load_state(_FILE), self.bench: [asdict(spot) for spot in spots]})

    def change(self, spot: TrayItem, **new: str) -> str:
        """Change fields of an item, if it is on the tray; return why that cannot be stored, empty if it is."""
        return self.keep([replace(old, **new) if old == spot else old for old in self.spots])

    def end(self, recording: Path, state: str) -> TrayItem | None:
        """Note how a run ended, or that it never began and its spot waits; return the spot, None if there is none."""
        ran = next((spot for spot in self.spots if spot.recording == str(recording.resolve())), None)
        if ran is not None:
            self.change(ran, state=state, recording="" if state == WAITING else ran.recording)
        return ran
