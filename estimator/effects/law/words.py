"""Laws in words."""

import ast

from estimator.effects.law.grammar import VARIABLES, functions_of, parsed, variables_of

_POWERS = {"2": "square", "3": "cube"}
_CALLS = {
    "lag": "{} lagged by {} s",
    "play": "{} with a play of {}",
    "last": "the last direction of the {}",
    "abs": "the size of the {}",
    "sign": "the sign of the {}",
}
_MOST_TERMS_IN_WORDS = 4
_MANY = {"play": "plays", "expm1": "decays", "abs": "bends", "lag": "lags"}
"""What a law of many terms is made of, by a function that these have."""


def in_words(law: str) -> str:
    """Return a law in words: "bias proportional to temperature lagged by 58 s".

    A law of more than four terms is described by its variables and a function only, and so is a weighted sum of more
    than four. LawError for an invalid text.
    """
    trees = parsed(law)
    weighted = _weighted_sum(trees[0]) if len(trees) == 1 else []
    weighted = weighted if len(weighted) > 1 else []
    count = max(len(trees), len(weighted))
    if count > _MOST_TERMS_IN_WORDS:
        about = " and ".join(VARIABLES[name][2] for name in variables_of(law))
        how = next((words for name, words in _MANY.items() if name in functions_of(law)), "terms")
        return f"bias that depends on {about} ({count} {how}{', one shape for all gyros' if weighted else ''})"
    if weighted:
        words = [f"{factor:.3g} x ({_in_words(tree)})" for factor, tree in weighted]
        return "bias proportional to " + " + ".join(words).replace("+ -", "- ")
    return "bias proportional to " + " and to ".join(_in_words(tree) for tree in trees)


def _weighted_sum(node: ast.expr) -> list[tuple[float, ast.expr]]:
    """Return the numbers and the terms of a sum of terms, each with a number before it; empty if it is no such sum."""
    match node:
        case ast.BinOp(left=left, op=ast.Add(), right=ast.BinOp(left=factor, op=ast.Mult(), right=term)):
            first = _weighted_sum(left)
            number = _number(factor)
            return [*first, (number, term)] if first and number is not None else []
        case ast.BinOp(left=factor, op=ast.Mult(), right=term) if (number := _number(factor)) is not None:
            return [(number, term)]
    return []


def _number(node: ast.expr) -> float | None:
    match node:
        case ast.Constant(value=int() | float() as value):
            return float(value)
        case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as value)):
            return -float(value)
    return None


def _in_words(node: ast.expr) -> str:
    """Return a syntax tree in words; parts without words of their own as they are written."""
    match node:
        case ast.BinOp(
            left=ast.Call(func=ast.Name(id="abs"), args=[inner]), op=ast.Add() | ast.Sub() as op, right=right
        ) if _same(inner, right):
            return _one_side(inner, "beyond" if isinstance(op, ast.Add) else "below")
        case ast.Name(id=name):
            return VARIABLES[name][2]
        case ast.Call(func=ast.Name(id=name), args=[inner, *numbers]):
            return _CALLS.get(name, name + " of ({})").format(_in_words(inner), *map(ast.unparse, numbers))
        case ast.BinOp(left=left, op=ast.Mult() | ast.Div() as op, right=right):
            return f"{_in_words(left)} {'times' if isinstance(op, ast.Mult) else 'over'} {_in_words(right)}"
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            power = ast.unparse(right)
            return f"the {_POWERS.get(power, f'power {power}')} of the {_in_words(left)}"
    return ast.unparse(node)


def _one_side(node: ast.expr, side: str) -> str:
    """Return in words the part of a value less a constant that is on one side of zero, "beyond" or "below" it."""
    match node:
        case ast.BinOp(left=left, op=ast.Sub(), right=ast.Constant(value=int() | float() as limit)):
            return f"{_in_words(left)} {side} {limit:g}"
        case ast.BinOp(left=left, op=ast.Add(), right=ast.Constant(value=int() | float() as limit)):
            return f"{_in_words(left)} {side} {-limit:g}"
    return f"{_in_words(node)} {side} 0"


def _same(left: ast.expr, right: ast.expr) -> bool:
    return ast.dump(left) == ast.dump(right)
