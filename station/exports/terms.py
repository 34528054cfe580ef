"""The correction as terms that C and Python write nearly alike: tables of numbers, an expression over gyro ``i``.

What the languages write differently stands in braces: names of tables, helpers that laws call. Names are those of
``variables.toml``, and ``step``, the time since the sample before.
"""

import ast
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.packaged import packaged_toml
from drivers.types import Floats
from estimator.calibration.compensation import Compensation
from estimator.effects.effect import Acts
from estimator.effects.law import parsed
from estimator.geometry.kinematics import GRAVITY_MPS2
from station.exports.written import number

AXIS_TABLES = ("axis", "axis_j", "axis_k")
"""Names of the tables of sense and tilt axes."""
SPELLED: Mapping[str, Mapping[str, str]] = packaged_toml("station.exports", "variables.toml")
"""What the variables of laws are called: in "scalar" code for gyro ``i`` of one sample, in numpy for "rows" of them."""
_OPERATORS: Mapping[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_SCALAR = {name: text.replace("GRAVITY", number(GRAVITY_MPS2)) for name, text in SPELLED["scalar"].items()}
_MAY_FAIL = re.compile(r"(?!fabs)\b[a-z0-9]+\(|/ \(")
"""What may be no number: functions, quotients by what is measured; products are infinite at the worst."""
_PLACES = {"lag": 1, "play": 1, "last": 2}
"""Numbers that each function with memory keeps for a gyro."""


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class Term:
    """One effect: the name of its table, the table (n,) or (n, p), its unit, and the expression for gyro ``i``.

    "{table}" in the expression stands for the table's name. ``acts`` is the point in the chain where it acts.
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
    """All terms in the order of correction; ``places`` is the count of state variables kept for each gyro."""

    all: tuple[Term, ...]
    places: int

    def of(self, acts: Acts) -> tuple[Term, ...]:
        """Return the terms that act at this place of the chain."""
        return tuple(term for term in self.all if term.acts is acts)

    @property
    def lag(self) -> Term | None:
        """Return the lag of the output, if it has one."""
        return next(iter(self.of(Acts.LAG)), None)

    def uses(self, name: str, acts: Acts | None = None) -> bool:
        """Return whether any expression uses a name such as "warmth"; with ``acts`` only terms that act there count."""
        some = self.all if acts is None else self.of(acts)
        return any(re.search(rf"\b{name}\b", term.expression) for term in some)

    @property
    def given_to_the_rate(self) -> list[str]:
        """Return the further names on which effects of the rate depend."""
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
    """Return the terms of a compensation, with their values by gyro, in the order in which it has its effects.

    A second effect of one name has its number behind the name of its table. An effect without a law has an empty
    expression. One place more is counted if any term uses the slope of the temperature.
    """
    terms, places = [], 0
    for place, held in enumerate(compensation.effects):
        twice = any(other.name == held.name for other in compensation.effects[:place])
        table = f"{held.name}_{place}" if twice else held.name
        expression, law = "", held.known.law
        if law:
            expression, places = _of_law(law, places)
        unit = ", ".join(dict.fromkeys(size.unit for size in held.known.sizes))
        called, of = held.known.called, law or held.known.record.formula
        values = held.values if held.values.shape[1] > 1 else held.values[:, 0]
        terms.append(
            Term(
                effect=called if of in called else f"{called} ({of})",
                table=table,
                values=values,
                unit=unit,
                expression=expression,
                acts=held.acts,
            )
        )
    slope = any("slope" in term.expression for term in terms)
    return Terms(tuple(terms), places + slope)


def _of_law(law: str, places: int) -> tuple[str, int]:
    """Return the expression of a law's contribution to gyro ``i``, and the next free place for a state variable.

    Functions with memory (lag, play, last) take state variables, from ``places`` on. Placeholders in braces stand
    for what differs between languages.
    """

    def call(name: str, inner: str, constant: str) -> str:
        """Return a call of the function ``name`` as text for a C-like program, with its argument ``inner``.

        ``constant`` is the lag in s, the width of play or the limit, "" for none. A function with a memory takes the
        next places in the memory of the program.
        """
        nonlocal places
        if name not in _PLACES:
            arguments = f"{inner}, {constant}" if constant else inner
            return f"{ {'abs': 'fabs', 'sign': '{sign}'}.get(name, name) }({arguments})"
        place, places = places, places + _PLACES[name]
        arguments = {"lag": f"exp(-step / {constant}), 1e300", "play": f"1.0, 0.5 * {constant}"}.get(
            name, constant or "0.0"
        )
        return f"{{{'last' if name == 'last' else 'follow'}}}{place}, i, {inner}, {arguments})"

    written = law_terms(law, _SCALAR, call)
    column = "[{}]" if len(written) > 1 else ""
    guarded = ["{value}" + term + ")" if _MAY_FAIL.search(term) else term for term in written]
    return " + ".join(f"{{table}}[i]{column.format(n)} * {term}" for n, term in enumerate(guarded)), places


def law_terms(law: str, names: Mapping[str, str], call: Callable[[str, str, str], str]) -> list[str]:
    """Return each term of a law as text, every operation in brackets; ``names`` translates its variables.

    ``call(name, argument, constant)`` writes a function; a power is "pow", and the constant is "" if there is none.
    """

    def written(node: ast.expr) -> str:
        """Return a syntax tree as text for a C-like program; squares and cubes of variables become products."""
        match node:
            case ast.Constant(value=int() | float() as value):
                return number(float(value))
            case ast.Name(id=name):
                return names[name]
            case ast.UnaryOp(operand=operand):
                return f"(-{written(operand)})"
            case ast.BinOp(left=ast.Name(id=name), op=ast.Pow(), right=ast.Constant(value=int() as n)) if 1 < n < 4:
                return f"({' * '.join([names[name]] * n)})"
            case ast.BinOp(left=left, op=ast.Pow(), right=right):
                return call("pow", written(left), written(right))
            case ast.BinOp(left=left, op=op, right=right):
                return f"({written(left)} {_OPERATORS[type(op)]} {written(right)})"
            case ast.Call(func=ast.Name(id=name), args=[inner, *constant]):
                return call(name, written(inner), written(constant[0]) if constant else "")
        raise AssertionError(ast.unparse(node))  # the grammar has been checked

    return [written(tree) for tree in parsed(law)]
