"""The residual of an investigation: by gyro a table, and whether gyros have it in common."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from rich.markup import escape
from rich.table import Table

from estimator.tracing.residuals.origin import Origin
from estimator.tracing.residuals.residual import BY_CHANCE
from station.render.terminal import Shown, line, rich_table
from station.views.figures import number, whole_percent
from station.views.investigation import GyroResidualView, ResidualsView, ResidualView, SplitView

_LEGEND = (
    "white, p: probability that white noise looks like this; beyond noise: share of the power above the noise; "
    "depends on: shares explained by each variable, which may overlap"
)
_HEADINGS = ("misfit", "white, p", "beyond noise", "depends on")
_LEAST_SHARE = 0.15
"""What depends less than this on a variable is not said to depend on it."""
_MOST_VARIABLES = 3
_LARGE_MISFIT = 100.0


@dataclass(kw_only=True, frozen=True, slots=True)
class _Compared:
    """The residual of some recordings before and after, with the name of the recordings."""

    recordings: str
    before: ResidualView
    after: ResidualView

    @property
    def stages(self) -> Sequence[ResidualView]:
        """Both residuals, or one if nothing has changed."""
        return [self.before] if self.after == self.before else [self.before, self.after]


def residual_shown(residual: ResidualsView | None) -> Iterator[Shown]:
    """Yield the residual of the fitted recordings and, where it does not pass for noise, that of the verification run.

    Each is a table and a line on whether gyros have it in common; a legend follows. Nothing if there is no residual.
    """
    if residual is None:
        return
    compared = [_Compared(recordings="recordings fitted", before=residual.before, after=residual.after)]
    verified = residual.verification
    if verified is not None and not _is_noise(verified.after):
        compared.append(_Compared(recordings="verification run", before=verified.before, after=verified.after))
    for one in compared:
        yield _table(one), {}
        yield line(escape(f"common to all gyros, or individual? {_origins(one)}"))
    yield line(_LEGEND)
    yield line("")


def _is_noise(residual: ResidualView) -> bool:
    """Return whether a residual passes for noise: in every gyro and in what they share."""
    if any(_is_improbable(gyro.white_p) or gyro.beyond for gyro in residual.gyros.values()):
        return False
    return residual.split is None or residual.split.origin == Origin.NOISE


def _is_improbable(probability: float | None) -> bool:
    """Return whether white noise shows so much too rarely; an unknown probability counts as 0."""
    return (probability or 0.0) < BY_CHANCE


def _table(compared: _Compared) -> Table:
    """Return a row for each gyro: the figures of its residual, side by side before and after if there are both."""
    by_chance = max((gyro.nis_sd or 0.0 for gyro in compared.before.gyros.values()), default=0.0)
    title = f"Residual, {compared.recordings} (misfit of noise: 1 ± {by_chance:.2f})"
    rows = [_row(name, compared.stages) for name in compared.before.gyros]
    if len(compared.stages) == 1:
        return rich_table(title, ["gyro", *_HEADINGS], "lrrrl", rows)
    heads = ["gyro"]
    for heading in _HEADINGS:
        heads += [f"{heading}\nbefore", "\nafter"]
    return rich_table(title, heads, "lrrrrrrl", rows)


def _row(name: str, stages: Sequence[ResidualView]) -> list[str]:
    """Return the cells of a gyro: under each heading one for each stage."""
    row = [escape(name)]
    for of_heading in zip(*(_figures(stage.gyros[name]) for stage in stages), strict=True):
        row += of_heading
    return row


def _figures(gyro: GyroResidualView) -> tuple[str, str, str, str]:
    """Return the figures of a gyro under each heading."""
    return _misfit(gyro.nis), _whiteness(gyro.white_p), whole_percent(gyro.beyond), escape(_dependences(gyro))


def _misfit(nis: float | None) -> str:
    if nis is None or nis < _LARGE_MISFIT:
        return number(nis, 2)
    return f"{nis:.3g}"


def _whiteness(probability: float | None) -> str:
    if probability is None or _is_improbable(probability):
        return "< 0.0001"
    return f"{probability:.2g}"


def _dependences(gyro: GyroResidualView) -> str:
    """Return the variables on which a residual depends most, with their shares."""
    shares = [(variable, found.share or 0.0) for variable, found in gyro.depends_on.items()]
    large = [(variable, share) for variable, share in shares if share >= _LEAST_SHARE]
    ranked = sorted(large, key=lambda pair: -pair[1])[:_MOST_VARIABLES]
    return ", ".join(f"{variable} {whole_percent(share)}" for variable, share in ranked) or "nothing"


def _origins(compared: _Compared) -> str:
    """Return whether gyros have a residual in common, before and after, once if both are the same.

    "unknown", with the reason, if either could not be split.
    """
    before, after = compared.before.split, compared.after.split
    if before is None or after is None:
        return f"unknown: {compared.before.no_split or compared.after.no_split or ''}"
    if compared.before == compared.after:
        return _origin(before)
    return f"before: {_origin(before)}; after: {_origin(after)}"


def _origin(split: SplitView) -> str:
    if split.origin == Origin.COMMON:
        doubt = ", as far as one redundant gyro can show" if split.spare == 1 else ""
        return f"{split.origin}{doubt}"
    if split.own_share is not None:
        return f"{split.origin}, {whole_percent(split.own_share)}"
    return split.origin
