"""What was found: states with their uncertainties, the comparison with the limits, the budget, traceability."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from estimator.budget import TYPE_A, UNSEEN
from estimator.calibration import Calibration
from estimator.reference import TableReadings, TableUncertainty
from estimator.tracing.investigation import Value
from station.investigation_printed import human, words
from station.report import figures
from station.report.front import badge
from station.report.html import BLANK, Content, Markup, bullets, composed, element, grouped, joined, paragraph, table
from station.report.recorded import Recorded
from station.report.standing import Line, Standing
from station.report.traced import Traced
from station.report.unseen import Unseen

_COMBINED = "u combines the lines of the uncertainty budget in squares."
_SCATTER = "u comes from the scatter of the residual alone and holds nothing of the reference."
_NEXT_TO_NOTHING = 0.01  # ppm, deg/h, urad
_SOURCES = {
    "noise": "noise of the gyro, and what its course leaves open",
    "effects": "effects of the error model",
    UNSEEN: "undeclared effects that the motion does not show",
    "rate": "rate of the table",
    "wobble": "wobble of the table's axes",
    "orthogonality": "orthogonality of the table's axes",
    "timing": "timing of the table's readings",
}


_TYPE_B = (
    "Type B: from the standard uncertainties of the table as stated, worked out for the motion that was driven. The "
    "table's part is common to all gyros; undeclared effects are as large as the catalogue calls plausible."
)
_NO_TYPE_B = "Type B: none, since no uncertainty of the reference is stated."


@composed
def states(recorded: Recorded, found: Calibration, unseen: Unseen | None, traced: Traced | None) -> Iterator[Content]:
    """Return the states of every gyro with standard and expanded uncertainty, and what these do not cover."""
    heads: list[Content] = [
        "gyro",
        "quantity",
        "value",
        "standard uncertainty u",
        f"expanded uncertainty U = {figures.COVERAGE:g} u",
        "unit",
    ]
    groups = []
    for i, gyro in enumerate(found.gyros):
        rows: list[Sequence[Content]] = []
        for s, (symbol, unit) in enumerate(figures.STATES):
            value, sd = float(gyro.states[s]), float(gyro.sd[s])
            where = f"calibration/sd[{i},{s}]"
            shown, expanded = figures.with_uncertainty(
                value, figures.COVERAGE * sd, unit, (f"calibration/states[{i},{s}]", where)
            )
            standard = figures.figure(sd, unit, figures.rounded(sd * unit.factor, sd * unit.factor), where)
            rows.append([symbol, shown, standard, expanded, unit.name])
        groups.append((recorded.label(gyro.source, gyro.name), rows))
    notes = (
        f"U is the standard uncertainty u times a coverage factor of {figures.COVERAGE:g}, which for a normal "
        "distribution is a coverage probability of about 95 %. "
        f"{_COMBINED if any(gyro.budget for gyro in found.gyros) else _SCATTER} U is that of the time of measurement "
        "and allows for no drift since, no transport and no other temperature. The four states of a gyro are "
        "correlated: their covariances are in the recording (calibration/covariance)."
    )
    k, bias, sigma_j, sigma_k = (symbol for symbol, _ in figures.STATES)
    yield paragraph(
        Markup(
            f"Of each gyro: scale factor error {k}, bias {bias}, and the misalignments {sigma_j} and {sigma_k} of its "
            f"sense axis, as the correction below defines them. A positive {k} makes the output too small. A positive "
            f"{bias} lowers it: without rotation the output is −{bias}, so {bias} is to be added."
        )
    )
    yield grouped("Results of the calibration", heads, groups, align="llrrrl", notes=notes)
    if any(gyro.effects for gyro in found.gyros):
        yield _effects(recorded, found)
    yield from _cautions(recorded, found, unseen, traced)
    yield bullets(found.notes)


def _cautions(
    recorded: Recorded, found: Calibration, unseen: Unseen | None, traced: Traced | None
) -> Iterator[Content]:
    """Return what the uncertainties do not cover: effects that the run does not show, and those that were traced."""
    hidden = unseen.unnoticed if unseen is not None else []
    if unseen is not None and hidden:
        yield paragraph(
            "The uncertainties hold for the error model of this calibration. They do not cover effects that the "
            f"run could not show: {', '.join(map(unseen.words, hidden))} (see “What this run could not see”).",
            class_="caution",
        )
    if traced is not None and traced.added and not found.model:
        labelled = [(gyro, recorded.label(gyro.source, gyro.name)) for gyro in found.gyros]
        moved = [
            np.abs(traced.states[traced.names.index(label)] - gyro.states) / gyro.sd
            for gyro, label in labelled
            if label in traced.names
        ]
        added = dict.fromkeys(str(effect["effect"]) for effect in traced.what["added"])
        yield paragraph(
            f"An investigation added {', '.join(map(words, added))} to the model. With it the states are other by "
            "up to ",
            figures.plain(float(np.max(moved, initial=0.0)), figures.ONE, 2),
            " u: see the correction with the traced effects.",
            class_="caution",
        )


def _effects(recorded: Recorded, found: Calibration) -> Markup:
    """Return the effects of the error model that were estimated beside the states."""
    rows: list[Sequence[Content]] = []
    for column, effect in enumerate(found.gyros[0].effects):
        for i, gyro in enumerate(found.gyros[:1] if effect.shared else found.gyros):
            value = gyro.effects[column]
            expanded = figures.COVERAGE * value.sd
            text = figures.typographic(human(Value(value.value, expanded, value.unit)))
            who = "all gyros" if effect.shared else recorded.label(gyro.source, gyro.name)
            shown = figures.figure(
                value.value, figures.Unit(value.unit, 1.0), text, f"calibration/effects[{i},{column}]"
            )
            rows.append([f"{words(effect.effect)}, {effect.parameter}", who, shown])
    heads = ("effect", "gyro", "value ± U")
    return table("Effects estimated beside the states", heads, rows, align="llr")


@composed
def compliance(standing: Standing) -> Iterator[Content]:
    """Return each limit beside what was found, and the decision."""
    if not standing.lines:
        yield paragraph("The recording states no limits: nothing was judged.")
        return
    quantities: dict[tuple[str, str, str], dict[bool, Line]] = {}
    for line in standing.lines:
        quantities.setdefault((line.gyro, line.what, line.note), {})[line.of_u] = line
    groups: dict[str, list[Sequence[Content]]] = {}
    for (gyro, what, _), lines in quantities.items():
        cells = [cell for of_u in (False, True) for cell in _line(lines.get(of_u))]
        groups.setdefault(gyro, []).append([Markup(what), next(iter(lines.values())).unit.name, *cells])
    broken = [line for line in standing.lines if not line.within]
    count = len(standing.lines)
    said = f"{len(broken)} of {count} limits are not met." if broken else f"All {count} limits are met."
    rule = (
        "Decision rule: simple acceptance. Each value is compared with its limit as it stands; its uncertainty is not "
        "added to it, but has a limit of its own, so a value at its limit is beyond it with a probability of "
        "one half. The limits are those of the bench file that the recording carries. –: no limit."
    )
    heads: list[Content] = ["gyro", "quantity", "unit", "found", "limit", "verdict"]
    heads += [Markup("<var>u</var> found"), Markup("limit of <var>u</var>"), "verdict"]
    yield paragraph(said)
    yield grouped("Limits", heads, list(groups.items()), align="lllrrlrrl", notes=rule)


def _line(line: Line | None) -> tuple[Content, Content, Content]:
    """Return what was found, the limit, and the verdict."""
    if line is None:
        return "–", "–", None
    verdict = badge("PASS" if line.within else "FAIL")
    if line.note:
        return f"not estimated: {line.note}", "estimated", verdict
    found = figures.plain(line.value, line.unit, 4, line.source)
    high = figures.stated(line.high, line.unit) if math.isfinite(line.high) else Markup("any")
    if line.low == -line.high:
        return found, joined(["± ", high]), verdict
    if line.low == 0.0:
        return found, joined(["≤ ", high]), verdict
    return found, joined([figures.stated(line.low, line.unit), " to ", high]), verdict


def budget(recorded: Recorded, found: Calibration) -> Markup:
    """Return the lines of the budget of every gyro, which add in squares to its standard uncertainties."""
    if not any(gyro.budget for gyro in found.gyros):
        return paragraph(
            "This calibration keeps no budget: against a reference of this kind the uncertainties come from the "
            "scatter of the residual alone."
        )
    groups: list[tuple[Content, Sequence[Sequence[Content]]]] = []
    for i, gyro in enumerate(found.gyros):
        rows: list[Sequence[Content]] = []
        for n, line in enumerate(gyro.budget):
            kind = "A" if line.name in TYPE_A else "B"
            cells = [
                _share(float(u), unit, f"calibration/budget[{i},{n},{s}]")
                for s, (u, (_, unit)) in enumerate(zip(line.u, figures.STATES, strict=True))
            ]
            rows.append([_SOURCES.get(line.name, line.name), kind, *cells])
        total = [
            figures.plain(float(sd), unit, 2, f"calibration/sd[{i},{s}]")
            for s, (sd, (_, unit)) in enumerate(zip(gyro.sd, figures.STATES, strict=True))
        ]
        rows.append([element("strong", "combined standard uncertainty"), None, *total])
        groups.append((recorded.label(gyro.source, gyro.name), rows))
    heads: list[Content] = ["gyro", "source", "type"]
    heads += [joined([Markup("<var>u</var>("), symbol, Markup(f"), {unit.name}")]) for symbol, unit in figures.STATES]
    notes = (
        "Standard uncertainties, normal distributions; they add in squares. Type A: evaluated from the scatter of the "
        "data, bias instability and random walk included as found in them. "
    )
    notes += _TYPE_B if any(line.name not in TYPE_A for gyro in found.gyros for line in gyro.budget) else _NO_TYPE_B
    return grouped("Uncertainty budget", heads, groups, align="lllrrrr", notes=notes)


def _share(u: float, unit: figures.Unit, source: str) -> Markup:
    """Return a line of the budget; what is next to nothing is said to be so."""
    return (
        figures.figure(u, unit, "< 0.01", source)
        if u * unit.factor < _NEXT_TO_NOTHING
        else figures.plain(u, unit, 2, source)
    )


@composed
def traceability(recorded: Recorded) -> Iterator[Content]:
    """Return what is stated of the reference, and nothing beyond it."""
    reference = recorded.recording.reference
    if not isinstance(reference, TableReadings):
        yield paragraph(
            "The reference was measured elsewhere. The recording states no uncertainty of it, and nothing on which "
            "traceability to a standard could be based."
        )
        return
    if reference.uncertainty is None:
        yield paragraph(
            "The bench file states no uncertainty of the table. The uncertainties of this document hold nothing of "
            "it, and nothing here is a basis for traceability to a standard."
        )
    else:
        yield paragraph(
            "The bench file that the recording carries states these standard uncertainties of the table; the "
            "uncertainty budget rests on them. The recording holds no evidence of the table's own calibration."
        )
        yield _stated(reference.uncertainty)
    yield paragraph("Table, certificate of its calibration, and date, to be entered by the laboratory: ", BLANK)


def _stated(uncertainty: TableUncertainty) -> Markup:
    lines = (
        ("its rate (time base), relative", uncertainty.rate, figures.PPM, "u_rate"),
        ("wobble of an axis", uncertainty.wobble_rad, figures.ARCSEC, "u_wobble_rad"),
        (
            "orthogonality of each axis to the others",
            uncertainty.orthogonality_rad,
            figures.ARCSEC,
            "u_orthogonality_rad",
        ),
        ("timing of its readings", uncertainty.timing_s, figures.MICROSECONDS, "u_timing_s"),
    )
    rows = [[name, figures.plain(value, unit, 3, f"table@{key}"), unit.name] for name, value, unit, key in lines]
    return table("Standard uncertainties of the table, as stated", ("quantity", "u", "unit"), rows, align="lrl")
