"""The residual of an investigation: what it was traced to, and the error before and after."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os.path import basename

from markupsafe import Markup

from estimator.effects.constructed import readable as words
from station.render.investigations.verdict import verdict_sentences
from station.report.figures import COVERAGE, DEG_PER_H, ONE, PERCENT, known, worded
from station.report.investigation_chapter import Traced, number
from station.report.pictures import Picture, residual_picture
from station.report.recorded import Recorded
from station.report.tables import Content, Table, table_of
from station.views.figures import probability
from station.views.investigation import (
    AddedView,
    ErrorsView,
    ImprovementView,
    InvestigationView,
    investigation_of,
)

_ERROR_HEADS = (
    "gyro",
    "rms before, °/h",
    "rms after, °/h",
    "largest before, °/h",
    "largest after, °/h",
    "within 95 % before, %",
    "within 95 % after, %",
)


@dataclass(kw_only=True, frozen=True, slots=True)
class Improvement:
    """By how many times the rms error became smaller, with the ends of its 95 % interval."""

    ratio: Markup
    low: Markup
    high: Markup


@dataclass(kw_only=True, frozen=True, slots=True)
class ResidualView:
    """The chapters on an investigation.

    ``fitted`` and ``verified_on`` are names of files; ``among_them``: the recording of this document is one of them.
    ``added`` is None if no effect was added. ``in_sample``: there was no run for verification.
    """

    verdict: str
    reason: str
    fitted: str
    verified_on: str
    among_them: bool
    added: Table | None
    findings: Sequence[str]
    pictures: Sequence[Picture]
    errors: Table
    improvement: Improvement | None
    in_sample: bool


def residual_view(traced: Traced | None, recorded: Recorded) -> ResidualView | None:
    """Return the result of an investigation with its pictures; None without one.

    It says whether the recording of the report is among the investigated ones.
    """
    if traced is None:
        return None
    what = investigation_of(traced.what)
    fitted = [basename(path) for path in what.recordings]
    verified_on = [basename(path) for path in what.verification]
    findings = [*verdict_sentences(replace(what, added=())), *what.notes]
    return ResidualView(
        verdict=what.verdict,
        reason=_sentence(words(what.reason)),
        fitted=", ".join(fitted),
        verified_on=", ".join(verified_on),
        among_them=recorded.path.name in fitted + verified_on,
        added=_added_table(what.added) if what.added else None,
        findings=[_sentence(text) for text in findings],
        pictures=[residual_picture(course, traced.spectra.get(course.gyro)) for course in traced.residuals],
        errors=_errors_table(what),
        improvement=_improvement(what.improvement),
        in_sample=what.in_sample,
    )


def _sentence(text: str) -> str:
    """Return a remark as a sentence, with a capital and a full stop."""
    text = text.strip()
    if not text:
        return ""
    stop = "" if text.endswith(".") else "."
    return f"{text[:1].upper()}{text[1:]}{stop}"


def _added_table(added: Sequence[AddedView]) -> Table:
    rows = [row for effect in added for row in _effect_rows(effect)]
    return table_of(["effect", "parameter", "value ± U", "probability"], "llrr", rows)


def _effect_rows(effect: AddedView) -> Iterator[list[Content]]:
    """Yield the parameters of an effect with their expanded uncertainties, and how probable the effect is."""
    for name, (value, sd, unit) in effect.parameters.items():
        shown = worded(number(value), COVERAGE * number(sd), unit)
        yield [words(effect.effect), name, shown, probability(number(effect.probability))]


def _errors_table(investigation: InvestigationView) -> Table:
    """Return the error of each gyro before and after, and of all if there are several."""
    rows = [_error_row(name, gyro.before, gyro.after) for name, gyro in investigation.gyros.items()]
    if len(investigation.gyros) > 1:
        rows.append(_error_row("all", investigation.before, investigation.after))
    return table_of(_ERROR_HEADS, "lrrrrrr", rows, length=len(investigation.gyros) + 1)


def _error_row(name: str, before: ErrorsView, after: ErrorsView) -> list[Content]:
    """Return rms error, largest error (both in deg/h) and coverage of the 95 % intervals, each before and after."""
    return [
        name,
        known(before.rms_rps, DEG_PER_H),
        known(after.rms_rps, DEG_PER_H),
        known(before.max_rps, DEG_PER_H),
        known(after.max_rps, DEG_PER_H),
        known(before.coverage95, PERCENT),
        known(after.coverage95, PERCENT),
    ]


def _improvement(gain: ImprovementView | None) -> Improvement | None:
    if gain is None:
        return None
    return Improvement(ratio=known(gain.ratio, ONE), low=known(gain.low, ONE), high=known(gain.high, ONE))
