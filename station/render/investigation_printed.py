"""An investigation as a person reads it, in a terminal and on the screen."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from estimator.effects.constructed import readable
from estimator.tracing.investigation import Finding, Investigation
from station.render.investigations.errors import errors_shown
from station.render.investigations.residual import residual_shown
from station.render.investigations.verdict import verdict_sentences
from station.render.terminal import Shown, line, print_all, rich_table, stdout, unbroken
from station.scripts.next_script import NextScript
from station.views.figures import FINDING_STYLES, number, probability
from station.views.investigation import InvestigationView, SuspectView, investigation_of, investigation_view

_LEAST_SHOWN = 0.005  # suspects less probable than this are one line together
_MOST_SHOWN = 8


def exit_code_of(finding: Finding) -> int:
    """Return 0 if the cause is known or there is none, 1 if it is not known."""
    return 0 if finding in (Finding.NOTHING, Finding.ADDED) else 1


def print_investigation(
    investigation: Investigation, next_script: NextScript | None, path: Path | None, console: Console | None = None
) -> None:
    """Print the verdict in words, the suspects, the error before and after, what was left out, and the next script."""
    print_all(console or stdout(), next_shown(investigation_view(investigation, path), next_script, path))


def next_shown(investigation: InvestigationView, next_script: NextScript | None, path: Path | None) -> list[Shown]:
    """Return the lines and tables of an investigation whose next script, if any, is in the file ``path``."""
    return investigation_shown(
        investigation, f"station run --script {path}", next_script.words() if next_script else ""
    )


def investigation_shown(investigation: InvestigationView, how: str, drive: str = "") -> list[Shown]:
    """Return the lines and tables of an investigation: verdict, what to do next, suspects, residual, errors, remarks.

    ``how`` is the command that runs its next script, ``drive`` a line on that script, empty if there is none.
    """
    return [
        *_verdict(investigation),
        *_next(investigation, how, drive),
        *_suspects(investigation),
        line(""),
        *residual_shown(investigation.residual),
        *errors_shown(investigation),
        *_remarks(investigation),
    ]


def verdict_lines(investigation: Mapping[str, Any]) -> list[str]:
    """Return the result of an investigation, given as JSON, in sentences."""
    return verdict_sentences(investigation_of(investigation))


def _verdict(investigation: InvestigationView) -> Iterator[Shown]:
    colour = FINDING_STYLES.get(investigation.verdict, "bold")
    yield line(f"[{colour}]{escape(investigation.verdict.upper())}[/]  {escape(investigation.reason)}")
    for sentence in verdict_sentences(investigation):
        yield line(f"  {escape(sentence)}")


def _next(investigation: InvestigationView, how: str, drive: str) -> Iterator[Shown]:
    """Yield the script to run next, nothing if there is none."""
    if not investigation.next_script:
        return
    if drive:
        yield line(escape(f"  run next: {drive}"))
    yield unbroken(f"  script: {investigation.next_script}   ({how})")


def _suspects(investigation: InvestigationView) -> Iterator[Shown]:
    """Yield the suspects by falling probability as a table; nothing without suspects.

    It has at most eight, each of 0.5 % or more; a last row has the number and probability of the others together.
    """
    if not investigation.suspects:
        return
    ranked = sorted(investigation.suspects, key=lambda suspect: -(suspect.probability or 0.0))
    shown = [suspect for suspect in ranked if (suspect.probability or 0.0) >= _LEAST_SHOWN][:_MOST_SHOWN]
    suspects = rich_table("What the first model may miss", ["suspect", "probability", "log evidence"], "lr")
    for suspect in shown:
        suspects.add_row(
            escape(readable(suspect.effect)),
            probability(suspect.probability),
            number(suspect.log_evidence, 1, signed=True),
        )
    _add_others(suspects, ranked[len(shown) :])
    yield line("")
    yield suspects, {}


def _add_others(suspects: Table, improbable: list[SuspectView]) -> None:
    if improbable:
        together = sum(suspect.probability or 0.0 for suspect in improbable)
        suspects.add_row(f"{len(improbable)} others together", probability(together), "", style="dim")


def _remarks(investigation: InvestigationView) -> Iterator[Shown]:
    """Yield the effects that were left out, by reason, and the notes."""
    left_out: dict[str, list[str]] = {}
    for effect, reason in investigation.left_out.items():
        left_out.setdefault(reason, []).append(readable(effect))
    for reason, effects in left_out.items():
        yield line(escape(f"left out, {reason}: {', '.join(effects)}"))
    for note in investigation.notes:
        yield line(escape(f"note: {note}"))
