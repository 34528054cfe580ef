"""Pictures of an investigation. matplotlib is an extra and is imported only where a picture is made."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.tracing.investigation import Investigation, ResidualView
from station.errors import UsageError
from station.investigation_printed import words

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

_DPH = np.degrees(1.0) * 3600
_BEFORE, _AFTER = "tab:orange", "tab:blue"


def draw_investigation(path: Path, found: Investigation) -> None:
    """Draw of each gyro the residual before and after: over time, against rate, against temperature if there is one.

    The verification run is drawn, without one the first recording. Raises UsageError if there is nothing to draw or the
    file cannot be written.
    """
    from matplotlib.figure import Figure

    views = _views(found)
    if not views:
        raise UsageError("--plot: nothing to draw, the investigation kept no residuals")
    warm = any(view.temperature_c is not None for view in views)
    columns = 3 if warm else 2
    figure = Figure(figsize=(5 * columns, 2.3 * len(views) + 1.1), layout="constrained")
    panels = figure.subplots(
        len(views), columns, squeeze=False, sharex="col", width_ratios=(2, 1, 1)[:columns], sharey="row"
    )
    for row, view in zip(panels, views, strict=True):
        _draw_gyro(row, view)
    for panel, label in zip(panels[-1], ("time, s", "rate about the sense axis, deg/s", "degC"), strict=False):
        panel.set_xlabel(label)
    what = ", ".join(words(added.effect) for added in found.added)
    kind = "verification" if views[0].verification else "in-sample"
    verdict = f"{found.finding}: {what}" if what else str(found.finding)
    figure.suptitle(f"Error of the compensated rate, {kind} run {views[0].run} ({verdict})")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    try:
        figure.savefig(path, dpi=130)
    except OSError as error:
        raise UsageError(f"--plot {path} cannot be written: {error}") from None


def _views(found: Investigation) -> list[ResidualView]:
    """Return one view a gyro, all of one run: the first that judges."""
    judging = [view for view in found.views if view.verification] or list(found.views)
    return [view for view in judging if view.run == judging[0].run]


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


def _scatter(panel: Axes, x: Floats, view: ResidualView) -> None:
    panel.axhspan(-2 * view.noise_rps * _DPH, 2 * view.noise_rps * _DPH, color="0.85", lw=0, zorder=0)
    for colour, values in ((_BEFORE, view.before_rps), (_AFTER, view.after_rps)):
        panel.plot(x, values * _DPH, ".", ms=2, color=colour, alpha=0.5)
