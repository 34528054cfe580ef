"""Pictures of the studies. matplotlib is an extra and is imported only where a picture is made."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from station.errors import UsageError
from station.studies.paper import Curve
from station.studies.paper_text import TABLE_1, UNITS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FORMATS = (".png", ".svg", ".pdf")
_SHOWN = (0.06, 0.4, 0.4, 0.4)  # of each state, to each side of its set value, as a share of it
_TURNS_S = (67.5, 142.5, 217.5, 292.5)
_LABELS = ("$b$", "$k$", r"$\sigma_j$", r"$\sigma_k$")


def check_picture(path: Path) -> None:
    """See that a picture can be drawn and saved there, before any long work; UsageError if not."""
    if path.suffix.lower() not in FORMATS:
        raise UsageError(f"--plot {path}: the name must end in one of {', '.join(FORMATS)}")
    if not path.resolve().parent.is_dir():
        raise UsageError(f"--plot {path}: there is no directory {path.parent}")


def draw_convergence(path: Path, ours: Curve, letter: Curve) -> None:
    """Draw each state of each gyro against time as in the paper's Figures 4 to 7, one row a gyro."""
    from matplotlib.figure import Figure

    gyros = ours.states.shape[1]
    figure = Figure(figsize=(13, 2.3 * gyros + 1.1), layout="constrained")
    panels = figure.subplots(gyros, len(UNITS), sharex=True, sharey="col")
    for gyro in range(gyros):
        for state in range(len(UNITS)):
            _draw_panel(panels[gyro, state], ours, letter, gyro, state)
        panels[gyro, 0].set_ylabel(f"gyro {gyro + 1}")
    for state, (label, unit) in enumerate(zip(_LABELS, UNITS, strict=True)):
        panels[0, state].set_title(f"{label}, {unit}")
        panels[-1, state].set_xlabel("time, s")
    panels[0, 0].set_xticks(range(0, 361, 60))
    figure.suptitle("Convergence: rest, x, y and z at 20 deg/s for 75 s each, rest; grey lines between them")
    handles, labels = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    figure.savefig(path, dpi=130)


def _draw_panel(panel: Axes, ours: Curve, letter: Curve, gyro: int, state: int) -> None:
    set_value, half = TABLE_1[state], _SHOWN[state] * abs(TABLE_1[state])
    value, sd = ours.states[:, gyro, state], ours.sd[:, gyro, state]
    for at_s in _TURNS_S:
        panel.axvline(at_s, color="0.8", lw=0.6, zorder=0)
    panel.axhline(set_value, color="tab:red", lw=0.8, label="set value", zorder=3)
    panel.plot(ours.t_s, value, color="tab:blue", lw=1.4, label="this station, MEMS noise")
    panel.fill_between(
        ours.t_s, value - 2 * sd, value + 2 * sd, color="tab:blue", alpha=0.25, lw=0, label="its ± 2 sigma"
    )
    panel.plot(
        letter.t_s,
        letter.states[:, gyro, state],
        color="tab:orange",
        lw=1.2,
        ls="--",
        label="the paper's filter, the paper's noise",
    )
    panel.set_xlim(0, ours.t_s[-1])
    panel.set_ylim(set_value - half, set_value + half)
