"""The chapter on the correction: formula, numbers, Python."""

from __future__ import annotations

from collections.abc import Sequence

from estimator.tracing.investigation import Value
from station.investigation_printed import human, words
from station.report.correction import TERMS, Correction, corrections_of, snippet
from station.report.figures import DEG_PER_S, MILLISECONDS, ONE, Unit, figure, plain, typographic
from station.report.html import Content, Markup, bullets, element, joined, paragraph, table
from station.report.recorded import Recorded
from station.report.traced import Traced

_G = (
    "<var>ω</var> = <b>G</b><sup>+</sup> (<var>y</var> + <var>b</var>{effects}), &ensp; "
    "<b>g</b><sub>i</sub> = (1 − <var>k</var><sub>i</sub>) (<b>p</b><sub>i</sub> − <var>σ</var><sub>k,i</sub> "
    "<b>j</b><sub>i</sub> + <var>σ</var><sub>j,i</sub> <b>k</b><sub>i</sub>)"
)
_AXES_ONLY = (
    "<var>ω</var><sub>i</sub> = (<var>y</var><sub>i</sub> + <var>b</var><sub>i</sub>{effects}) / "
    "(1 − <var>k</var><sub>i</sub>)"
)
_EFFECTS = " − <var>e</var>"
_WHERE = (
    "<var>y</var> are the outputs of the gyros and <var>ω</var> the rate of the body, both in rad/s. The rows "
    "<b>g</b><sub>i</sub> of <b>G</b> are the sensitivities; <b>p</b>, <b>j</b> and <b>k</b> are the nominal sense "
    "axis and the tilt axes of a gyro in body axes, orthonormal. <b>G</b><sup>+</sup> = "
    "(<b>G</b><sup>T</sup><b>G</b>)<sup>−1</sup><b>G</b><sup>T</sup>, the least squares solution."
)
_WHERE_ONLY = (
    "<var>y</var> are the outputs of the gyros in rad/s, <var>ω</var><sub>i</sub> the rate about the true sense axis "
    "of each: these gyros do not span three axes, so the rate of the body is not known."
)


def correction(recorded: Recorded, traced: Traced | None, data_sha256: str) -> Markup:
    """Return the correction of every device, and again with the effects that an investigation added."""
    origin = f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}"
    parts: list[Content] = []
    for one in corrections_of(recorded):
        title = f"Device {one.device}"
        parts += [element("h3", title), _of_device(one, f"{origin}\n{title}", "correction")]
    if traced is not None and traced.added and traced.model is not None and traced.model.effects:
        for one in corrections_of(recorded, traced):
            title = f"Device {one.device} with the traced effects"
            parts += [
                element("h3", title),
                paragraph(
                    "States and effects as the investigation estimated them together, from its own recordings: they "
                    "replace the numbers above, and differ from the results of this run alone."
                ),
                _of_device(one, f"{origin}\n{title}", "traced"),
            ]
    return joined(parts)


def _of_device(one: Correction, origin: str, name: str) -> Markup:
    effects = _EFFECTS if one.effects else ""
    formula = (_AXES_ONLY if one.axes_only else _G).format(effects=effects)
    parts: list[Content] = [
        paragraph(Markup(formula), class_="formula"),
        paragraph(Markup(_WHERE_ONLY if one.axes_only else _WHERE)),
        _numbers(one),
    ]
    if one.effects:
        parts.append(_effects(one))
    if one.compensation.delay_s:
        parts.append(
            paragraph(
                "The stamps of the samples are late by ",
                plain(one.compensation.delay_s, MILLISECONDS, 4),
                " ms: take that off them.",
            )
        )
    parts.append(bullets(f"Not in the code below: {words(effect)}; {why}." for effect, why in one.not_applied.items()))
    code = element("code", snippet(one, origin))
    parts.append(element("pre", code, class_="code", data_snippet=name, data_device=one.device))
    return joined(parts)


def _numbers(one: Correction) -> Markup:
    compensation = one.compensation
    heads: list[Content] = ["gyro", joined([Markup("<var>b</var>, °/s")])]
    heads += [Markup("1 − <var>k</var>")] if one.axes_only else [Markup(f"<var>g</var><sub>{a}</sub>") for a in "xyz"]
    rows: list[Sequence[Content]] = []
    for i, gyro in enumerate(compensation.array.names):
        gains = [1 - compensation.states[i, 0]] if one.axes_only else compensation.sensitivity[i].tolist()
        cells = [figure(float(g), ONE, f"{g:.7f}".replace("-", "−")) for g in gains]
        rows.append([gyro, plain(float(compensation.bias_rps[i]), DEG_PER_S, 6), *cells])
    return table("Numbers of the correction", heads, rows, align="l" + "r" * (len(heads) - 1))


def _effects(one: Correction) -> Markup:
    held = [h for h in one.compensation.effects if h.known.called in one.effects]
    heads: list[Content] = ["effect", "adds to the output", "gyro", "parameters"]
    rows: list[Sequence[Content]] = []
    for effect in held:
        for gyro, values in zip(one.compensation.array.names, effect.values, strict=True):
            shown: list[Content] = []
            for value, size in zip(values.tolist(), effect.known.sizes, strict=True):
                text = typographic(human(Value(value, 0.0, size.unit)))
                shown += ["; " if shown else None, figure(value, Unit(size.unit, 1.0), text)]
            rows.append([words(effect.known.called), Markup(TERMS[effect.name].formula), gyro, joined(shown)])
    note = Markup("<var>e</var> is their sum; <var>u</var> = <b>p</b> · <var>ω</var>, found by iteration.")
    return table("Effects that are undone", heads, rows, align="lllr", notes=note)
