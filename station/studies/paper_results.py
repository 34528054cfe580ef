"""The paper's experiment run again, as people read it, as a picture and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from drivers.types import Floats
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.studies.paper import BARS_PERCENT, Curve, PaperStudy
from station.studies.published import (
    NAMES,
    TABLE_1,
    TABLE_2,
    TABLE_3,
    UNITS,
    errata,
    inconsistencies,
    relative_percent,
    tetrahedron_as_printed,
)
from station.studies.shown import list_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SHOWN = (0.06, 0.4, 0.4, 0.4)  # of each state, to each side of its set value, as a share of it
_TURNS_S = (67.5, 142.5, 217.5, 292.5)
_LABELS = ("$b$", "$k$", r"$\sigma_j$", r"$\sigma_k$")
_STATES = [f"{name}, {unit}" for name, unit in zip(NAMES, UNITS, strict=True)]
_FORMATS = (".4f", ".1f", ".4f", ".4f")
"""Of an error in b, k, sigma_j, sigma_k."""
_SMALL_PERCENT = 1e-3  # below it one digit says enough


def print_paper(study: PaperStudy, *, details: bool = False) -> None:
    """Print the errors beside the paper's, and what they show.

    With ``details`` also the errors of each gyro and heading, and what is inconsistent or wrong in the paper.
    """
    shown: list[Shown] = [(_table_of_means(study), {}), *list_of("What this shows", paper_findings(study))]
    if details:
        shown += [(_errors_by_gyro(study), {}), (_errors_by_heading(study), {})]
        shown += list_of("Inconsistent in the paper", inconsistencies(study.bias_bound_dps))
        shown += list_of("Wrong in its axes", errata(tetrahedron_as_printed()))
    else:
        shown.append(("more: --details", {"highlight": False}))
    print_all(stdout(), shown)


def _table_of_means(study: PaperStudy) -> Table:
    """Return the table of mean relative errors in %, by state: as printed, to the letter, of this station, the bound.

    A last row has what is required of this station.
    """
    earth = np.array([errors.linear for errors in study.headings.values()])
    printed = {
        "the paper, Table 3": TABLE_3,
        "the paper, Table 2 over Table 1": relative_percent(TABLE_2),
    }
    to_the_letter = {
        "its statement to the letter": relative_percent(study.clean.linear),
        "the same without noise": relative_percent(study.noise_free.linear),
        "the same, decoded exactly": relative_percent(study.clean.decoded),
        f"the same, Earth rate, {len(earth)} headings": relative_percent(earth),
    }
    ours = {
        "this station, the paper's noise": relative_percent(study.ours),
        f"this station, MEMS noise, {study.seeds} seeds": study.mems_percent,
        "Cramer-Rao bound of that": study.mems_bound_percent,
        "required of that": BARS_PERCENT,
    }
    table = rich_table("Mean relative error in % of the set value", ["", *NAMES], "lr")
    for group in (printed, to_the_letter, ours):
        for name, percents in group.items():
            table.add_row(name, *[_percent(value) for value in percents])
        table.add_section()
    return table


def _percent(value: float) -> str:
    """Return a share in percent with three digits, with one if it is very small."""
    return f"{value:.3g}" if value >= _SMALL_PERCENT else f"{value:.0e}"


def _errors_by_gyro(study: PaperStudy) -> Table:
    """Return the table of absolute errors of each state and gyro: as printed, to the letter, of this station.

    Those to the letter are without Earth rate and, as a range over all headings, with Earth rate in the data.
    """
    heads = [
        "state",
        "gyro",
        "paper,\nTable 2",
        "to the letter,\nno Earth rate",
        "to the letter, Earth rate\nin the data, by heading",
        "this station,\nthe paper's noise",
    ]
    table = rich_table("Absolute errors at the end of the run", heads, "llr")
    earth = np.abs([errors.linear for errors in study.headings.values()])
    clean = np.abs(study.clean.linear)
    ours = np.abs(study.ours)
    gyros = len(TABLE_2)
    for state, (name, form) in enumerate(zip(_STATES, _FORMATS, strict=True)):
        for gyro in range(gyros):
            by_heading = earth[:, gyro, state]
            table.add_row(
                "" if gyro else name,
                str(gyro + 1),
                f"{TABLE_2[gyro, state]:{form}}",
                f"{clean[gyro, state]:{form}}",
                f"{by_heading.min():{form}} to {by_heading.max():{form}}",
                f"{ours[gyro, state]:.2g}",
                end_section=gyro + 1 == gyros,
            )
    return table


def _errors_by_heading(study: PaperStudy) -> Table:
    """Return the table of errors of the method as the paper states it, Earth rate being in the data.

    Each row is one heading: the error of each gyro's bias, then the mean error of each state over the gyros. The last
    row has the figures of the paper.
    """
    heads = ["heading,\ndeg", *(f"b{gyro + 1},\ndeg/s" for gyro in range(len(TABLE_2)))]
    heads += [f"mean {name},\n{unit}" for name, unit in zip(NAMES, UNITS, strict=True)]
    table = rich_table("To the letter, Earth rate at 45 deg latitude in the data and not in the model", heads, "r")
    for heading, errors in study.headings.items():
        table.add_row(str(heading), *_heading_cells(errors.linear))
    table.add_section()
    table.add_row("Table 2", *_heading_cells(TABLE_2))
    return table


def _heading_cells(errors: Floats) -> Sequence[str]:
    """Return the bias errors of each gyro, and the mean magnitude of each state over the gyros."""
    means = np.abs(errors).mean(axis=0)
    biases = [f"{bias:.4f}" for bias in errors[:, 0]]
    return [*biases, *(f"{mean:{form}}" for mean, form in zip(means, _FORMATS, strict=True))]


def paper_findings(study: PaperStudy) -> list[str]:
    """Return sentences on what the numbers say: about the paper's noise, that of MEMS gyros, and Earth rate."""
    floor = relative_percent(study.noise_free.linear)[2:].mean()
    decoded = relative_percent(study.noise_free.decoded)[2:].mean()
    k_alone_ppm, k_noisy_ppm = (np.abs(errors.linear[:, 1]).max() for errors in (study.noise_free, study.clean))
    earth = np.abs([errors.linear for errors in study.headings.values()])
    b_dps = earth[:, :, 0]
    mean_b_dps = b_dps.mean(axis=1)
    mean_k_ppm = earth.mean(axis=1)[:, 1]
    printed_b = TABLE_2[:, 0]
    printed_k = TABLE_2[:, 1]
    over_bound = study.mems_percent / study.mems_bound_percent
    worst = 100 * np.abs(study.ours / TABLE_1).max()
    return [
        f"At the paper's noise this station finds every state of every gyro within {worst:.4f} %. The paper prints "
        f"{TABLE_3.min():g} to {TABLE_3.max():g} % as the mean. What is left are the counts of the table's encoders.",
        f"At the noise of MEMS gyros (0.005 deg/s/rtHz, bias instability 2 deg/h) its mean errors over {study.seeds} "
        f"seeds are {over_bound.min():.2f} to {over_bound.max():.2f} times those of an estimator at the Cramer-Rao "
        "bound. On average no estimator is below 1.",
        f"The linear model of the paper estimates (1 - k) sigma, so its sigma is {floor:.2f} % too small without any "
        f"noise. Dividing by (1 - k), as this station does, leaves {decoded:.4f} %.",
        f"Without Earth rate its k is right within {k_alone_ppm:.1g} ppm without noise and {k_noisy_ppm:.1g} ppm with "
        f"it. So the {printed_k.min():g} to {printed_k.max():g} ppm of Table 2 come neither from its linear model nor "
        "from its noise.",
        f"Earth rate in the data but not in the model leaves bias errors of {b_dps.min():.4f} to {b_dps.max():.4f} "
        f"deg/s, by gyro and heading, {mean_b_dps.min():.4f} to {mean_b_dps.max():.4f} as the mean of four. Table 2 "
        f"has {printed_b.min():.4f} to {printed_b.max():.4f}, {printed_b.mean():.4f} as the mean: the same size.",
        f"The same Earth rate puts k wrong by {mean_k_ppm.min():.0f} to {mean_k_ppm.max():.0f} ppm as the mean of "
        f"four, where Table 2 has {printed_k.mean():.1f}. So it can explain the bias errors, but not both together.",
        f"The paper's filter ends within {study.filter_apart_sd:.0e} of its sigmas of the batch form of the same "
        "estimate, which is used for the runs with Earth rate and without noise.",
    ]


