"""What the chapter on the correction shows of effects: formulas, letters, numbers."""

from collections.abc import Mapping, Sequence

from markupsafe import Markup

from estimator.compensation import OF_THE_RATE, HeldEffect
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import VARIABLES, variables_of
from estimator.effects.thermal import REFERENCE_C
from estimator.kinematics import GRAVITY_MPS2
from station.report.correction import Correction
from station.report.figures import ONE, figure
from station.report.recorded import Recorded

_T = f"(<var>T</var> − {REFERENCE_C:g} °C)"
FORMULAS: Mapping[str, str] = {
    "thermal_bias": f"<var>a</var> {_T}",
    "thermal_bias_quadratic": f"<var>a</var> {_T}<sup>2</sup>",
    "thermal_scale": f"<var>a</var> {_T} <var>u</var>",
    "thermal_gradient": "<var>a</var> d<var>T</var>/d<var>t</var>",
    "scale_asymmetry": "<var>a</var> |<var>u</var>|",
    "scale_quadratic": "<var>a</var> <var>u</var><sup>2</sup>",
    "scale_cubic": "<var>a</var> <var>u</var><sup>3</sup>",
    "g_sensitivity": "<b>a</b> · <b>f</b> / <var>g</var>",
    "warm_up": "<var>a</var> (1 − exp(−<var>t</var> / <var>τ</var>))",
    "bandwidth": "−<var>a</var> d<var>y</var>/d<var>t</var>",
    "acceleration_sensitivity": (
        "<var>a</var><sub>1</sub> <b>j</b> · d<var>ω</var>/d<var>t</var> + "
        "<var>a</var><sub>2</sub> <b>k</b> · d<var>ω</var>/d<var>t</var>"
    ),
}
"""What each effect adds to the outputs, as HTML."""
_SYMBOLS = (
    ("<var>u</var> = <b>p</b> · <var>ω</var>, found by iteration", OF_THE_RATE),
    ("<var>T</var> is the temperature of the gyros", ("thermal_bias", "thermal_bias_quadratic", "thermal_scale")),
    (f"d<var>T</var>/d<var>t</var> is taken over {SLOPE_S:g} s", ("thermal_gradient",)),
    (f"<b>f</b> is the specific force in body axes, <var>g</var> = {GRAVITY_MPS2} m/s²", ("g_sensitivity",)),
    ("<var>t</var> counts from switching on", ("warm_up",)),
    ("other rates of change are differences of two samples", ("bandwidth", "acceleration_sensitivity")),
)
"""What the letters in them mean, and where they stand."""


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
    return None if effect.known.law else Markup(FORMULAS[effect.name])


def symbols_of(effects: Sequence[HeldEffect]) -> list[Markup]:
    """Return what the letters mean in the formulas of effects."""
    names = {effect.name for effect in effects}
    return [Markup(text) for text, using in _SYMBOLS if names & set(using)]


def variables_of_laws(effects: Sequence[HeldEffect]) -> list[str]:
    """Return what the variables mean in the laws of effects that were constructed."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}" for name in sorted(names)]
