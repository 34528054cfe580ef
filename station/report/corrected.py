"""The chapter on the correction: formula, numbers, Python."""

from collections.abc import Iterator, Mapping, Sequence

from estimator.compensation import OF_THE_RATE, HeldEffect
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import VARIABLES, variables_of
from estimator.effects.thermal import REFERENCE_C
from estimator.kinematics import GRAVITY_MPS2
from estimator.reference import TableReadings
from estimator.tracing.investigation import Value
from station.investigation_printed import human, words
from station.report.correction import Correction, corrections_of
from station.report.figures import DEG_PER_S, MILLISECONDS, ONE, Unit, figure, fixed, plain, typographic
from station.report.html import Content, Markup, bullets, composed, element, joined, paragraph, table
from station.report.recorded import Recorded
from station.report.snippet import snippet
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
_E = "<var>e</var>"
_T = f"(<var>T</var> − {REFERENCE_C:g} °C)"
FORMULAS: Mapping[str, str] = {
    "thermal_bias": f"<var>a</var> {_T}",
    "thermal_bias_quadratic": f"<var>a</var> {_T}<sup>2</sup>",
    "thermal_scale": f"<var>a</var> {_T} <var>u</var>",
    "thermal_gradient": "<var>a</var> d<var>T</var>/d<var>t</var>",
    "scale_asymmetry": "<var>a</var> |<var>u</var>|",
    "scale_quadratic": "<var>a</var> <var>u</var><sup>2</sup>",
    "scale_cubic": "<var>a</var> <var>u</var><sup>3</sup>",
    "g_sensitivity": "<b>a</b> · <b>f</b> / <var>g</var>",
    "warm_up": "<var>a</var> (1 − exp(−<var>t</var> / <var>τ</var>))",
    "bandwidth": "−<var>a</var> d<var>y</var>/d<var>t</var>",
    "acceleration_sensitivity": (
        "<var>a</var><sub>1</sub> <b>j</b> · d<var>ω</var>/d<var>t</var> + "
        "<var>a</var><sub>2</sub> <b>k</b> · d<var>ω</var>/d<var>t</var>"
    ),
}
"""What each effect adds to the outputs, as HTML."""
_SYMBOLS = (
    ("<var>u</var> = <b>p</b> · <var>ω</var>, found by iteration", OF_THE_RATE),
    ("<var>T</var> is the temperature of the gyros", ("thermal_bias", "thermal_bias_quadratic", "thermal_scale")),
    (f"d<var>T</var>/d<var>t</var> is taken over {SLOPE_S:g} s", ("thermal_gradient",)),
    (f"<b>f</b> is the specific force in body axes, <var>g</var> = {GRAVITY_MPS2} m/s²", ("g_sensitivity",)),
    ("<var>t</var> counts from switching on", ("warm_up",)),
    ("other rates of change are differences of two samples", ("bandwidth", "acceleration_sensitivity")),
)
"""What the letters in them mean, and where they stand."""
_WHERE = (
    "<var>y</var> are the outputs of the gyros and <var>ω</var> the rate of the body, both in rad/s. The rows "
    "<b>g</b><sub>i</sub> of <b>G</b> are the sensitivities. <b>G</b><sup>+</sup> = "
    "(<b>G</b><sup>T</sup><b>G</b>)<sup>−1</sup><b>G</b><sup>T</sup>, the least squares solution."
)
_WHERE_ONLY = (
    "<var>y</var> are the outputs of the gyros in rad/s, <var>ω</var><sub>i</sub> the rate about the true sense axis "
    "of each: these gyros do not span three axes, so the rate of the body is not known."
)


@composed
def correction(recorded: Recorded, traced: Traced | None, data_sha256: str) -> Iterator[Content]:
    """Return the correction of every device, and again with the effects that an investigation added."""
    origin = f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}"
    yield _axes(recorded)
    for one in corrections_of(recorded):
        title = f"Device {one.device}"
        yield element("h3", title)
        yield _of_device(one, f"{origin}\n{title}", "correction")
    if traced is not None and traced.added and traced.model is not None and traced.model.effects:
        for one in corrections_of(recorded, traced):
            title = f"Device {one.device} with the traced effects"
            yield element("h3", title)
            yield paragraph(
                "States and effects as the investigation estimated them together, from its own recordings: they "
                "replace the numbers above, and differ from the results of this run alone."
            )
            yield _of_device(one, f"{origin}\n{title}", "traced")


