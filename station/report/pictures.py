"""Pictures of a report as SVG, the same bytes for the same data, and of a residual with --plot."""

import base64
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from drivers.types import Floats
from estimator.effects.constructed import readable as words
from estimator.observations.allan.sensor import SensorNoise
from estimator.observations.allan.spectrum import allan_variances
from estimator.tracing.investigation import Investigation, ResidualView
from station.errors import UsageError
from station.report.figures import ARW, DEG_PER_H, DEG_PER_S, Unit, typographic
from station.report.picture_words import (
    LastEstimate,
    PictureWords,
    allan_words,
    convergence_words,
    nis_words,
    rates_words,
    residual_words,
)
from station.report.recorded import Course, Recorded
from station.views.investigation import Spectra, judged_spectra, judged_views
from station.views.noise import noise_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


WIDTH_IN = 6.85  # of the text on A4
BLUE, ORANGE, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#777777"
"""Okabe and Ito's colours, which the colour-blind tell apart; lines differ in style, too."""
_STYLES = ((BLUE, "-"), (ORANGE, "--"), (GREEN, "-."), ("#CC79A7", ":"), ("#56B4E9", "-"), ("#E69F00", "--"))
_SYMBOLS = ("k", "b", "σⱼ", "σₖ")
_RIGHT_IN = 0.06
_MOST_POINTS = 400  # of a curve as wide as the text: more are not seen on paper
_FEW_POINTS = 200  # of one in a small panel
_FONTS = "'Report Sans', Arial, 'Liberation Sans', 'DejaVu Sans', sans-serif"
_NOISE = "#e0e0e0"
_DPI = 200
_PIXELS_PER_IN = 96
_STYLE = Path(__file__).with_name("report.mplstyle")


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure: an image as a data URI, its alternative text, and a caption."""

    source: str
    alternative: str
    caption: str
    size_in: tuple[float, float]

    @property
    def width_px(self) -> int:
        """Width in pixels of CSS."""
        return round(_PIXELS_PER_IN * self.size_in[0])

    @property
    def height_px(self) -> int:
        """Height in pixels of CSS."""
        return round(_PIXELS_PER_IN * self.size_in[1])


def rates_picture(names: Sequence[str], t_s: Floats, rate_rps: Floats, quantity: str) -> Picture:
    """Return a picture of rates (N, axes) over ``t_s`` (N,), a panel for each name; ``quantity`` says what they are."""
    with _drawn((WIDTH_IN, 0.36 * len(names) + 0.42), len(names), 1, between=0.12) as (figure, panels):
        for column, (name, panel) in enumerate(zip(names, panels[:, 0], strict=True)):
            at, shown = _thinned(t_s, rate_rps[:, column] * DEG_PER_S.factor)
            panel.axhline(0, color=GREY, lw=0.5)
            panel.plot(at, shown, color=BLUE)
            panel.set_ylabel(f"{name}, °/s")
            panel.margins(x=0, y=0.15)
        for panel in panels[:-1, 0]:  # the numbers of time stand below the last
            panel.spines["bottom"].set_visible(False)
            panel.tick_params(bottom=False)
        panels[-1, 0].set_xlabel("time since the script began, s")
        of_each = zip(names, (rate_rps * DEG_PER_S.factor).T, strict=True)
        largest = [f"{name} {np.nanmin(r):.4g} to {np.nanmax(r):.4g}" for name, r in of_each]
        return _done(figure, rates_words(quantity, float(t_s[-1] - t_s[0]), largest))


def convergence_pictures(recorded: Recorded, states: Sequence[tuple[Markup, Unit]]) -> list[Picture]:
    """Return a picture per gyro of its states and sigmas over time, a panel per state; grey lines where steps begin.

    ``states`` has symbol and unit of each state. Sources without live estimates have no pictures.
    """
    turns_s = [(step.start_ns - recorded.start_ns) * 1e-9 for step in recorded.steps]
    return [
        _convergence_picture(recorded.label(source, name), course, i, recorded.start_ns, turns_s, states)
        for source, course in recorded.courses.items()
        for i, name in enumerate(recorded.recording.sources[source].array.names)
        if len(course.t_ns)
    ]


def _convergence_picture(
    gyro: str,
    course: Course,
    channel: int,
    start_ns: int,
    turns_s: Sequence[float],
    states: Sequence[tuple[Markup, Unit]],
) -> Picture:
    """Return the picture of a gyro's four states and sigmas over time in s since ``start_ns``, one panel each.

    ``gyro`` is its label, ``channel`` its place in ``course``, which is not empty. ``turns_s`` are the instants of grey
    lines, where steps begin; ``states`` has symbol and unit of each state, of which the units are drawn. Long courses
    are thinned, but their last estimate stays.
    """
    t_s = np.asarray((course.t_ns - start_ns) * 1e-9, dtype=np.float64)
    each = slice((len(t_s) - 1) % _every(t_s), None, _every(t_s))  # the last among them
    with _drawn((WIDTH_IN, 0.95), 1, 4, left=0.42, bottom=0.2, top=0.2) as (figure, panels):
        for s, (panel, symbol) in enumerate(zip(panels[0], _SYMBOLS, strict=True)):
            unit = states[s][1]
            value, sd = course.states[each, channel, s] * unit.factor, course.sd[each, channel, s] * unit.factor
            for at in turns_s:
                panel.axvline(at, color="#c8c8c8", lw=0.4, zorder=0)
            panel.fill_between(t_s[each], value - sd, value + sd, color=BLUE, alpha=0.25, lw=0)
            panel.plot(t_s[each], value, color=BLUE)
            _close_up(panel, value, sd)
            panel.locator_params(nbins=4)  # more labels would not fit, and each costs time
            panel.set_title(f"{symbol}, {unit.name}")
            panel.margins(x=0)
        return _done(figure, convergence_words(gyro, _last_estimates(course, channel, states)))


def _last_estimates(course: Course, channel: int, states: Sequence[tuple[Markup, Unit]]) -> list[LastEstimate]:
    """Return the last estimate of each state of a gyro, in the units of ``states``."""
    last = zip(states, course.states[-1, channel], course.sd[-1, channel], strict=True)
    return [
        LastEstimate(value=float(value) * unit.factor, sd=float(sd) * unit.factor, unit=unit.name)
        for (_, unit), value, sd in last
    ]


def nis_picture(recorded: Recorded) -> Picture | None:
    """Return a picture of the NIS per degree of freedom of each source, in at most 119 means; None if none is stored.

    Sources without NIS are left out. A band shows where 95 % of the means would lie if all sigmas were right.
    """
    courses = [(name, course) for name, course in recorded.courses.items() if len(course.nis)]
    if not courses:
        return None
    columns = min(len(courses) + 1, 6)
    bottom = 0.4 + 0.15 * -(-(len(courses) + 1) // columns)
    with _drawn((WIDTH_IN, 0.8 + bottom), 1, 1, bottom=bottom) as (figure, panels):
        panel = panels[0, 0]
        means = []
        for number, (name, course) in enumerate(courses):
            t_s = (course.nis_t_ns - recorded.start_ns) * 1e-9
            rows = max(len(t_s) // 60, 1)
            edges = np.arange(0, len(t_s) - rows + 1, rows)
            dof = np.add.reduceat(course.dof, edges)
            nis = np.add.reduceat(course.nis, edges) / np.maximum(dof, 1)
            colour, style = _STYLES[number % len(_STYLES)]
            panel.plot(t_s[edges], nis, style, color=colour, label=name)
            means.append((name, float(course.nis.sum() / max(course.dof.sum(), 1)), float(np.median(dof))))
        # Of a sum of d squares of standard normal values the mean scatters by sqrt(2 / d).
        half = 1.96 * np.sqrt(2 / max(min(d for _, _, d in means), 1))
        panel.axhspan(1 - half, 1 + half, color="#e9e9e9", lw=0, zorder=0, label="95 % of the means, if all is right")
        panel.set_xlabel("time since the script began, s")
        panel.set_ylabel("NIS per dof")
        panel.margins(x=0)
        panel.set_ylim(bottom=0)
        figure.legend(loc="lower center", ncols=columns, frameon=False)
        return _done(figure, nis_words([f"{name} {mean:.3f}" for name, mean, _ in means]))


def allan_picture(recorded: Recorded) -> Picture | None:
    """Return a picture of the gyros' Allan deviations at rest, with intervals if stored; None without deviations."""
    if recorded.rest is None:
        return None
    names, rest = recorded.labels, recorded.rest
    with _drawn((WIDTH_IN / 2, 1.7), 1, 1) as (figure, panels):
        panel = panels[0, 0]
        for number, name in enumerate(names):
            band = None
            if rest.low_rps is not None and rest.high_rps is not None:
                band = rest.low_rps[number], rest.high_rps[number]
            _draw_allan(panel, number, name, rest.tau_s[number], rest.deviation_rps[number], band, DEG_PER_H.factor)
        panel.set_ylabel("Allan deviation, °/h")
        _finish_allan(panel, len(names))
        lowest = [
            f"{name} {np.nanmin(d) * DEG_PER_H.factor:.2g}" for name, d in zip(names, rest.deviation_rps, strict=True)
        ]
        return _done(figure, allan_words(lowest))


