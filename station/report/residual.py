"""The chapter on the residual: what an investigation traced in it, and the error before and after."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from estimator.tracing.investigation import Value
from station.investigation_printed import human, probability, words
from station.report.figures import COVERAGE, DEG_PER_H, ONE, PERCENT, Unit, figure, plain, typographic
from station.report.html import Content, Markup, bullets, composed, element, paragraph, table
from station.report.pictures import residual_picture
from station.report.recorded import Recorded
from station.report.traced import Traced


@composed
def residual(recorded: Recorded, traced: Traced | None) -> Iterator[Content]:
    """Return verdict, traced effects and pictures of an investigation, or that there was none."""
    if traced is None:
        yield paragraph(
            "No investigation of the residual was given: effects that the four states lack were not looked for. ",
            element("code", "station investigate"),
            " looks for them.",
        )
        return
    what = traced.what
    yield paragraph("Verdict: ", element("strong", str(what["verdict"])), f". {_sentence(words(what['reason']))}")
    yield _recordings(recorded, what)
    if what["added"]:
        yield _added(what["added"])
    yield bullets(_said(what))
    yield from (residual_picture(r, traced.spectra.get(r.gyro)) for r in traced.residuals)


@composed
def verification(traced: Traced | None) -> Iterator[Content]:
    """Return the error of the compensated rate before and after."""
    if traced is None:
        yield paragraph("No verification was given.")
        return
    what = traced.what
    rows: list[Sequence[Content]] = [_errors(name, own["before"], own["after"]) for name, own in what["gyros"].items()]
    if len(rows) > 1:
        rows.append(_errors("all", what["before"], what["after"]))
    where = "cross-validated by step, in-sample" if what["in_sample"] else "verification run"
    heads = (
        "gyro",
        "rms before, °/h",
        "rms after, °/h",
        "largest before, °/h",
        "largest after, °/h",
        "within 95 % before, %",
        "within 95 % after, %",
    )
    notes = (
        "Before: corrected with the four states alone; after: with the traced effects, too. Rms over rests, ramps and "
        "steady rates, noise taken off, at least the doubt of the model itself; the largest holds noise. Within 95 %: "
        "share of the 95 % intervals that hold the measured error, where the two models differ; 95 % if they are true."
    )
    yield table(f"Error of the compensated rate before and after ({where})", heads, rows, align="lrrrrrr", notes=notes)
    gain = what.get("improvement")
    if gain:
        ratio, low, high = (_figure(gain[key], ONE) for key in ("ratio", "low", "high"))
        said = f"The rms error became {ratio} times smaller (95 % interval: {low} to {high}, block bootstrap)."
        yield paragraph(Markup(said))
    if what["in_sample"]:
        yield paragraph(
            "No verification run was given: these figures come from the recordings that were fitted, by "
            "cross-validation over their steps, and say less than a run of its own would.",
            class_="caution",
        )


def _recordings(recorded: Recorded, what: Mapping[str, Any]) -> Markup:
    fitted, judging = (", ".join(Path(name).name for name in what[key]) for key in ("recordings", "verification"))
    names = {Path(name).name for key in ("recordings", "verification") for name in what[key]}
    parts: list[Content] = [f"Fitted: {fitted}. Verified on: {judging or 'no run of its own'}."]
    if recorded.path.name not in names:
        parts.append(" The recording of this document is not among them.")
    return paragraph(*parts)


def _added(added: Sequence[Mapping[str, Any]]) -> Markup:
    rows: list[Sequence[Content]] = []
    for effect in added:
        for name, (value, sd, unit) in effect["parameters"].items():
            shown = typographic(human(Value(_number(value), COVERAGE * _number(sd), unit)))
            text = figure(_number(value), Unit(unit, 1.0), shown)
            rows.append([words(effect["effect"]), name, text, probability(_number(effect["probability"]))])
    heads = ("effect", "parameter", "value ± U", "probability")
    return table("Effects that were traced and added to the model", heads, rows, align="llrr")


def _said(what: Mapping[str, Any]) -> list[str]:
    said = []
    for rivals in what["rivals"]:
        how = "These recordings cannot tell apart" if len(rivals) > 1 else "These recordings do not prove"
        said.append(f"{how}: {' or '.join(map(words, rivals))}.")
    unexplained = what["unexplained"]
    if unexplained:
        said.append(
            f"Unexplained: {unexplained['share']:.0%} of the power of what is left depends on "
            f"{unexplained['depends_on']}, and no effect of the catalogue explains it."
        )
    return [*said, *(_sentence(note) for note in what["notes"])]


def _errors(name: str, before: Mapping[str, Any], after: Mapping[str, Any]) -> list[Content]:
    cells: list[Content] = [name]
    for key, unit in (("rms_rps", DEG_PER_H), ("max_rps", DEG_PER_H), ("coverage95", PERCENT)):
        for errors in (before, after):
            cells.append(_figure(errors[key], unit))
    return cells


def _figure(value: float | None, unit: Unit) -> Markup:
    return plain(_number(value), unit)


def _number(value: float | None) -> float:
    """Return a number of JSON, in which null stands for what is not known."""
    return float("nan") if value is None else float(value)


def _sentence(text: str) -> str:
    text = text.strip()
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}" if text else ""
