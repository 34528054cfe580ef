"""What an investigation leaves of the output errors, as a person reads it, and as --json gives it."""

from dataclasses import asdict
from typing import Any

from rich.markup import escape
from rich.table import Table

from estimator.tracing.investigation import Investigation
from estimator.tracing.residuals.origin import Origin, Split
from estimator.tracing.residuals.residual import GyroResidual, Residual
from station.render.rich_table import rich_table
from station.run.snapshot import json_object, named

_MOST_SHOWN = 3
_LEAST_SHOWN = 0.15
_NUMBERS = ("nis", "nis_sd", "lag1", "lag1_sd", "white_p", "beyond")
_COLUMNS = (("NIS", "r"), ("white, p", "r"), ("beyond noise", "r"), ("depends on", "l"))
_SPECTRUM = ("frequency_hz", "density", "noise")


def residual_tables(found: Investigation) -> list[tuple[Table, str]]:
    """Return what is left, before and after: of the recordings fitted; of the verification run where it is not noise.

    Below each stands whether that is common to all gyros. Nothing if the residual was not looked at.
    """
    before, after = found.residual_before, found.residual_after
    if before is None or after is None:
        return []
    tables = [_table("recordings fitted", before, after)]
    before, after = found.verified_before, found.verified_after
    if before is not None and after is not None and not after.clean:
        tables.append(_table("verification run", before, after))
    return tables


def _table(runs: str, before: Residual, after: Residual) -> tuple[Table, str]:
    both = (before,) if after is before else (before, after)
    by_chance = max(gyro.nis_sd for gyro in before.gyros)
    heads, align = ["gyro"], "l"
    for heading, side in _COLUMNS:
        heads += [heading] if len(both) == 1 else [f"{heading}\nbefore", "\nafter"]
        align += side * len(both)
    rows = [
        (escape(gyros[0].name), *(cell(gyro) for cell in (_nis, _white, _beyond, _depends_on) for gyro in gyros))
        for gyros in zip(*(residual.gyros for residual in both), strict=True)
    ]
    title = f"Residual, {runs} (NIS of noise: 1 ± {by_chance:.2f})"
    return rich_table(title, heads, align, rows), origin_line(before, after)


def origin_line(before: Residual, after: Residual) -> str:
    """Return in words whether what is left is common to all gyros, before and after."""
    question = "common to all gyros, or each gyro's own?"
    if before.split is None or after.split is None:
        return f"{question} cannot be told: {before.no_split or after.no_split}"
    if after is before:
        return f"{question} {_origin(before.split)}"
    return f"{question} before: {_origin(before.split)}; after: {_origin(after.split)}"


def _origin(split: Split) -> str:
    if split.origin == Origin.COMMON and split.spare == 1:
        return f"{split.origin}, as far as one gyro more than axes can tell"
    if split.own_share is None or split.origin == Origin.COMMON:
        return str(split.origin)
    return f"{split.origin}, {split.own_share:.0%}"


def _nis(gyro: GyroResidual) -> str:
    return f"{gyro.nis:.2f}" if gyro.nis < 100 else f"{gyro.nis:.3g}"


def _white(gyro: GyroResidual) -> str:
    return f"{gyro.white_p:.2g}" if gyro.white else "< 0.0001"


def _beyond(gyro: GyroResidual) -> str:
    return f"{gyro.beyond:.0%}"


def _depends_on(gyro: GyroResidual) -> str:
    ranked = sorted(gyro.dependences, key=lambda dependence: -dependence.share)[:_MOST_SHOWN]
    return ", ".join(f"{d.variable} {d.share:.0%}" for d in ranked if d.share >= _LEAST_SHOWN) or "nothing"


def residual_object(found: Investigation) -> dict[str, Any] | None:
    """Return what --json prints of what is left: before, after, and both on the verification run if there is one."""
    fitted = _both(found.residual_before, found.residual_after)
    return fitted and {**fitted, "verification": _both(found.verified_before, found.verified_after)}


def _both(before: Residual | None, after: Residual | None) -> dict[str, Any] | None:
    return None if before is None or after is None else {"before": _object(before), "after": _object(after)}


def _object(residual: Residual) -> dict[str, Any]:
    return {
        "gyros": {
            gyro.name: {
                **named(gyro, _NUMBERS),
                "spectrum": json_object(named(gyro.spectrum, _SPECTRUM)),
                "depends_on": {d.variable: {"share": d.share, "p_value": d.p_value} for d in gyro.dependences},
            }
            for gyro in residual.gyros
        },
        "split": residual.split and asdict(residual.split),
        "no_split": residual.no_split or None,
    }
