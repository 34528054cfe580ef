"""The effects of accelerometers that are looked for, and the functions that stand for all others.

The model equation of IEEE 1293 without what a rate table cannot excite. Columns are in m/s2 per unit of a parameter; a
is the specific force along the sense axis, a_j and a_k that along the tilt axes, w the body rate.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from estimator.calibration.error_model import KnownForceEffect, ModelError
from estimator.effects.conditions import Axes, Conditions
from estimator.effects.effect import Effect, Parameter, Record
from estimator.estimation.noise_evidence import Law
from estimator.geometry.kinematics import GRAVITY_MPS2
from estimator.types import Floats

_G = GRAVITY_MPS2
Columns = Callable[[Conditions, Axes], Floats]
_NAMES = re.compile(r"[A-Za-z]\w*")
_OF_FORCE = {"a", "aj", "ak", "g", "fabs"}


@dataclass(kw_only=True, frozen=True, slots=True)
class ForceEffect:
    """An effect of single accelerometers.

    ``parameters`` are their names; each has the ``unit`` and the ``largest`` plausible size. ``columns`` returns the
    regressors (N, parameters) of one accelerometer. ``adds`` writes them as expressions of C and Python: what a unit of
    each parameter adds to the output, with a, aj and ak the specific force along p, j and k, g standard gravity, wx, wy
    and wz the body rate, T the temperature, t the time, T0 and t0 where the effect is zero.

    ``needs`` names data beyond the motion: "temperature". With ``over_time`` the effect goes with the time since the
    middle of the run. ``named`` is False for functions that stand for effects nobody has named. ``shown`` is the factor
    to the unit for people, ``shown_unit``.
    """

    name: str
    words: str
    unit: str
    largest: float
    columns: Columns
    adds: tuple[str, ...] = ()
    parameters: tuple[str, ...] = ("coefficient",)
    needs: str = ""
    over_time: bool = False
    named: bool = True
    shown: float = 1.0
    shown_unit: str = ""
    shown_by: str = ""

    @property
    def of_force(self) -> bool:
        """Whether it is a function of the specific force alone."""
        return all(set(_NAMES.findall(text)) <= _OF_FORCE for text in self.adds)

    def about(self, conditions: Conditions) -> str:
        """Return at which temperature or instant of a run the effect is zero; "" if it depends on neither."""
        if self.needs == "temperature":
            return f"T0 = {conditions.reference_c:.2f} degC"
        return f"t0 = {_middle_s(conditions):.1f} s" if self.over_time else ""

    def law(self, expected: Floats | None = None) -> Law:
        """Return the law of the effect, each accelerometer with its own parameters.

        ``expected`` (p,) are their standard deviations about zero, the largest plausible size if None.
        """
        parameters = tuple(Parameter(name, self.unit, self.largest) for name in self.parameters)
        effect = Effect(
            name=self.name,
            parameters=parameters,
            regressors=self.columns,
            needs=frozenset(),
            record=Record(name=self.name, parameters=parameters, shared=False),
        )
        sd = np.full(len(parameters), self.largest) if expected is None else expected
        return Law(called=self.name, effect=effect, mean=np.zeros(len(parameters)), sd=sd)


def _along(conditions: Conditions, axes: Axes) -> tuple[Floats, Floats, Floats]:
    """Return the specific force (N,) along the sense axis and along both tilt axes."""
    force = conditions.specific_force_mps2
    return force @ axes.p, force @ axes.j, force @ axes.k


def _of_force(function: Callable[[Floats, Floats, Floats], Floats]) -> Columns:
    """Return what gives the columns (N, 1) of a ``function`` of the forces (N,) along p, j and k, in m/s2."""

    def columns(conditions: Conditions, axes: Axes) -> Floats:
        """Return the column of one accelerometer."""
        return function(*_along(conditions, axes))[:, None]

    return columns


def _rectified(conditions: Conditions, axes: Axes) -> Floats:
    """Return the square of the rate (N, 1): the motor's vibration, rectified."""
    return np.asarray(np.sum(conditions.w_rps**2, axis=1)[:, None])


def _warmth_k(conditions: Conditions) -> Floats:
    """Return the temperature (N,) less the reference; 0 where none was measured."""
    if conditions.temperature_c is None:
        return np.zeros(len(conditions.t_s))
    return np.asarray(conditions.temperature_c - conditions.reference_c)


