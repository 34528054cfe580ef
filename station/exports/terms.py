"""The correction as terms that C and Python write nearly alike: tables of numbers, an expression over gyro ``i``.

Names that expressions use: ``warmth`` is the temperature above the reference, ``slope`` its smoothed rate of change,
``time_s`` the time since the state was reset, ``u`` the rate about the nominal sense axis, ``accel`` the specific
force, ``w`` the body rate, ``wdot`` its rate of change, ``step`` the time since the sample before. What the languages
write differently stands in braces: names of tables, helpers that laws call.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.calibration.compensation import ADDED, OF_THE_RATE, Acts, Compensation, HeldEffect
from estimator.effects.constructed import NAME as CONSTRUCTED
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.exports.law_text import law_terms
from station.exports.written import number

FORMULAS: Mapping[str, Mapping[str, str]] = packaged_toml("station.exports", "effects.toml")
"""What each effect adds to the outputs: as ``html``, ``numpy``, ``scalar`` expression, and its ``unit``."""
_SIZE = "sqrt({0}[0] * {0}[0] + {0}[1] * {0}[1] + {0}[2] * {0}[2])"
_ALONG = "({{axis}}[i][0] * {0}[0] + {{axis}}[i][1] * {0}[1] + {{axis}}[i][2] * {0}[2])"
_VARIABLES: Mapping[str, str] = {
    "u": "u",
    **{f"w{axis}": f"w[{r}]" for r, axis in enumerate("xyz")},
    "speed": _SIZE.format("w"),
    "a": _ALONG.format("wdot"),
    "jolt": _SIZE.format("wdot"),
    "T": "warmth",
    "Tdot": "slope",
    "t": "time_s",
    **{f"g{axis}": f"(accel[{r}] / {number(GRAVITY_MPS2)})" for r, axis in enumerate("xyz")},
    "gs": f"({_ALONG.format('accel')} / {number(GRAVITY_MPS2)})",
}
_PLACES = {"lag": 1, "play": 1, "last": 2}
"""Numbers that each function with memory keeps for a gyro."""


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One effect: the name of its table, the table (n,) or (n, p), its unit, and the expression for gyro ``i``.

    In the expression "{table}" stands for what the table is called. ``acts``: where it comes in.
    """

    effect: str
    table: str
    values: Floats
    unit: str
    expression: str
    acts: Acts

    def written(self, table: str, helpers: Mapping[str, str]) -> str:
        """Return the expression with the name of the table, and the helpers as a language writes them."""
        text = self.expression.replace("{table}", table)
        for name, helper in helpers.items():
            text = text.replace(f"{{{name}}}", helper)
        return text


@dataclass(frozen=True, slots=True, eq=False)
class Terms:
    """All of them, in the order in which they are undone; ``places``: numbers that are kept for each gyro."""

    all: tuple[Term, ...]
    places: int

    def of(self, acts: Acts) -> tuple[Term, ...]:
        """Return those that come in like this."""
        return tuple(term for term in self.all if term.acts is acts)

    @property
    def lag(self) -> Term | None:
        """Return the lag of the output, if it has one."""
        return next(iter(self.of(Acts.LAG)), None)

    def uses(self, name: str, acts: Acts | None = None) -> bool:
        """Return whether an expression uses a name such as "warmth"; of those that come in like this, if given."""
        some = self.all if acts is None else self.of(acts)
        return any(re.search(rf"\b{name}\b", term.expression) for term in some)

    @property
    def given_to_the_rate(self) -> list[str]:
        """What effects of the rate depend on beside it."""
        return [name for name in ("warmth", "time_s", "accel") if self.uses(name, Acts.RATE)]

    @property
    def keeps_state(self) -> bool:
        """Whether samples before are needed."""
        return self.timed or bool(self.places)

    @property
    def timed(self) -> bool:
        """Whether the time between samples is needed."""
        return self.lag is not None or any(self.uses(name) for name in ("slope", "time_s", "wdot", "step"))


def terms_of(compensation: Compensation) -> Terms:
    """Return the terms of a compensation."""
    terms, places = [], 0
    order = (*ADDED, *OF_THE_RATE)
    for place, held in enumerate(compensation.effects):
        twice = any(other.name == held.name for other in compensation.effects[:place])
        table = f"{held.name}_{place}" if twice else held.name
        if held.name == CONSTRUCTED:
            expression, places = _of_law(held.known.law, places)
            values = held.values if held.values.shape[1] > 1 else held.values[:, 0]
            terms.append(Term(held.known.called, table, values, FORMULAS[CONSTRUCTED]["unit"], expression, held.acts))
        else:
            terms.append(_term(compensation, held, table))
    terms.sort(key=lambda term: order.index(term.effect) if term.effect in order else len(order))
    slope = any("slope" in term.expression for term in terms)
    return Terms(tuple(terms), places + slope)


def _of_law(law: str, places: int) -> tuple[str, int]:
    """Return what a law adds to the output of gyro ``i``, and how many numbers are kept by now."""

    def call(name: str, inner: str, constant: str) -> str:
        nonlocal places
        if name not in _PLACES:
            told = f"{inner}, {constant}" if constant else inner
            return f"{ {'abs': 'fabs', 'sign': '{sign}'}.get(name, name) }({told})"
        place, places = places, places + _PLACES[name]
        told = {"lag": f"exp(-step / {constant}), 1e300", "play": f"1.0, 0.5 * {constant}"}.get(name, constant or "0.0")
        return f"{{{'last' if name == 'last' else 'follow'}}}{place}, i, {inner}, {told})"

    written = law_terms(law, _VARIABLES, call)
    column = "[{}]" if len(written) > 1 else ""
    return " + ".join(f"{{table}}[i]{column.format(n)} * {{value}}{term})" for n, term in enumerate(written)), places


def _term(compensation: Compensation, held: HeldEffect, table: str) -> Term:
    values = held.values[:, 0]
    if held.name == "g_sensitivity":
        values = held.values / GRAVITY_MPS2
    elif held.name == "acceleration_sensitivity":
        axes = compensation.array
        values = held.values[:, [0]] * axes.j + held.values[:, [1]] * axes.k
    expression = FORMULAS[held.name]["scalar"]
    if held.name == "warm_up":
        expression = expression.replace("{tau_s}", number(float(held.known.settings["time_constant_s"])))
    return Term(held.name, table, values, FORMULAS[held.name]["unit"], expression, held.acts)
