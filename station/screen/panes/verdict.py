"""The verdict on a recording with its reasons, and its record of notes and events."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.text import Text

from station.screen.archive.entries import Entry, Exceeded, ReadRecording
from station.screen.panes.lines import TITLE, joined, line, padded
from station.views.figures import OUTCOME_STYLES

_MOST = 4
"""So many reasons, or exceeded limits, are shown in the verdict; the record has all of more."""
_NAMED = (("operator", "operator"), ("script", "script"), ("station", "bench"))
_BOLD, _RED = "bold", "red"


@dataclass(kw_only=True, frozen=True, slots=True)
class VerdictView:
    """A recording, None until it is read, and what is done with it: ``busy`` now, ``message`` on what was done last."""

    path: Path | None
    whole: ReadRecording | None
    busy: str = ""
    message: str = ""


def verdict_text(view: VerdictView) -> Text:
    """Return the outcome with its reasons, who measured what and when, the file, and what is under way or was done.

    Without a recording it says what to do; before the recording is read, outcome and names are missing.
    """
    if view.path is None:
        return line("No run has ended yet. F5 opens a recording, F2 prepares a run.")
    lines = [] if view.whole is None else _outcome_lines(view.whole)
    lines.append(line(f"recording: {view.path}"))
    if view.busy:
        lines.append(line((f"{view.busy} ...", "bold yellow")))
    if view.message:
        lines.append(line((view.message, _BOLD)))
    return joined(lines)


def _outcome_lines(recording: ReadRecording) -> list[Text]:
    """Return only why a recording cannot be read, or its outcome, date, names, and acceptance if it was accepted.

    With the outcome are exceeded limits if they are known, else its reasons.
    """
    entry = recording.entry
    if entry.wrong:
        return [line(("CANNOT BE READ", "bold red"), f"  {entry.wrong}")]
    lines = _limits_exceeded(recording) if recording.broken else [_outcome(entry)]
    lines.append(line(f"{entry.when}   {'   '.join(_named(entry))}"))
    accepted_by = entry.texts.get("accepted_by")
    if accepted_by:
        lines.append(line((f"accepted by {accepted_by}, {entry.texts.get('accepted_utc', '')}", "green")))
    return lines


def _style(entry: Entry) -> str:
    return OUTCOME_STYLES.get(entry.texts.get("outcome", ""), _BOLD)


def _named(entry: Entry) -> list[str]:
    """Return device, operator, script and bench of a recording, as far as they are known."""
    device = [f"device {entry.device}"] if entry.device else []
    others = [f"{word} {entry.texts[key]}" for key, word in _NAMED if entry.texts.get(key)]
    return device + others


def _reasons(entry: Entry) -> list[str]:
    return entry.texts.get("reason", "").split("; ")


def _outcome(entry: Entry) -> Text:
    reasons = _reasons(entry)
    more = f"; and {len(reasons) - _MOST} more, see the record below" if len(reasons) > _MOST else ""
    outcome = entry.texts.get("outcome") or "no outcome"
    return line((outcome, _style(entry)), f"  {'; '.join(reasons[:_MOST])}{more}")


def _limits_exceeded(recording: ReadRecording) -> list[Text]:
    """Return lines on the exceeded limits: the outcome and how many, possible causes, the four worst, remedies of all.

    The worst with a bound are a table, those without an estimate are below it, then how many more there are, if any.
    """
    count = len(recording.broken)
    worst = recording.broken[:_MOST]
    limits = "limit" if count == 1 else "limits"
    lines = [
        line((recording.entry.texts["outcome"], _style(recording.entry)), f"  {count} {limits} of the bench exceeded")
    ]
    lines += [line(f"Possible cause: {cause}") for cause in recording.because]
    lines += _table([limit for limit in worst if limit.bound])
    lines += [line((f"{limit.subject}: {limit.found}", _RED)) for limit in worst if not limit.bound]
    if count > len(worst):
        lines.append(line(f"and {count - len(worst)} more, see the record below"))
    remedies = dict.fromkeys(limit.remedy for limit in recording.broken if limit.remedy)
    return lines + [line(remedy) for remedy in remedies]


def _table(limits: Sequence[Exceeded]) -> list[Text]:
    """Return a line of headings, and one for each limit."""
    heads = ["exceeded", "found", "limit", "missed by"]
    head, *rows = padded([heads, *(limit.cells for limit in limits)])
    return [line(("  ".join(head), _BOLD)), *(line(("  ".join(row), _RED)) for row in rows)]


def record_text(recording: ReadRecording) -> Text:
    """Return, below a heading, the record: what was excluded, notes, and events with their instants in s.

    All reasons, or exceeded limits, come first if there are more than the four that the verdict shows.
    """
    lines = [line(("Record", TITLE))]
    reasons = _reasons(recording.entry)
    if len(reasons) > _MOST and not recording.broken:
        lines += [line(reason) for reason in reasons]
    if len(recording.broken) > _MOST:
        lines += [line(("  ".join(filter(None, limit.cells)), _RED)) for limit in recording.broken]
    lines += [line((f"excluded: {text}", _RED)) for text in recording.excluded]
    lines += [line(f"note: {text}") for text in recording.notes]
    lines += [line((f"{t_s:8.1f} s  ", "dim"), text) for t_s, text in recording.events]
    return joined(lines)