def _thermal_bias(conditions: Conditions, axes: Axes) -> Floats:
    """Return the column (N, 1) of the slope of the bias b over temperature."""
    return -_warmth_k(conditions)[:, None]


def _thermal_scale(conditions: Conditions, axes: Axes) -> Floats:
    """Return the column (N, 1) of the slope of the scale factor error k over temperature."""
    return -(_warmth_k(conditions) * _along(conditions, axes)[0])[:, None]


def _drift(conditions: Conditions, axes: Axes) -> Floats:
    """Return the column (N, 1) of the slope of the bias b over time, about the middle of the run."""
    return np.asarray(-(conditions.t_s - _middle_s(conditions))[:, None])


def _middle_s(conditions: Conditions) -> float:
    return float(conditions.t_s[0] + conditions.t_s[-1]) / 2


def _functions_of_force(conditions: Conditions, axes: Axes) -> Floats:
    """Return functions (N, 6) of the force along the sense axis that are none of the named ones: fourth to ninth order.

    Legendre polynomials over +-1.2 g; a larger force counts as that.
    """
    x = np.clip(_along(conditions, axes)[0] / (1.2 * _G), -1.0, 1.0)
    return np.column_stack([np.polynomial.legendre.Legendre.basis(order)(x) for order in range(4, 10)])


def _functions_of_rate(conditions: Conditions, axes: Axes) -> Floats:
    """Return the rates, their sizes and their products about the axes of the accelerometer (N, 9)."""
    rates = [conditions.w_rps @ axis for axis in (axes.p, axes.j, axes.k)]
    products = [rates[0] * rates[1], rates[0] * rates[2], rates[1] * rates[2]]
    return np.column_stack([*rates, *(np.abs(rate) for rate in rates), *products])


def _functions_of_time(conditions: Conditions, axes: Axes) -> Floats:
    """Return bends of the bias over the run (N, 5): cosines of half a period to three periods."""
    begun_s = conditions.t_s[0]
    share = (conditions.t_s - begun_s) / max(float(conditions.t_s[-1] - begun_s), 1.0)
    return np.column_stack([np.cos(np.pi * count * share) for count in range(2, 7)])


_PER_MILLION = 1e6
_MICRO_G = 1e6 / _G

