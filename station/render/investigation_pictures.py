"""Pictures of an investigation. matplotlib is imported only where a picture is made: it takes half a second."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from drivers.types import Floats
from estimator.tracing.investigation import Investigation, ResidualView
from estimator.tracing.residuals.residual import Spectrum
from station.errors import UsageError
from station.render.investigation_printed import words

if TYPE_CHECKING:
    from matplotlib.axes import Axes


_DPH = np.degrees(1.0) * 3600
_BEFORE, _AFTER = "tab:orange", "tab:blue"


def draw_investigation(path: Path, found: Investigation) -> None:
    """Draw of each gyro the residual before and after: over time, against rate, temperature if there is one, spectrum.

    The verification run is drawn, without one the first recording. Raises UsageError if there is nothing to draw or the
    file cannot be written.
    """
    from matplotlib.figure import Figure

    views = _views(found)
    if not views:
        raise UsageError("--plot: nothing to draw, the investigation kept no residuals")
    spectra = _spectra(found)
    warm = any(view.temperature_c is not None for view in views)
    labels = [
        "time, s",
        "rate about the sense axis, deg/s",
        *(["degC"] if warm else []),
        *(["frequency, Hz"] if spectra else []),
    ]
    widths = [2] + [1] * (len(labels) - 1)
    figure = Figure(figsize=(3.6 * sum(widths), 2.3 * len(views) + 1.1), layout="constrained")
    panels = figure.subplots(len(views), len(labels), squeeze=False, sharex="col", width_ratios=widths)
    for row, view in zip(panels, views, strict=True):
        _draw_gyro(row[: 3 if warm else 2], view)
        if view.gyro in spectra:
            row[-1].sharey(panels[0, -1])
            _draw_spectrum(row[-1], *spectra[view.gyro])
    for panel, label in zip(panels[-1], labels, strict=True):
        panel.set_xlabel(label)
    what = ", ".join(words(added.effect) for added in found.added)
    kind = "verification" if views[0].verification else "in-sample"
    verdict = f"{found.finding}: {what}" if what else str(found.finding)
    figure.suptitle(f"Error of the compensated rate, {kind} run {views[0].run} ({verdict})")
    legend = dict(zip(*panels[0, 0].get_legend_handles_labels()[::-1], strict=True))
    legend |= dict(zip(*panels[0, -1].get_legend_handles_labels()[::-1], strict=True))
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=len(legend), frameon=False)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise UsageError(f"--plot {path} cannot be written: {error}") from None


def _views(found: Investigation) -> list[ResidualView]:
    """Return one view a gyro, all of one run: the first that judges."""
    judging = [view for view in found.views if view.verification] or list(found.views)
    return [view for view in judging if view.run == judging[0].run]


def _spectra(found: Investigation) -> dict[str, tuple[Spectrum, Spectrum]]:
    """Return the spectra before and after by gyro, of the runs that judge."""
    judged = found.verified_before is not None
    before = found.verified_before if judged else found.residual_before
    after = found.verified_after if judged else found.residual_after
    if before is None or after is None:
        return {}
    return {old.name: (old.spectrum, new.spectrum) for old, new in zip(before.gyros, after.gyros, strict=True)}


def _draw_gyro(row: Sequence[Axes], view: ResidualView) -> None:
    pairs = (("before", _BEFORE, view.before_rps), ("after", _AFTER, view.after_rps))
    noise = view.noise_rps * _DPH
    row[0].axhspan(-2 * noise, 2 * noise, color="0.85", lw=0, label="± 2 sigma of the noise", zorder=0)
    for label, colour, values in pairs:
        row[0].plot(view.t_s - view.t_s[0], values * _DPH, color=colour, lw=0.8, label=label)
    _scatter(row[1], np.degrees(view.rate_rps), view)
    if len(row) > 2 and view.temperature_c is not None:
        _scatter(row[2], view.temperature_c, view)
    row[0].set_ylabel(f"{view.gyro}, deg/h")
    for panel in row[1:]:
        panel.sharey(row[0])
        panel.tick_params(labelleft=False)


def _scatter(panel: Axes, x: Floats, view: ResidualView) -> None:
    panel.axhspan(-2 * view.noise_rps * _DPH, 2 * view.noise_rps * _DPH, color="0.85", lw=0, zorder=0)
    for colour, values in ((_BEFORE, view.before_rps), (_AFTER, view.after_rps)):
        panel.plot(x, values * _DPH, ".", ms=2, color=colour, alpha=0.5)


def _draw_spectrum(panel: Axes, before: Spectrum, after: Spectrum) -> None:
    """Draw roots of one-sided densities, deg/h/rtHz."""
    for spectrum, colour in ((before, _BEFORE), (after, _AFTER)):
        panel.loglog(spectrum.frequency_hz, np.sqrt(spectrum.density) * _DPH, color=colour, lw=0.8)
    panel.loglog(after.frequency_hz, np.sqrt(after.noise) * _DPH, "--", color="0.3", lw=1.0, label="noise model")
    panel.yaxis.set_minor_formatter("")
    panel.set_ylabel("deg/h/rtHz, one-sided")
