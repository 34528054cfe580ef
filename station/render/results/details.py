"""What --details adds to a result: the origin of the sigmas, the noise, the notes, the sources."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from rich.markup import escape
from rich.table import Table

from drivers.types import Floats
from estimator.calibration.values import Calibration
from station.bench.units import Units
from station.render.noise_printed import noise_table
from station.render.results.calibration import fitted_figures
from station.render.results.sizes import two_digits
from station.render.terminal import Shown, line, rich_table
from station.views.calibration import (
    MeanNoise,
    RestNoise,
    UndeclaredShare,
    budget_of,
    mean_noise,
    rest_noise,
    undeclared_shares,
)
from station.views.figures import StateUnit

if TYPE_CHECKING:  # acquisition also imports drivers
    from station.run.source_report import SourceReport

_UNDECLARED_HEADS = ("state", "sigma", "without them", "largest, of variance", "shown by")
_NEGLIGIBLE = 1e-3
"""A contribution less than this share of the combined sigma is not told in digits."""


def details_shown(calibration: Calibration, units: Units) -> Iterator[Shown]:
    """Yield budget and undeclared effects of a calibration, in these units, its noise, what it is valid for, and notes.

    The noise is that estimated, that of a sample and that at rest. Parts that the calibration does not have are left
    out; the noise of a sample is always there.
    """
    figures = fitted_figures(units, calibration)
    budget = budget_of(calibration)
    if budget:
        yield _budget_table(budget, figures), {}
    undeclared = undeclared_shares(calibration, units)
    if undeclared:
        yield _undeclared_table(undeclared), {}
    noise = mean_noise(calibration)
    if noise is not None:
        yield line(_noise(noise))
    samples = ", ".join(f"{gyro.name} {math.degrees(gyro.noise_rps):.4g}" for gyro in calibration.gyros)
    yield line(escape(f"noise of a sample: {samples} deg/s"))
    rest = rest_noise(calibration)
    if rest is not None:
        yield from _rest(rest)
    if calibration.holds_for:
        yield line(escape(f"Valid for {calibration.holds_for}"))
    for note in calibration.notes:
        yield line(escape(f"note: {note}"))


def _budget_table(budget: Mapping[str, Floats], figures: Sequence[StateUnit]) -> Table:
    """Return a row for each line of the budget, "combined" included: rms over the gyros, in the units shown.

    Negligible shares of a state are shown as such.
    """
    heads = ["source", *(f"{figure.name} ({figure.unit})" for figure in figures)]
    table = rich_table("Uncertainty budget, rms over the gyros", heads, "lr")
    combined = budget["combined"].tolist()
    for name, contribution in budget.items():
        sizes = zip(contribution.tolist(), combined, figures, strict=True)
        table.add_row(escape(name), *(_contribution(size, of, figure) for size, of, figure in sizes))
    return table


def _contribution(size: float, combined: float, figure: StateUnit) -> str:
    if size >= combined * _NEGLIGIBLE:
        return two_digits(size * figure.factor)
    return "< 0.1 %"


def _undeclared_table(shares: Sequence[UndeclaredShare]) -> Table:
    """Return a row for each state: sigma with and without undeclared effects, the largest one, and what shows it."""
    rows = [
        [
            f"{share.figure.name} ({share.figure.unit})",
            two_digits(share.sd * share.figure.factor),
            two_digits(share.sd_without * share.figure.factor),
            escape(share.mostly),
            escape(share.shown_by),
        ]
        for share in shares
    ]
    return rich_table("Undeclared effects in the sigmas", _UNDECLARED_HEADS, "lrrll", rows, fold=True)


def _noise(noise: MeanNoise) -> str:
    return (
        f"estimated noise: angle random walk {noise.arw_dps_rthz:.3g} deg/s/rtHz, "
        f"bias instability below {noise.instability_below_dph:.2g} deg/h, "
        f"rate random walk below {noise.walk_below_dph_rth:.2g} deg/h/rth (95 %)"
    )


def _rest(rest: RestNoise) -> Iterator[Shown]:
    title = f"Noise at rest alone, {rest.mean_span_s:.0f} s, with intervals of 95 %"
    yield noise_table(title, rest.noises), {}
    yield line(f"least Allan deviation at rest: {rest.least_dph:.2g} deg/h at {rest.least_tau_s:.0f} s")


def sources_shown(sources: "Sequence[SourceReport]") -> Iterator[Shown]:
    """Yield a line on the samples, losses and clock of each source."""
    for source in sources:
        yield line(escape(f"{source.name}: {'; '.join(_source(source))}"))


def _source(source: "SourceReport") -> Iterator[str]:
    """Yield samples and losses of a source, and as far as known drift and jitter of its clock and its time offset."""
    counts = source.counts
    losses = f"{counts.lost} lost, {counts.repeated} repeated, {counts.late} late, {counts.corrupt} corrupt"
    yield f"{counts.samples} samples, {losses}"
    clock = source.clock
    if clock is not None:
        drift = f"{clock.drift_ppm:+.1f} ± {clock.sd_drift_ppm:.1f} ppm"
        yield f"clock {drift}, arrivals jitter {clock.jitter_rms_s * 1e3:.2f} ms"
    offset = source.offset
    if offset is not None:
        yield f"{offset.offset_s * 1e3:+.2f} ± {offset.sd_s * 1e3:.2f} ms against the table"