def draw_noise(path: Path, noises: Mapping[str, Sequence[Sequence[SensorNoise]]]) -> None:
    """Draw Allan deviations of sensors at rest with intervals and the fit of N, B and K, into a file, by its suffix.

    ``noises`` are by source and kind of sensor; each kind of a source has a panel. An existing file is overwritten.
    UsageError if the file cannot be written.
    """
    kinds = [(source, kind) for source, of_source in noises.items() for kind in of_source]
    with _drawn((WIDTH_IN, 3.3 * len(kinds)), len(kinds), 1, top=0.3, between=0.7) as (figure, panels):
        for panel, (source, kind) in zip(panels[:, 0], kinds, strict=True):
            unit, factor = noise_unit(kind[0].unit, 1)
            for number, noise in enumerate(kind):
                curve = noise.curve
                band = curve.low, curve.high
                _draw_allan(panel, number, noise.name, curve.tau_s, curve.deviation, band, factor)
                fitted = np.sqrt(allan_variances(curve.tau_s) @ noise.terms.values**2)
                holds = curve.tau_s >= noise.terms.shortest_s
                panel.loglog(curve.tau_s[holds], fitted[holds] * factor, ":", color="black", lw=0.7)
            panel.set_title(f"{source}: overlapping Allan deviation, 95 % intervals; dotted: N, B and K", fontsize=8)
            panel.set_ylabel(typographic(unit))
            panel.tick_params(labelbottom=True)
            _finish_allan(panel, len(kind))
        try:
            figure.savefig(path, dpi=_DPI)
        except OSError as error:
            raise UsageError(f"--plot {path} cannot be written: {error}") from None


