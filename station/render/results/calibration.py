"""The states of a calibration as a person reads them, and the effects of its error model."""

import math
from collections.abc import Iterator

from rich.markup import escape
from rich.table import Table

from estimator.calibration.gyro import EffectValue
from estimator.calibration.values import Calibration
from estimator.effects.constructed import readable
from station.bench.units import Units
from station.render.terminal import Shown, line, rich_table
from station.run.outcome import Verdict
from station.views.calibration import mean_noise
from station.views.figures import StateUnit, human, state_figures

_EFFECT_HEADS = ("effect", "parameter", "gyro", "found", "typical size")


def calibration_shown(calibration: Calibration, verdict: Verdict, units: Units) -> Iterator[Shown]:
    """Yield the states of every gyro with their sigmas, in these units; those of broken limits are red.

    Effects, mean NIS and noise follow if the calibration has them.
    """
    yield _states(calibration, verdict, units), {}
    if any(gyro.effects for gyro in calibration.gyros):
        yield _effects(calibration), {}
    if math.isfinite(calibration.nis_mean):
        nis = f"{calibration.nis_mean:.3f}"
        yield line(f"Consistency (NIS): {nis}. Near 1, the stated uncertainties match the scatter.")
    noise = mean_noise(calibration)
    if noise is not None:
        walk = f"angle random walk {noise.arw_dps_rthz:.3g} deg/s/rtHz"
        yield line(f"noise: {walk}, bias instability < {noise.instability_below_dph:.2g} deg/h")


def _states(calibration: Calibration, verdict: Verdict, units: Units) -> Table:
    """Return a row for each gyro: states and sigmas in the units chosen, those beyond their limits marked."""
    broken = {(limit.row, limit.state, limit.of_u) for limit in verdict.broken}
    figures = fitted_figures(units, calibration)
    heads = ["gyro"]
    for figure in figures:
        heads += [f"{figure.name}\n{figure.unit}", "±"]
    counts = f"{calibration.samples} samples, {calibration.lost} lost"
    states = rich_table(f"States and their standard deviations ({counts})", heads, "lrdrdrdrd")
    for row, gyro in enumerate(calibration.gyros):
        cells = [escape(gyro.name)]
        for state, figure in enumerate(figures):
            cells.append(_marked(figure.text(gyro.states[state]), broken=(row, state, False) in broken))
            cells.append(_marked(figure.text(gyro.sd[state]), broken=(row, state, True) in broken))
        states.add_row(*cells)
    return states


def _marked(text: str, *, broken: bool) -> str:
    return f"[bold red]{text}[/]" if broken else text


def fitted_figures(units: Units, calibration: Calibration) -> tuple[StateUnit, ...]:
    """Return the states in these units, with the digits that the sigmas of a calibration deserve."""
    sds = zip(*(gyro.sd.tolist() for gyro in calibration.gyros), strict=True)
    return tuple(figure.fitted(own) for figure, own in zip(state_figures(units), sds, strict=True))


def _effects(calibration: Calibration) -> Table:
    """Return the table of the effects of the error model, in which a shared effect has one row."""
    effects = rich_table("Effects of the error model", _EFFECT_HEADS, "lllrd")
    for place, effect in enumerate(calibration.gyros[0].effects):
        gyros = calibration.gyros[:1] if effect.shared else calibration.gyros
        for gyro in gyros:
            value = gyro.effects[place]
            effects.add_row(
                *(_effect_names(value) if gyro is gyros[0] else ("", "")),
                "all" if value.shared else escape(gyro.name),
                human(value.value, value.sd, value.unit),
                _typical(value) if gyro is gyros[0] else "",
            )
    return effects


def _effect_names(value: EffectValue) -> tuple[str, str]:
    return escape(readable(value.effect)), escape(value.parameter)


def _typical(value: EffectValue) -> str:
    """Return the size that the error model expects of a gyro's own effect; empty for what all gyros share."""
    return "" if value.shared else human(value.expected_sd, 0.0, value.unit)
