"""Many recordings, calibrated one after the other, in a table."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

from station.render.lines import tell
from station.render.terminal import Shown, line, print_all, rich_table, stdout
from station.run.outcome import Outcome
from station.views.figures import OUTCOME_STYLES

_HEADS = ("recording", "device", "script", "outcome", "worst sigma / prior", "mean NIS")
_MOST_NAMED = 3
_NOT_COMPARED = (
    "recordings compared with no other: that takes runs of one serial number on one bench, "
    "with one script and the same gyros, which did not fail"
)


@dataclass(kw_only=True, frozen=True, slots=True)
class OverviewRow:
    """A recording: its device, script, outcome, largest sigma over its prior, and mean NIS, NaN where not known."""

    recording: str
    device: str
    script: str
    outcome: Outcome
    worst_share: float
    nis_mean: float


def print_overview(folder: str, rows: Sequence[OverviewRow], reasons: Mapping[str, Sequence[str]]) -> None:
    """Print one line for each recording of a folder, then the reasons of the outcomes, each with its recordings."""
    print_all(stdout(), _shown(folder, rows, reasons))


def tell_compared(alone: int, judged: int) -> None:
    """Print how many of the recordings ``judged`` are compared with no other."""
    tell(f"{alone} of {judged} {_NOT_COMPARED}")


def _shown(folder: str, rows: Sequence[OverviewRow], reasons: Mapping[str, Sequence[str]]) -> Iterator[Shown]:
    yield _table(folder, rows), {}
    for reason, recordings in reasons.items():
        yield line(escape(f"{_who(recordings, len(rows))}: {reason}"))


def _table(folder: str, rows: Sequence[OverviewRow]) -> Table:
    """Return a row for each recording: device, script, outcome, largest sigma relative to its prior, mean NIS.

    The latter two are empty where they are not known.
    """
    overview = rich_table(f"Recordings in {escape(folder)}", _HEADS, "llllrr")
    for row in rows:
        overview.add_row(
            escape(row.recording),
            escape(row.device),
            escape(row.script),
            f"[{OUTCOME_STYLES[row.outcome]}]{row.outcome}[/]",
            f"{100 * row.worst_share:.2f}%" if math.isfinite(row.worst_share) else "",
            f"{row.nis_mean:.3f}" if math.isfinite(row.nis_mean) else "",
        )
    return overview


def _who(recordings: Sequence[str], count: int) -> str:
    """Return the recordings to which a reason applies; "all" if it applies to all of several."""
    if len(recordings) == count > 1:
        return "all"
    named = ", ".join(recordings[:_MOST_NAMED])
    others = len(recordings) - _MOST_NAMED
    return f"{named} and {others} more" if others > 0 else named
