"""The verdict on a result as a person reads it, and what to do next."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.markup import escape

from estimator.calibration.values import Calibration
from estimator.observations.coverage import not_proved
from station.render.terminal import Shown, line, rich_table, unbroken
from station.run.outcome import Outcome, Verdict
from station.views.figures import OUTCOME_STYLES
from station.views.limits import worst_first

_MOST_BROKEN = 4
"""Limits that are broken of which a person sees without asking for details: the worst."""
_BROKEN_HEADS = ("exceeded", "found", "limit", "missed by")


def verdict_shown(verdict: Verdict, *, details: bool) -> Iterator[Shown]:
    """Yield the outcome and its reasons: possible causes first, then broken limits as a table.

    Without ``details`` only the worst limits are listed. Without broken limits it is one line with the reason.
    """
    outcome = f"[{OUTCOME_STYLES[verdict.outcome]}]{verdict.outcome}[/]"
    if not verdict.broken:
        yield line(f"{outcome}  {escape(verdict.reason)}")
        return
    broken = list(verdict.broken) if details else worst_first(verdict.broken)[:_MOST_BROKEN]
    count = len(verdict.broken)
    limits = "1 limit" if count == 1 else f"{count} limits"
    worst = ". The worst:" if count > len(broken) else ""
    yield line(f"{outcome}  {limits} of the bench exceeded{worst}")
    for cause in verdict.because:
        yield line(f"Possible cause: {escape(cause)}")
    rows = [[escape(cell) for cell in limit.cells] for limit in broken]
    yield rich_table(None, _BROKEN_HEADS, "lr", rows, fold=True, frameless=True), {}


def closing_shown(steps: Sequence[str], recording: Path, *, more: bool) -> Iterator[Shown]:
    """Yield what to do next, the recording and, if there is ``more`` to tell, how to see it."""
    for place, step in enumerate(steps):
        begins = "next: " if place == 0 else "      "
        yield line(f"{begins}{escape(step)}")
    yield unbroken(f"recording: {recording}")
    if more:
        yield line("more: --details")


def next_steps(verdict: Verdict, calibration: Calibration | None, recording: Path) -> list[str]:
    """Return sentences, with commands, on what to do next after a verdict.

    They depend on its outcome: check and repeat a run that was aborted or in fault, remedy broken limits or else
    investigate, write the report of a run that passed or has no limits. Such a run whose calibration does not prove
    constancy gets a plan for that, too. After a run by hand the sentence says that nothing was judged.
    """
    if verdict.outcome in (Outcome.ABORTED, Outcome.FAULT):
        return ["`station check` tests every device; then repeat the run"]
    if verdict.outcome is Outcome.MANUAL:
        return ["nothing was judged. `station run` runs a script and calibrates"]
    remedies = list(dict.fromkeys(limit.remedy for limit in verdict.broken if limit.remedy))
    if verdict.outcome is Outcome.FAIL:
        return remedies or [f"`station investigate {recording}` looks for errors that the model misses"]
    steps = [f"`station report {recording}` writes the certificate or report"]
    if calibration is not None and not_proved(calibration.constancy):
        steps.append("`station plan --early-late` writes a script that proves constancy")
    return steps


def next_after_report(verdict: Verdict | None, recording: Path, joined: Sequence[str] = ()) -> list[str]:
    """Return sentences on what to do after a report; for a run that passed, how to export the calibration.

    Others get those of ``next_steps``. ``verdict`` is None for data that no run made, which count as passed. ``joined``
    are the recordings with which it is joined.
    """
    if verdict is not None and verdict.outcome not in (Outcome.PASS, Outcome.ESTIMATED):
        return next_steps(verdict, None, recording)
    named = " ".join([str(recording), *(f"--join {name}" for name in joined)])
    return [f"`station export {named} --all FOLDER` writes the calibration for firmware and tools"]
