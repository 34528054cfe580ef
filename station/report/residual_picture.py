"""The residual that an investigation left, drawn for a report and, with --plot, as a picture of its own."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from estimator.effects.constructed import readable as words
from estimator.tracing.investigation import Investigation, ResidualView
from station.errors import UsageError
from station.report.figures import ARW, DEG_PER_H, DEG_PER_S
from station.report.pictures import BLUE, GREY, ORANGE, WIDTH_IN, Picture, done, drawn, every, means
from station.views.investigation import Spectra, judged_spectra, judged_views

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NOISE = "#e0e0e0"
_DPI = 200


def residual_picture(view: ResidualView, spectra: Spectra | None) -> Picture:
    """Return the residual of one gyro before and after: over time, against the rate, and its spectrum."""
    columns = 3 if spectra is not None else 2
    with drawn((WIDTH_IN, 1.75), 1, columns, bottom=0.55, widths=[1.9, 1, 1][:columns]) as (figure, panels):
        _draw(panels[0], view, spectra)
        figure.legend(loc="lower center", ncols=4, frameon=False)
        rms = [float(np.sqrt(np.mean(values**2))) * DEG_PER_H.factor for values in (view.before_rps, view.after_rps)]
        return done(figure, "residual", residual=view, spectrum=spectra is not None, rms=rms)


def draw_investigation(path: Path, found: Investigation) -> None:
    """Draw of each gyro the residual before and after: over time, against rate, temperature if there is one, spectrum.

    The verification run is drawn, without one the first recording. Raises UsageError if there is nothing to draw or the
    file cannot be written.
    """
    views, spectra = judged_views(found.views), judged_spectra(found)
    if not views:
        raise UsageError("--plot: nothing to draw, the investigation kept no residuals")
    warm = any(view.temperature_c is not None for view in views)
    widths = [1.9, *[1] * (1 + warm + bool(spectra))]
    size = WIDTH_IN + 1.8 * warm, 1.3 * len(views) + 0.8
    with drawn(size, len(views), len(widths), bottom=0.55, top=0.3, widths=widths) as (figure, panels):
        for row, view in zip(panels, views, strict=True):
            if spectra:
                row[-1].sharey(panels[0, -1])
            _draw(row, view, spectra.get(view.gyro), warm=warm)
            row[0].set_ylabel(f"{view.gyro}, °/h")
        for panel in panels[:-1].ravel():
            panel.set_xlabel("")
        what = ", ".join(words(added.effect) for added in found.added)
        kind = "verification" if views[0].verification else "in-sample"
        verdict = f"{found.finding}: {what}" if what else str(found.finding)
        figure.suptitle(f"Error of the compensated rate, {kind} run {views[0].run} ({verdict})", fontsize=8)
        labelled = (panel.get_legend_handles_labels()[::-1] for panel in panels[0])
        legend = {label: line for labels, lines in labelled for label, line in zip(labels, lines, strict=True)}
        figure.legend(legend.values(), legend, loc="lower center", ncols=4, frameon=False)
        try:
            figure.savefig(path, dpi=_DPI)
        except OSError as error:
            raise UsageError(f"--plot {path} cannot be written: {error}") from None


def _draw(row: Sequence[Axes], view: ResidualView, spectra: Spectra | None, *, warm: bool = False) -> None:
    """Draw one gyro into a row of panels, each with its legend's labels."""
    over_time, *beside = row
    both = (("before", ORANGE, "x", view.before_rps), ("after", BLUE, "o", view.after_rps))
    since = view.t_s - view.t_s[0]
    noise = 2 * view.noise_rps * DEG_PER_H.factor
    for label, colour, _, values in both:
        at, shown = means(since, values * DEG_PER_H.factor)
        over_time.plot(at, shown, color=colour, label=label, lw=0.7)
    band = noise * np.sqrt(len(at) / len(since))
    over_time.axhspan(-band, band, color=_NOISE, lw=0, zorder=0, label="± 2 sigma of the noise")
    over_time.set_xlabel("time, s")
    over_time.set_ylabel("residual, °/h")
    over_time.margins(x=0)
    over = [(view.rate_rps * DEG_PER_S.factor, "rate about the sense axis, °/s")]
    if warm:
        over.append((np.full_like(since, np.nan) if view.temperature_c is None else view.temperature_c, "°C"))
    each = slice(None, None, every(since))  # over many rows a scatter is as plain with some of them
    for panel, (x, label) in zip(beside, over, strict=False):
        for _, colour, mark, values in both:
            y = values[each] * DEG_PER_H.factor
            panel.plot(x[each], y, mark, ms=1.4, mew=0.3, mfc="none", color=colour)
        panel.axhspan(-noise, noise, color=_NOISE, lw=0, zorder=0)
        panel.set_xlabel(label)
        panel.sharey(over_time)
        panel.tick_params(labelleft=False)
    if spectra is not None:
        _draw_spectra(row[-1], spectra)


def _draw_spectra(panel: Axes, spectra: Spectra) -> None:
    """Draw roots of one-sided densities."""
    for colour, style, density, label in (
        (ORANGE, "-", spectra.before, "_before"),
        (BLUE, "-", spectra.after, "_after"),
        (GREY, "--", spectra.noise, "noise model"),
    ):
        panel.loglog(spectra.frequency_hz, np.sqrt(density) * ARW.factor * 3600, style, color=colour, label=label)
    panel.yaxis.set_minor_formatter("")
    panel.set_xlabel("frequency, Hz")
    panel.set_ylabel("°/h/√Hz")
