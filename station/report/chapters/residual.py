"""The residual of an investigation: what it was traced to, and the error before and after."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os.path import basename
from typing import Any, cast

from markupsafe import Markup

from estimator.effects.constructed import readable as words
from station.render.investigation_printed import verdict_lines
from station.report.figures import COVERAGE, DEG_PER_H, ONE, PERCENT, Unit, known, worded
from station.report.investigation_chapter import Traced, number
from station.report.pictures import Picture, residual_picture
from station.report.recorded import Recorded
from station.report.tables import Content, Table, table_of
from station.views.figures import probability
from station.views.investigation import InvestigationView

_ERRORS: Sequence[tuple[str, Unit]] = (("rms_rps", DEG_PER_H), ("max_rps", DEG_PER_H), ("coverage95", PERCENT))
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
    """Return the result of an investigation; None without one."""
    if traced is None:
        return None
    what = traced.what
    fitted = [basename(path) for path in what["recordings"]]
    verified_on = [basename(path) for path in what["verification"]]
    findings = [*verdict_lines(cast(InvestigationView, {**what, "added": []})), *what["notes"]]
    return ResidualView(
        verdict=what["verdict"],
        reason=_sentence(words(what["reason"])),
        fitted=", ".join(fitted),
        verified_on=", ".join(verified_on),
        among_them=recorded.path.name in fitted + verified_on,
        added=_added_table(what["added"]) if what["added"] else None,
        findings=[_sentence(text) for text in findings],
        pictures=[residual_picture(course, traced.spectra.get(course.gyro)) for course in traced.residuals],
        errors=_errors_table(what),
        improvement=_improvement(what.get("improvement")),
        in_sample=what["in_sample"],
    )


def _sentence(text: str) -> str:
    """Return a remark as a sentence, with a capital and a full stop."""
    text = text.strip()
    if not text:
        return ""
    stop = "" if text.endswith(".") else "."
    return f"{text[:1].upper()}{text[1:]}{stop}"


def _added_table(added: Sequence[Mapping[str, Any]]) -> Table:
    rows = [row for effect in added for row in _effect_rows(effect)]
    return table_of(["effect", "parameter", "value ± U", "probability"], "llrr", rows)


def _effect_rows(effect: Mapping[str, Any]) -> Iterator[list[Content]]:
    """Yield the parameters of an effect with their expanded uncertainties, and how probable the effect is."""
    for name, (value, sd, unit) in effect["parameters"].items():
        shown = worded(number(value), COVERAGE * number(sd), unit)
        yield [words(effect["effect"]), name, shown, probability(number(effect["probability"]))]


def _errors_table(what: InvestigationView) -> Table:
    """Return the error of each gyro before and after, and of all if there are several."""
    gyros = what["gyros"]
    rows = [_error_row(name, errors) for name, errors in gyros.items()]
    if len(gyros) > 1:
        rows.append(_error_row("all", cast(Mapping[str, Any], what)))
    return table_of(_ERROR_HEADS, "lrrrrrr", rows, length=len(gyros) + 1)


def _error_row(name: str, errors: Mapping[str, Any]) -> list[Content]:
    cells: list[Content] = [name]
    for key, unit in _ERRORS:
        cells += [known(errors["before"][key], unit), known(errors["after"][key], unit)]
    return cells


def _improvement(gain: Mapping[str, float | None] | None) -> Improvement | None:
    if not gain:
        return None
    return Improvement(ratio=known(gain["ratio"], ONE), low=known(gain["low"], ONE), high=known(gain["high"], ONE))