EFFECTS: tuple[ForceEffect, ...] = (
    ForceEffect(
        name="asymmetry",
        words="scale factors differ for positive and negative forces",
        unit="1",
        largest=5e-3,
        columns=_of_force(lambda a, a_j, a_k: 0.5 * np.abs(a)),
        adds=("0.5 * fabs(a)",),
        shown=_PER_MILLION,
        shown_unit="ppm",
        shown_by="poses at 0, +1 and -1 g",
    ),
    ForceEffect(
        name="second_order",
        words="second order (K2)",
        unit="1/g",
        largest=2e-3,
        columns=_of_force(lambda a, a_j, a_k: a**2 / _G),
        adds=("a * a / g",),
        shown=_PER_MILLION,
        shown_unit="ug/g2",
        shown_by="poses at 0, +-1 g and between",
    ),
    ForceEffect(
        name="third_order",
        words="third order (K3)",
        unit="1/g2",
        largest=2e-3,
        columns=_of_force(lambda a, a_j, a_k: a**3 / _G**2),
        adds=("a * a * a / (g * g)",),
        shown=_PER_MILLION,
        shown_unit="ug/g3",
        shown_by="poses at 0, +-1 g and between: in poses of 0 and 1 g it is the scale factor",
    ),
    ForceEffect(
        name="cross_j",
        words="product of the forces along the sense axis and along j",
        unit="1/g",
        largest=2e-3,
        columns=_of_force(lambda a, a_j, a_k: a * a_j / _G),
        adds=("a * aj / g",),
        shown=_PER_MILLION,
        shown_unit="ug/g2",
        shown_by="poses between the axes",
    ),
    ForceEffect(
        name="cross_k",
        words="product of the forces along the sense axis and along k",
        unit="1/g",
        largest=2e-3,
        columns=_of_force(lambda a, a_j, a_k: a * a_k / _G),
        adds=("a * ak / g",),
        shown=_PER_MILLION,
        shown_unit="ug/g2",
        shown_by="poses between the axes",
    ),
    ForceEffect(
        name="cross_axis_square",
        words="squares of the forces across the sense axis (Koo, Kpp)",
        unit="1/g",
        largest=2e-3,
        columns=lambda conditions, axes: np.column_stack([a**2 / _G for a in _along(conditions, axes)[1:]]),
        adds=("aj * aj / g", "ak * ak / g"),
        parameters=("along j", "along k"),
        shown=_PER_MILLION,
        shown_unit="ug/g2",
        shown_by="poses at 0 and 1 g, and a second mounting",
    ),
    ForceEffect(
        name="vibration_rectification",
        words="output in proportion to the square of the rate (rectified vibration)",
        unit="(m/s2)/(rad/s)2",
        largest=5e-3,
        columns=_rectified,
        adds=("wx * wx + wy * wy + wz * wz",),
        shown=_MICRO_G,
        shown_unit="ug/(rad/s)2",
        shown_by="turns at two rates about two axes",
    ),
    ForceEffect(
        name="bias_over_temperature",
        words="bias over temperature",
        unit="m/s2/K",
        largest=0.01,
        columns=_thermal_bias,
        adds=("-(T - T0)",),
        needs="temperature",
        shown=_MICRO_G,
        shown_unit="ug/degC",
        shown_by="a run that warms up",
    ),
    ForceEffect(
        name="scale_over_temperature",
        words="scale factor over temperature",
        unit="1/K",
        largest=5e-4,
        columns=_thermal_scale,
        adds=("-(T - T0) * a",),
        needs="temperature",
        shown=_PER_MILLION,
        shown_unit="ppm/degC",
        shown_by="a run that warms up, with poses early and late",
    ),
    ForceEffect(
        name="drift_of_bias",
        words="bias that drifts with time",
        unit="m/s2/s",
        largest=1e-5,
        columns=_drift,
        adds=("-(t - t0)",),
        over_time=True,
        shown=3600 * _MICRO_G,
        shown_unit="ug/h",
        shown_by="poses early and late",
    ),
    ForceEffect(
        name="function_of_force",
        words="another function of the force along the sense axis",
        unit="m/s2",
        largest=0.02,
        columns=_functions_of_force,
        parameters=tuple(f"order {order}" for order in range(4, 10)),
        named=False,
    ),
    ForceEffect(
        name="function_of_rate",
        words="another function of the rates",
        unit="m/s2 per (rad/s)",
        largest=0.01,
        columns=_functions_of_rate,
        parameters=tuple(f"{kind} {axis}" for kind in ("rate", "size", "product") for axis in "pjk"),
        named=False,
    ),
    ForceEffect(
        name="function_of_time",
        words="a bias that changes with time",
        unit="m/s2",
        largest=0.02,
        columns=_functions_of_time,
        parameters=tuple(f"wave {count}" for count in range(2, 7)),
        named=False,
    ),
)
BY_NAME: Mapping[str, ForceEffect] = {effect.name: effect for effect in EFFECTS}


def laws_of_model(known: Sequence[KnownForceEffect], offers: Collection[str]) -> list[Law]:
    """Return the laws of the effects of a model, for a run that has the data in ``offers``; their expected sizes are
    the model's.

    Raises ModelError for an effect that this station does not know, whose parameters, units or mean (0) differ from the
    catalogue's, or that the run cannot show.
    """
    laws = []
    for one in known:
        effect = BY_NAME.get(one.name)
        if effect is None or not effect.named:
            raise ModelError(
                f"the model has the effect {one.name} of accelerometers, which this station does not know: use the "
                "version of the station that found it, or investigate again"
            )
        expected = [(name, effect.unit, 0.0) for name in effect.parameters]
        if [(size.name, size.unit, size.mean) for size in one.sizes] != expected:
            units = " and ".join(f"{name!r} in {effect.unit!r}" for name in effect.parameters)
            raise ModelError(
                f"the model's effect {one.name} of accelerometers must have {units}, with mean 0: correct the file, or "
                "investigate again"
            )
        if effect.needs and effect.needs not in offers:
            raise ModelError(
                f"the model has {one.name} of accelerometers, for which the recording must hold the {effect.needs}: "
                "record it, or leave out --model"
            )
        laws.append(effect.law(one.sd))
    return laws