def paper_object(study: PaperStudy) -> dict[str, Any]:
    """Return the results as --json prints them: the errors of the paper's method and of this station by gyro and state.

    ``units`` has the unit of each state. The errors with the noise of MEMS gyros are means in %, by state alone. With
    them are the printed tables, the bounds, what is required, and the sentences of ``print_paper`` with details.
    """
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
            "by_heading_deg": {str(heading): errors.linear.tolist() for heading, errors in study.headings.items()},
        },
        "ours_at_paper_noise": study.ours.tolist(),
        "ours_at_mems_noise": {
            "seeds": study.seeds,
            "mean_relative_percent": study.mems_percent.tolist(),
            "bound_percent": study.mems_bound_percent.tolist(),
            "bar_percent": BARS_PERCENT.tolist(),
        },
        "findings": paper_findings(study),
        "contradictions": inconsistencies(study.bias_bound_dps),
        "errata": errata(tetrahedron_as_printed()),
        "filter_apart_sd": study.filter_apart_sd,
    }


def draw_convergence(path: Path, ours: Curve, letter: Curve) -> None:
    """Draw each state of each gyro against time as in the paper's Figures 4 to 7, one row a gyro, into a file.

    An existing file at ``path`` is overwritten; its suffix decides on the format.
    """
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
    """Draw one state of one gyro against time: the set value, both curves, and twice the sigma about ours.

    The vertical axis is limited to a share of the set value on each side, so that the early curves are cut.
    """
    set_value = TABLE_1[state]
    half = _SHOWN[state] * abs(set_value)
    value = ours.states[:, gyro, state]
    sd = ours.sd[:, gyro, state]
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
