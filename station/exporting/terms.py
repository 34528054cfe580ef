"""The correction as terms that C and Python write alike: tables of numbers, and an expression over gyro ``i``.

Names that expressions use: ``warmth`` is the temperature above the reference, ``slope`` its smoothed rate of change,
``time_s`` the time since the state was reset, ``u`` the rate about the nominal sense axis, ``accel`` the specific
force, ``wdot`` the rate of change of the body rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from drivers.arrays import Floats
from estimator.compensation import ADDED, OF_THE_RATE, Compensation, HeldEffect
from estimator.kinematics import GRAVITY_MPS2
from station.exporting.written import number

_EXPRESSIONS: Mapping[str, str] = {
    "thermal_bias": "{table}[i] * warmth",
    "thermal_bias_quadratic": "{table}[i] * warmth * warmth",
    "warm_up": "{table}[i] * -expm1(-time_s / {tau_s})",
    "g_sensitivity": "({table}[i][0] * accel[0] + {table}[i][1] * accel[1] + {table}[i][2] * accel[2])",
    "thermal_gradient": "{table}[i] * slope",
    "thermal_scale": "{table}[i] * warmth * u",
    "scale_asymmetry": "{table}[i] * fabs(u)",
    "scale_quadratic": "{table}[i] * u * u",
    "scale_cubic": "{table}[i] * u * u * u",
    "acceleration_sensitivity": "({table}[i][0] * wdot[0] + {table}[i][1] * wdot[1] + {table}[i][2] * wdot[2])",
}
_UNITS: Mapping[str, str] = {
    "thermal_bias": "rad/s per K above the reference temperature",
    "thermal_bias_quadratic": "rad/s per K2",
    "warm_up": "rad/s, by which the output settles",
    "g_sensitivity": "rad/s per m/s2 along body x, y, z",
    "thermal_gradient": "rad/s per K/s",
    "thermal_scale": "per K, of the rate about the sense axis",
    "scale_asymmetry": "of the size of the rate about the sense axis",
    "scale_quadratic": "per rad/s",
    "scale_cubic": "per (rad/s)2",
    "acceleration_sensitivity": "s, of the angular acceleration about body x, y, z",
    "bandwidth": "s, time constant of the lag of each gyro",
}


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One effect: the name of its table, the table (n,) or (n, 3), its unit, and the expression for gyro ``i``.

    In the expression "{table}" stands for what the table is called.
    """

    effect: str
    table: str
    values: Floats
    unit: str
    expression: str

    def written(self, table: str) -> str:
        """Return the expression with the name of the table."""
        return self.expression.replace("{table}", table)


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """All of them by where they come in: added to the output, of the rate, of the angular acceleration, the lag."""

    added: tuple[Term, ...]
    of_the_rate: tuple[Term, ...]
    of_acceleration: Term | None
    lag: Term | None

    @property
    def all(self) -> tuple[Term, ...]:
        """Every term."""
        return (*self.added, *self.of_the_rate, *(t for t in (self.of_acceleration, self.lag) if t is not None))

    def uses(self, name: str) -> bool:
        """Return whether an expression uses a name such as "warmth"."""
        return any(name in term.expression for term in self.all)

    @property
    def warms_the_rate(self) -> bool:
        """Whether an effect of the rate depends on the temperature."""
        return any("warmth" in term.expression for term in self.of_the_rate)

    @property
    def keeps_state(self) -> bool:
        """Whether samples before are needed."""
        return self.lag is not None or any(self.uses(name) for name in ("slope", "time_s", "wdot"))


def terms_of(compensation: Compensation) -> Terms:
    """Return the terms of a compensation."""
    made: dict[str, list[Term]] = {}
    for place, held in enumerate(compensation.effects):
        twice = any(other.name == held.name for other in compensation.effects[:place])
        table = f"{held.name}_{place}" if twice else held.name
        made.setdefault(held.name, []).append(_term(compensation, held, table))
    return Terms(
        tuple(term for name in (*ADDED, "thermal_gradient") for term in made.get(name, ())),
        tuple(term for name in OF_THE_RATE for term in made.get(name, ())),
        next(iter(made.get("acceleration_sensitivity", ())), None),
        next(iter(made.get("bandwidth", ())), None),
    )


def _term(compensation: Compensation, held: HeldEffect, table: str) -> Term:
    values = held.values[:, 0]
    if held.name == "g_sensitivity":
        values = held.values / GRAVITY_MPS2
    elif held.name == "acceleration_sensitivity":
        axes = compensation.array
        values = held.values[:, [0]] * axes.j + held.values[:, [1]] * axes.k
    expression = _EXPRESSIONS.get(held.name, "")
    if held.name == "warm_up":
        expression = expression.replace("{tau_s}", number(float(held.known.settings["time_constant_s"])))
    return Term(held.name, table, values, _UNITS[held.name], expression)
