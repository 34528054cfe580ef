"""What the chapter on the correction shows of effects: formulas, letters, numbers."""

from collections.abc import Sequence

from markupsafe import Markup

from estimator.calibration.compensation import HeldEffect
from estimator.effects.constructed import VARIABLES, variables_of
from estimator.effects.thermal import REFERENCE_C
from station.exports.terms import FORMULAS
from station.report.chapters.correction import Correction
from station.report.figures import ONE, figure
from station.report.recorded import Recorded


def origin(recorded: Recorded, data_sha256: str, title: str) -> str:
    """Return the comment that Python for a device begins with."""
    return f"Recording {recorded.path.name}, SHA-256 of its samples\n{data_sha256}\n{title}"


def gains(one: Correction, gyro: int) -> list[Markup]:
    """Return the row of the sensitivity of a gyro, or what it has of the rate about its own axis."""
    compensation = one.compensation
    values = [1 - compensation.states[gyro, 0]] if one.axes_only else compensation.sensitivity[gyro].tolist()
    return [figure(float(value), ONE, f"{value:.7f}".replace("-", "−")) for value in values]


def formula_of(effect: HeldEffect) -> Markup | None:
    """Return what an effect of the catalogue adds to the outputs."""
    return None if effect.known.law else Markup(FORMULAS[effect.name]["html"].format(reference_c=f"{REFERENCE_C:g}"))


def variables_of_laws(effects: Sequence[HeldEffect]) -> list[str]:
    """Return what the variables mean in the laws of effects that were constructed."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}" for name in sorted(names)]
