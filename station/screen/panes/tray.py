"""The tray as lines of a list, and the question to mount a device."""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.text import Text

from station.screen.panes.lines import line
from station.screen.sessions.tray import RUNNING, TrayItem
from station.views.figures import OUTCOME_STYLES


@dataclass(kw_only=True, frozen=True, slots=True)
class TrayView:
    """The items of a tray in order, and the first that waits, None if none does."""

    spots: Sequence[TrayItem]
    next: TrayItem | None


def tray_head(view: TrayView) -> Text:
    """Return the line above the list: what is to be mounted next, that nothing waits, or that the tray is empty."""
    if view.next is not None:
        place = f"{view.spots.index(view.next) + 1} of {len(view.spots)}"
        return line("Next: ", (view.next.serial, "bold"), f", {place}. Press F7 to mount it")
    if view.spots:
        return line("No device is waiting. Enter on a line opens its recording")
    return line("Scan the devices on the tray")


def tray_lines(view: TrayView) -> list[Text]:
    """Return a line for each item: its place from 1 on, serial number, script, state and recording's file name.

    The script is "360 s" for the built-in one; the file name is missing before the item has run.
    """
    lines = []
    for place, spot in enumerate(view.spots, start=1):
        script = _script_name(spot) or "360 s"
        recording = spot.recording.split("/")[-1]
        style = OUTCOME_STYLES.get(spot.state, "bold" if spot.state == RUNNING else "default")
        lines.append(line(f"{place:2d}  {spot.serial:16} {script:14} ", (f"{spot.state:11}", style), recording))
    return lines


def _script_name(spot: TrayItem) -> str:
    return spot.script.split("/")[-1].removesuffix(".toml")


def mount_question(spot: TrayItem, scanned: str) -> str:
    """Return the question to mount a device; ``scanned`` is another one's number that was scanned, "" if none was."""
    script = _script_name(spot) or "the 360 s script"
    wrong = f"{scanned} is not {spot.serial}: nothing was started.\n\n" if scanned else ""
    return (
        f"{wrong}Mount {spot.serial} ({script}). Then scan its number, or confirm with F8. "
        "Once its checks are green THE TABLE MOVES.\nEscape goes back; F10 and F7 ask again."
    )
