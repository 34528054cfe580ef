"""Laws as functions of their variables, compiled once, and their values under conditions."""

import ast
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache

import numpy as np

from estimator.effects.conditions import Axes, Conditions, follow
from estimator.effects.law.grammar import (
    OF_GYROS,
    PLAIN_FUNCTIONS,
    LawError,
    functions_of,
    named_in,
    parsed,
    variables_of,
)
from estimator.effects.law.memory import last_of_all, last_sign, played
from estimator.effects.law.variables import Compiled, Variables
from estimator.types import Floats

_COMBINED: Mapping[type[ast.operator], Callable[[Floats, Floats], Floats]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}


def columns_of(law: str, conditions: Conditions, axes: Axes) -> Floats:
    """Return the terms (N, terms) of a law under conditions at N instants, for a gyro with these axes.

    LawError for an invalid text, ValueError for an axis that the table does not have.
    """
    variables = Variables(conditions, axes)
    terms = compiled(law)
    columns = np.empty((len(conditions.t_s), len(terms)))
    for column, term in zip(columns.T, terms, strict=True):
        column[:] = term(variables)
    return columns


def settled(law: str, above_k: float) -> tuple[Floats, Floats] | None:
    """Return the values of a law long after the start, ``above_k`` above the reference temperature, as biases and
    gains.

    Both are (terms,); gains are relative to the rate about the sense axis. None if the law depends on anything but
    temperature, time and that rate, on memory, or not linearly on the rate; LawError for an invalid text.
    """
    if not set(variables_of(law)) <= {"T", "t", "u"} or functions_of(law) & {"lag", "play", "last"}:
        return None
    steady = {"T": np.asarray(above_k), "t": np.asarray(np.inf)}
    with np.errstate(all="ignore"):
        none, one, other = (
            np.array([term({**steady, "u": np.asarray(u)}) for term in compiled(law)]) for u in (0.0, 1.0, -2.0)
        )
    gain = one - none
    linear = np.isfinite(gain) & np.isclose(other, none - 2 * gain)
    return (none, gain) if linear.all() else None


@lru_cache(4096)
def compiled(law: str) -> tuple[Compiled, ...]:
    """Return the terms of a law as functions; LawError for a text that is none."""
    return tuple(_compiled(tree, term.strip()) for tree, term in zip(parsed(law), law.split(";"), strict=True))


def _compiled(node: ast.expr, text: str) -> Compiled:
    """Return a checked syntax tree as a function of the variables; LawError for syntax that laws do not have.

    Functions with memory are computed once and remembered, by their own text. ``text`` is the term that the tree is a
    part of.
    """
    match node:
        case ast.Constant(value=int() | float() as number):
            constant = np.asarray(float(number))
            return lambda known: constant
        case ast.Name(id=name):
            return lambda known: np.asarray(known[name])
        case ast.UnaryOp(operand=operand):
            positive = _compiled(operand, text)
            return lambda known: -positive(known)
        case ast.BinOp(left=left, op=ast.Pow(), right=ast.Constant(value=int() as power)):
            base = _compiled(left, text)
            return lambda known: np.asarray(base(known) ** power)
        case ast.BinOp(left=left, op=op, right=right):
            combine = _COMBINED[type(op)]
            first = _compiled(left, text)
            second = _compiled(right, text)
            return lambda known: combine(first(known), second(known))
        case ast.Call(func=ast.Name(id=name), args=[inner, *numbers]):
            function = _call(name, _compiled(inner, text), [ast.literal_eval(number) for number in numbers])
            if name in PLAIN_FUNCTIONS:
                return function
            its_text = text[node.col_offset : node.end_col_offset]
            of_gyro = not OF_GYROS.keys().isdisjoint(named_in(its_text))
            return lambda known: known.remembered(its_text, function, of_gyro=of_gyro)
    raise LawError(ast.unparse(node))


def _call(name: str, inner: Compiled, numbers: Sequence[float]) -> Compiled:
    """Return a law's function ``name``, with its constants ``numbers``, applied to a compiled argument.

    lag and play need one constant, last has one or none, all others none.
    """
    match name, numbers:
        case "lag", [lag_s]:
            return lambda known: follow(inner(known), np.exp(-known.steps_s / float(lag_s)))
        case "play", [width]:
            return lambda known: played(inner(known), float(width))
        case "last", [limit]:
            return lambda known: last_sign(inner(known), np.asarray(float(limit)))
        case "last", []:
            return lambda known: last_of_all(inner(known), causal=known.causal)
    plain = PLAIN_FUNCTIONS[name]
    return lambda known: np.asarray(plain(inner(known)))
