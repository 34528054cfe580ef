"""The reproduction as people read it, in tables and a picture, and as --json gives it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from paper_study.study import BARS_PERCENT, Curve, PaperStudy
from paper_study.text import (
    NAMES,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    UNITS,
    contradictions,
    errata,
    relative_percent,
    sentences,
    tetrahedron_as_printed,
)
from station.render.terminal import print_rendered, stdout

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = (0.06, 0.4, 0.4, 0.4)  # of each state, to each side of its set value, as a share of it
_TURNS_S = (67.5, 142.5, 217.5, 292.5)
_LABELS = ("$b$", "$k$", r"$\sigma_j$", r"$\sigma_k$")
_STATES = [f"{name}, {unit}" for name, unit in zip(NAMES, UNITS, strict=True)]
_FORMATS = (".4f", ".1f", ".4f", ".4f")
"""Of an error in b, k, sigma_j, sigma_k."""


def print_paper(study: PaperStudy) -> None:
    """Print the tables of the reproduction, what they show, and what is wrong with the paper's own."""
    earth = np.array([e.linear for e in study.headings.values()])
    percents = {
        "paper,\nTable 3": TABLE_3,
        "paper,\nTable 2 / Table 1": relative_percent(TABLE_2),
        "to the letter": relative_percent(study.clean.linear),
        "the same,\nno noise": relative_percent(study.noise_free.linear),
        "the same,\ndecoded exactly": relative_percent(study.clean.decoded),
        "to the letter,\nEarth rate in data": relative_percent(earth),
        "our default": relative_percent(study.ours),
    }
    lists = {
        "What this shows": paper_findings(study),
        "The paper against itself": contradictions(study.bias_bound_dps),
        "Errata of its axes": errata(tetrahedron_as_printed()),
    }
    values = {"study": study, "earth": np.abs(earth), "percents": percents, "bars": BARS_PERCENT, "lists": lists}
    _print("paper.rich", {**values, "table_2": TABLE_2, "gyros": range(len(TABLE_2)), "abs": np.abs})


def _print(name: str, values: Mapping[str, Any]) -> None:
    common = {"names": NAMES, "states": _STATES, "forms": _FORMATS, "format": format, "isnan": np.isnan}
    print_rendered(stdout(), "paper_study", name, {**common, **values})


def paper_findings(study: PaperStudy) -> list[str]:
    """Return what the numbers of the reproduction say, in sentences."""
    floor = relative_percent(study.noise_free.linear)[2:].mean()
    decoded = relative_percent(study.noise_free.decoded)[2:].mean()
    k_alone, k_noisy = (np.abs(e.linear[:, 1]).max() for e in (study.noise_free, study.clean))
    earth = np.abs(np.array([e.linear for e in study.headings.values()]))
    values = {
        "study": study,
        "floor": floor,
        "decoded": decoded,
        "k_alone": k_alone,
        "k_noisy": k_noisy,
        "b": earth[:, :, 0],
        "k": earth.mean(axis=1)[:, 1],
        "printed_b": TABLE_2[:, 0],
        "printed_k": TABLE_2[:, 1],
        "ours": 100 * np.abs(study.ours / TABLE_1).max(),
    }
    return sentences("paper_findings.txt", values)


def paper_object(study: PaperStudy) -> dict[str, Any]:
    """Return the reproduction as what --json prints; errors by gyro, in the units given."""
    return {
        "study": "paper",
        "states": list(NAMES),
        "units": list(UNITS),
        "paper": {"table_2": TABLE_2.tolist(), "table_3_percent": TABLE_3.tolist()},
        "letter": {
            "without_earth": study.clean.linear.tolist(),
            "without_earth_decoded": study.clean.decoded.tolist(),
            "without_noise": study.noise_free.linear.tolist(),
            "without_noise_decoded": study.noise_free.decoded.tolist(),
            "by_heading_deg": {str(heading): e.linear.tolist() for heading, e in study.headings.items()},
        },
        "ours_at_paper_noise": study.ours.tolist(),
        "ours_at_mems_noise": {
            "seeds": study.seeds,
            "mean_relative_percent": study.mems_percent.tolist(),
            "bound_percent": study.mems_bound_percent.tolist(),
            "bar_percent": BARS_PERCENT.tolist(),
        },
        "findings": paper_findings(study),
        "contradictions": contradictions(study.bias_bound_dps),
        "errata": errata(tetrahedron_as_printed()),
        "filter_apart_sd": study.filter_apart_sd,
        "failed": _failed(study),
    }


def _failed(study: PaperStudy) -> list[dict[str, str]]:
    return [{"seed": failure.item, "reason": failure.reason} for failure in study.failures]


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
