"""A script that turns each axis early and late, beside the one that was asked for."""

from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from station.render.plans.digits import three_digits
from station.render.terminal import Shown, line, print_all, rich_table
from station.scripts.plan import Plan
from station.views.figures import state_figures


def print_early_late(asked: Plan, offered: Plan, path: Path, console: Console) -> None:
    """Print the sigmas of a script that turns each axis early and late, beside those of the asked one.

    What it proves of the constancy, and its file, follow.
    """
    file_line = escape(f"script: {path}   (station run --script {path})")
    shown: list[Shown] = [
        (beside_table(asked, offered), {}),
        line(proved_words(offered)),
        (file_line, {"highlight": False, "soft_wrap": True}),
    ]
    print_all(console, shown)


def beside_table(asked: Plan, offered: Plan) -> Table:
    """Return a table of the predicted sigmas of ``offered`` beside those of ``asked``, a row for each gyro.

    ``offered`` is the plan that turns each axis early and late. Devices are named only if there are several.
    """
    heads = ["gyro"]
    figures = state_figures(asked.bench.units)
    for figure in figures:
        heads += [f"{figure.name}\n{figure.unit}", "\nasked"]
    sigmas = rich_table(
        f"Predicted sigmas with every axis turned early and late, in {offered.script.least_s:.4g} s",
        heads,
        "lrdrdrdrd",
    )
    several = len({gyro.source for gyro in offered.forecast.gyros}) > 1
    for gyro, own, others in zip(offered.forecast.gyros, offered.sd, asked.sd, strict=True):
        cells = [escape(f"{gyro.source} {gyro.name}" if several else gyro.name)]
        for state, figure in enumerate(figures):
            cells += [three_digits(float(sds[state] * figure.factor)) for sds in (own, others)]
        sigmas.add_row(*cells)
    return sigmas


def proved_words(plan: Plan) -> str:
    """Return in words over which time a script proves constancy, by axis."""
    spans = [
        f"{one.axis} from {one.covered_s[0]:.0f} to {one.covered_s[1]:.0f} s" for one in plan.constancy if one.covered_s
    ]
    return f"constancy proved: {', '.join(spans)}"
