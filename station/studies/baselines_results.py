"""The comparison of methods as people read it, and as JSON."""

from typing import Any

import numpy as np

from station.render.terminal import Shown, print_all, rich_table, stdout
from station.studies.baselines import DIRECT, FILTER, LEAST_SQUARES, OURS, ROTATION, STATIC, BaselineStudy
from station.studies.published import NAMES, UNITS
from station.studies.shown import list_of
from station.views.json_values import json_object

_FORMATS = (".4f", ".0f", ".4f", ".4f")
"""Of an error in b, k, sigma_j, sigma_k."""


def print_baselines(study: BaselineStudy, *, details: bool = False) -> None:
    """Print the errors of each method, whether its sigmas match them, its cost, and what that shows.

    With ``details`` also the combinations of states that the table rates alone do not show.
    """
    title = f"Rms error over {study.seeds} seeds and four gyros at MEMS noise, 360 s each"
    heads = [f"{name},\n{unit}" for name, unit in zip(NAMES, UNITS, strict=True)]
    errors = rich_table(title, ["method", *heads], "lr")
    ratios = rich_table("Rms error over stated sigma: 1 where they match", ["method", *NAMES], "lr")
    costs = rich_table("Cost of an estimate", ["method", "processor, ms", "operations a sample"], "lr")
    for method in study.methods:
        errors.add_row(method.name, *[_seen(value, form) for value, form in zip(method.rms, _FORMATS, strict=True)])
        ratios.add_row(method.name, *[_seen(value, ".2f") for value in method.ratio])
        costs.add_row(method.name, f"{1e3 * method.seconds:.0f}", f"{method.operations_a_sample:,.0f}")
    shown: list[Shown] = [
        (errors, {}),
        (ratios, {}),
        (costs, {}),
        *list_of("What this shows", baseline_findings(study)),
    ]
    if details:
        shown += list_of("What the table rates alone do not show, however long they are observed", study.unseen)
    else:
        shown.append(("more: --details", {"highlight": False}))
    print_all(stdout(), shown)


def _seen(value: float, form: str) -> str:
    return "unseen" if np.isnan(value) else f"{value:{form}}"


def baseline_findings(study: BaselineStudy) -> list[str]:
    """Return sentences on what the numbers say about the methods: errors, stated sigmas, cost, and what is unseen."""
    ours = study.named(OURS)
    squares = study.named(LEAST_SQUARES)
    kalman = study.named(FILTER)
    seeing = [method.rms[1] for method in study.methods if method.name not in (STATIC, DIRECT)]
    cheaper = kalman.operations_a_sample / ours.operations_a_sample
    return [
        f"Every method that turns the gyros and sees the states finds them about equally well: k within "
        f"{min(seeing):.0f} to {max(seeing):.0f} ppm.",
        f"They differ in their stated sigmas. Errors of b are {squares.ratio[0]:.2f} times the sigma of least squares, "
        f"{kalman.ratio[0]:.2f} times that of the filter and {study.named(ROTATION).ratio[0]:.2f} times that of six "
        f"rotations, which take all noise for white. For this station the ratio is {ours.ratio[0]:.2f}.",
        f"They differ in cost: the filter takes {kalman.operations_a_sample:,.0f} operations a sample, this station "
        f"{ours.operations_a_sample:,.0f}, {cheaper:.0f} times fewer, for the same estimate. The processor time of "
        "this station includes the estimate of the noise and the uncertainty budget.",
        f"Six positions at rest leave k unknown ({study.named(STATIC).rms[1]:,.0f} ppm): the Earth turns too slowly.",
        f"The table rates alone determine no single state of four gyros: {len(study.unseen)} combinations of the 16 "
        "states leave them unchanged. The output error of each gyro, which the paper and this station use, shows all.",
    ]


def baselines_object(study: BaselineStudy) -> dict[str, Any]:
    """Return the results as --json prints them, in the units given; null for a state that is not seen."""
    methods = [
        {
            "method": method.name,
            "rms_error": json_object(method.rms),
            "rms_stated_sigma": json_object(method.stated),
            "error_over_sigma": json_object(method.ratio),
            "seconds": method.seconds,
            "operations_a_sample": method.operations_a_sample,
        }
        for method in study.methods
    ]
    return {
        "study": "baselines",
        "seeds": study.seeds,
        "states": list(NAMES),
        "units": list(UNITS),
        "methods": methods,
        "unseen_by_table_rates": list(study.unseen),
        "findings": baseline_findings(study),
    }
