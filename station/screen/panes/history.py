"""The lines of the history screen: on the folder, and on the device whose trend is shown."""

from dataclasses import dataclass
from pathlib import Path

from rich.text import Text

from station.screen.archive.entries import Entry
from station.screen.panes.lines import line


@dataclass(kw_only=True, frozen=True, slots=True)
class FolderView:
    """The recordings of a folder: how many there are and match the filter, of which at most ``most`` are listed."""

    folder: Path
    count: int
    matching: int
    most: int
    reading: bool


def folder_text(view: FolderView) -> Text:
    """Return how many recordings are shown of which folder."""
    of_all = f" of {view.count}" if view.matching != view.count else ""
    listed = f", the first {view.most} here" if view.matching > view.most else ""
    reading = ", reading ..." if view.reading else ""
    return line(f"{view.matching}{of_all} recordings in {view.folder}{listed}{reading}   (Enter opens one)")


@dataclass(kw_only=True, frozen=True, slots=True)
class TrendView:
    """The trend of a gyro over ``count`` calibrations, of which ``failed`` are of runs that failed.

    ``chosen`` is the recording whose device it is, None for none; ``gyro`` is empty if it has no calibration.
    """

    chosen: Entry | None
    gyro: str
    count: int
    failed: int


def trend_text(view: TrendView) -> Text:
    """Return whose trend is shown, its number of calibrations, how many FAIL, the file; empty without a recording.

    If the chosen recording cannot be read, or has no calibration, it says that instead.
    """
    chosen = view.chosen
    if chosen is None:
        return Text()
    name = chosen.path.name
    if chosen.wrong:
        return line((f"{name}: {chosen.wrong}", "red"))
    if not view.gyro:
        return line((f"{name} has no calibration", "dim"))
    calibrations = f"{view.count} {'calibration' if view.count == 1 else 'calibrations'}"
    failed = f", {view.failed} of them FAIL" if view.failed else ""
    return line((f"{view.gyro} of {chosen.device or 'device'}, {calibrations}{failed};  {name}", "bold"))