@composed
def _axes(recorded: Recorded) -> Iterator[Content]:
    """Return the nominal axes, without which the states mean nothing."""
    assert recorded.calibration is not None
    frame = "The body axes x, y and z are those of the reference data."
    if isinstance(recorded.recording.reference, TableReadings):
        frame = (
            "The body axes x, y and z are fixed to the innermost axis of the table and lie along those of its base (z "
            "up) when every axis is home. Angles and rates are positive by the right-hand rule."
        )
    rows: list[Sequence[Content]] = []
    for gyro in recorded.calibration.gyros:
        array = recorded.recording.sources[gyro.source].array
        i = array.names.index(gyro.name)
        axes = [_direction(axis[i].tolist()) for axis in (array.p, array.j, array.k)]
        rows.append([recorded.label(gyro.source, gyro.name), *axes])
    heads: list[Content] = ["gyro", Markup("sense axis <b>p</b>"), Markup("tilt axis <b>j</b>")]
    notes = Markup(
        "Components along x, y, z. The true sense axis is <b>p</b> − <var>σ</var><sub>k</sub> <b>j</b> + "
        "<var>σ</var><sub>j</sub> <b>k</b>."
    )
    yield paragraph(frame)
    yield table("Nominal axes of the gyros", [*heads, Markup("tilt axis <b>k</b>")], rows, align="lrrr", notes=notes)


def _direction(axis: Sequence[float]) -> Markup:
    return joined(part for value in axis for part in (Markup(" &ensp;"), fixed(round(value, 9) + 0.0, ONE, 5)))


@composed
def _of_device(one: Correction, origin: str, name: str) -> Iterator[Content]:
    effects = f" − {_E}" if one.held else ""
    formula = (_AXES_ONLY if one.axes_only else _G).format(effects=effects)
    yield paragraph(Markup(formula), class_="formula")
    yield paragraph(Markup(_WHERE_ONLY if one.axes_only else _WHERE))
    yield _numbers(one)
    if one.held:
        yield _effects(one)
    if one.compensation.delay_s:
        delay = plain(one.compensation.delay_s, MILLISECONDS, 4)
        yield paragraph("The stamps of the samples are late by ", delay, " ms: take that off them.")
    yield bullets(f"Not undone: {words(effect)}; {why}." for effect, why in one.not_applied.items())
    code = element("code", snippet(one, origin))
    yield element("pre", code, class_="code", data_snippet=name, data_device=one.device)


def _formula(effect: HeldEffect) -> Content:
    """Return what an effect adds to the outputs: as mathematics, or the text of its law."""
    if not effect.known.law:
        return Markup(FORMULAS[effect.name])
    terms = [element("code", term.strip()) for term in effect.known.law.split(";")]
    heads = [Markup("<var>a</var> "), *(Markup(f" + <var>a</var><sub>{n}</sub> ") for n in range(2, len(terms) + 1))]
    return joined(part for pair in zip(heads, terms, strict=True) for part in pair)


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
    heads: list[Content] = ["effect", "adds to the output", "gyro", "parameters"]
    rows: list[Sequence[Content]] = []
    for effect in one.held:
        for gyro, values in zip(one.compensation.array.names, effect.values, strict=True):
            shown: list[Content] = []
            for value, size in zip(values.tolist(), effect.known.sizes, strict=True):
                text = typographic(human(Value(value, 0.0, size.unit)))
                shown += ["; " if shown else None, figure(value, Unit(size.unit, 1.0), text)]
            rows.append([words(effect.known.called), _formula(effect), gyro, joined(shown)])
    names = {effect.name for effect in one.held}
    laws = {name for effect in one.held if effect.known.law for name in variables_of(effect.known.law)}
    note = Markup(
        "; ".join([f"{_E} is their sum", *(said for said, effects in _SYMBOLS if names & set(effects))]) + "."
    )
    if laws:
        said = ", ".join(f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}" for name in sorted(laws))
        note = joined([note, f" In laws that were constructed, {said}."])
    return table("Effects that are undone", heads, rows, align="lllr", notes=note)