def _draw_allan(
    panel: "Axes",
    number: int,
    name: str,
    tau_s: Floats,
    deviation: Floats,
    band: tuple[Floats, Floats] | None,
    factor: float,
) -> None:
    """Draw an Allan deviation (t,) and the ends (t,) of its ``band``, times ``factor``, in style ``number``."""
    colour, style = _STYLES[number % len(_STYLES)]
    if band is not None:
        panel.fill_between(tau_s, band[0] * factor, band[1] * factor, color=colour, alpha=0.15, lw=0)
    panel.loglog(tau_s, deviation * factor, style, color=colour, label=name)


def _finish_allan(panel: "Axes", sensors: int) -> None:
    panel.set_xlabel("averaging time, s")
    _plain_decades(panel)
    panel.legend(frameon=False, ncols=1 + sensors // 9)


def residual_picture(view: ResidualView, spectra: Spectra | None) -> Picture:
    """Return a picture of a gyro's residual before and after: over time, over the rate, and its spectrum if known."""
    columns = 3 if spectra is not None else 2
    with _drawn((WIDTH_IN, 1.75), 1, columns, bottom=0.55, widths=[1.9, 1, 1][:columns]) as (figure, panels):
        _draw(panels[0], view, spectra)
        figure.legend(loc="lower center", ncols=4, frameon=False)
        described = residual_words(
            view.gyro,
            view.run,
            with_spectrum=spectra is not None,
            before_dph=_rms_dph(view.before_rps),
            after_dph=_rms_dph(view.after_rps),
        )
        return _done(figure, described)


def _rms_dph(residual_rps: Floats) -> float:
    return float(np.sqrt(np.mean(residual_rps**2))) * DEG_PER_H.factor


def draw_investigation(path: Path, investigation: Investigation) -> None:
    """Draw each gyro's residual before and after into a file: over time, against rate and temperature, as a spectrum.

    Temperature and spectrum have no panels if no gyro has them. The title names the verification run, or else the
    first recording, and the finding. An existing file is overwritten. UsageError if nothing can be drawn or written.
    """
    views, spectra = judged_views(investigation.views), judged_spectra(investigation)
    if not views:
        raise UsageError("--plot: nothing to draw, since the investigation stored no residuals")
    warm = any(view.temperature_c is not None for view in views)
    widths = [1.9, *[1] * (1 + warm + bool(spectra))]
    size = WIDTH_IN + 1.8 * warm, 1.3 * len(views) + 0.8
    with _drawn(size, len(views), len(widths), bottom=0.55, top=0.3, widths=widths) as (figure, panels):
        for row, view in zip(panels, views, strict=True):
            if spectra:
                row[-1].sharey(panels[0, -1])
            _draw(row, view, spectra.get(view.gyro), warm=warm)
            row[0].set_ylabel(f"{view.gyro}, °/h")
        for panel in panels[:-1].ravel():
            panel.set_xlabel("")
        effects = ", ".join(words(added.effect) for added in investigation.added)
        kind = "verification" if views[0].verification else "in-sample"
        verdict = f"{investigation.finding}: {effects}" if effects else str(investigation.finding)
        figure.suptitle(f"Error of the compensated rate, {kind} run {views[0].run} ({verdict})", fontsize=8)
        labelled = (panel.get_legend_handles_labels()[::-1] for panel in panels[0])
        legend = {label: line for labels, lines in labelled for label, line in zip(labels, lines, strict=True)}
        figure.legend(legend.values(), legend, loc="lower center", ncols=4, frameon=False)
        try:
            figure.savefig(path, dpi=_DPI)
        except OSError as error:
            raise UsageError(f"--plot {path} cannot be written: {error}") from None


def _draw(row: "Sequence[Axes]", view: ResidualView, spectra: Spectra | None, *, warm: bool = False) -> None:
    """Draw a gyro's residual before and after into panels: over time, rate, with ``warm`` temperature, and as spectra.

    ``row`` has all of these, and the noise in each. Over time it is means. Unknown temperatures leave an empty panel.
    """
    over_time, *beside = row
    both = (("before", ORANGE, "x", view.before_rps), ("after", BLUE, "o", view.after_rps))
    since = view.t_s - view.t_s[0]
    noise = 2 * view.noise_rps * DEG_PER_H.factor
    for label, colour, _, values in both:
        at, shown = _means(since, values * DEG_PER_H.factor)
        over_time.plot(at, shown, color=colour, label=label, lw=1.6 if label == "before" else 0.6)
    band = noise * np.sqrt(len(at) / len(since))
    over_time.axhspan(-band, band, color=_NOISE, lw=0, zorder=0, label="± 2 sigma of the noise")
    over_time.set_xlabel("time, s")
    over_time.set_ylabel("residual, °/h")
    over_time.margins(x=0)
    over = [(view.rate_rps * DEG_PER_S.factor, "rate about the sense axis, °/s")]
    if warm:
        over.append((np.full_like(since, np.nan) if view.temperature_c is None else view.temperature_c, "°C"))
    each = slice(None, None, _every(since))  # over many rows a scatter is as plain with some of them
    for panel, (x, label) in zip(beside, over, strict=False):
        for _, colour, mark, values in both:
            y = values[each] * DEG_PER_H.factor
            panel.plot(x[each], y, mark, ms=3 if mark == "x" else 1.2, mew=0.4, mfc="none", color=colour)
        panel.axhspan(-noise, noise, color=_NOISE, lw=0, zorder=0)
        panel.set_xlabel(label)
        panel.sharey(over_time)
    if spectra is not None:
        _draw_spectra(row[-1], spectra)


def _draw_spectra(panel: "Axes", spectra: Spectra) -> None:
    """Draw the roots of one-sided densities before, after and of the noise model, in °/h/√Hz; a legend has the last."""
    for colour, style, density, label in (
        (ORANGE, "-", spectra.before, "_before"),
        (BLUE, "-", spectra.after, "_after"),
        (GREY, "--", spectra.noise, "noise model"),
    ):
        panel.loglog(spectra.frequency_hz, np.sqrt(density) * ARW.factor * 3600, style, color=colour, label=label)
    _plain_decades(panel)
    panel.set_xlabel("frequency, Hz")
    panel.set_ylabel("°/h/√Hz")


def _plain_decades(panel: "Axes") -> None:
    """Label logarithmic axes at each decade, and those of two decades or less also at 2 and 5."""
    from matplotlib.ticker import LogLocator

    for axis in (panel.xaxis, panel.yaxis):
        low, high = axis.get_view_interval()
        axis.set_major_locator(LogLocator(subs=(1,) if high > 100 * low else (1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")


@contextmanager
def _drawn(
    size: tuple[float, float],
    rows: int,
    columns: int,
    *,
    left: float = 0.5,
    bottom: float = 0.34,
    top: float = 0.08,
    between: float = 0.5,
    widths: Sequence[float] | None = None,
) -> "Iterator[tuple[Figure, NDArray[np.object_]]]":
    """Give a figure of ``size`` (inches) with panels (rows, columns), in the style of the report.

    Margins and the space ``between`` panels are in inches: letting matplotlib find them doubles the time. ``widths``
    are the relative widths of the columns. Panels of one column share their x axis.
    """
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context():
        mpl.rcdefaults()  # not those of a matplotlibrc in the working folder
        mpl.rc_file(_STYLE)
        figure = Figure(figsize=size)
        wide, high = size[0] - left - _RIGHT_IN, size[1] - bottom - top
        across, down = ((side - between * (n - 1)) / n for side, n in ((wide, columns), (high, rows)))
        spaces = {"wspace": between / across, "hspace": between / down}
        edges = {"left": left / size[0], "right": 1 - _RIGHT_IN / size[0]}
        edges |= {"bottom": bottom / size[1], "top": 1 - top / size[1]}
        panels = figure.subplots(
            rows,
            columns,
            squeeze=False,
            sharex="col" if rows > 1 else False,
            width_ratios=widths,
            gridspec_kw={**edges, **spaces},
        )
        yield figure, panels


def _done(figure: "Figure", words: PictureWords) -> Picture:
    """Return the figure as SVG in a data URI, without date and cut to 0.1 pt, with its words and its size in inches."""
    out = io.StringIO()
    figure.savefig(out, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = out.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = text.replace("'DejaVu Sans'", _FONTS.replace("'", "&#39;"))
    # A place on the paper to a tenth of a point, which is 0.04 mm.
    text = re.sub(r'(?<= )(d|x|y|transform)="[^"]*"', lambda found: re.sub(r"(\.\d)\d+", r"\1", found.group()), text)
    text = re.sub(r">\s+<", "><", text)
    data = base64.b64encode(text.encode()).decode()
    width, height = figure.get_size_inches()
    source = f"data:image/svg+xml;base64,{data}"
    return Picture(source, words.alternative, words.caption, (float(width), float(height)))


def _every(t_s: Floats) -> int:
    """Return how many rows make one point of a small panel."""
    return max(-(-len(t_s) // _FEW_POINTS), 1)


def _thinned(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return a curve of fewer points that looks the same: the least and the largest value of each stretch.

    Stretches without a finite value are left out. A curve of at most ``2 * _MOST_POINTS`` points is returned as it is.
    """
    if len(t_s) <= 2 * _MOST_POINTS:
        return t_s, values
    edges = np.linspace(0, len(t_s), _MOST_POINTS + 1).astype(int)
    kept = []
    for a, b in pairwise(edges.tolist()):
        part = values[a:b]
        if np.isfinite(part).any():
            kept += sorted({a + int(np.nanargmin(part)), a + int(np.nanargmax(part))})
    return t_s[kept], values[kept]


def _means(t_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """Return means of instants and values over equal stretches of a noisy curve, without an incomplete last one."""
    rows = max(len(t_s) // _MOST_POINTS, 1)
    count = len(t_s) // rows
    at, means = (v[: count * rows].reshape(count, rows).mean(axis=1) for v in (t_s, values))
    return np.asarray(at), np.asarray(means)


def _close_up(panel: "Axes", value: Floats, sd: Floats) -> None:
    """Limit the vertical axis to twelve of the last sigmas on each side of a curve's last value."""
    half = 12 * float(sd[-1])
    if np.isfinite(half) and half > 0 and np.isfinite(value[-1]):
        panel.set_ylim(float(value[-1]) - half, float(value[-1]) + half)
