"""The grammar of laws: which variables and functions they may name, and what follows from those named."""

import ast
import re
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from estimator.geometry.kinematics import AXES
from estimator.packaged import packaged_toml

_MOST_CHARACTERS = 2000
_NAME = re.compile(r"\b[A-Za-z]\w*")
_CHARACTERS = re.compile(r"[A-Za-z0-9_.+\-*/(),; ]*")  # no comments, no line ends: laws stand in source code

VARIABLES: Mapping[str, tuple[str, str, str]] = {
    name.format(axis=axis): (depends, unit, words.format(axis=axis))
    for name, (depends, unit, words) in packaged_toml("estimator.effects", "law.toml").items()
    for axis in (AXES if "{axis}" in name else AXES[:1])
}
"""What a law may name: what it depends on, its unit, and what it is."""
_NEEDS = {"temperature": "temperature", "gravity": "specific force", "angle": "gimbals"}
OF_GYROS = {
    **dict.fromkeys(("u", "a", "gs", "ms", "ns", *(f"u_{axis}" for axis in AXES)), "p"),
    **dict.fromkeys(("uj", "aj", "gj", "mj", "nj"), "j"),
    **dict.fromkeys(("uk", "ak", "gk", "mk", "nk"), "k"),
}
"""Variables that differ from gyro to gyro, and by which of its axes."""
PLAIN_FUNCTIONS: Mapping[str, Callable[[Any], Any]] = {
    name: getattr(np, name) for name in ("abs", "sign", "sqrt", "log1p", "expm1", "exp", "tanh", "cos", "sin")
}


class LawError(ValueError):
    """A text that is not a law; the message says where."""


@lru_cache(4096)
def needs_of(law: str) -> frozenset[str]:
    """Return the quantities that conditions must offer for a law."""
    parsed(law)  # or LawError
    names = named_in(law)
    needs = {_NEEDS[VARIABLES[name][0]] for name in names if VARIABLES[name][0] in _NEEDS}
    return frozenset(needs | {"gimbals" for name in names if "_" in name})


@lru_cache(4096)
def variables_of(law: str) -> tuple[str, ...]:
    """Return the variables that a law names, in the order in which they come."""
    return tuple(dict.fromkeys(name for tree in parsed(law) for name in _names(tree)))


def named_in(text: str) -> frozenset[str]:
    """Return the variables that a text names."""
    return frozenset(_NAME.findall(text)) & VARIABLES.keys()


def _names(tree: ast.expr) -> list[str]:
    return [node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and node.id in VARIABLES]


def _varies(tree: ast.expr) -> bool:
    return any(isinstance(node, ast.Name) and node.id in VARIABLES for node in ast.walk(tree))


@lru_cache(4096)
def functions_of(law: str) -> frozenset[str]:
    """Return the functions that a law calls; "/" for a quotient by something that is no number."""
    nodes = [node for tree in parsed(law) for node in ast.walk(tree)]
    calls = {node.func.id for node in nodes if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}
    divided = any(isinstance(n, ast.BinOp) and isinstance(n.op, ast.Div) and _names(n.right) for n in nodes)
    return frozenset(calls | ({"/"} if divided else set()))


def axes_of(law: str) -> tuple[str, ...]:
    """Return the axes of a table that a law names."""
    return tuple(dict.fromkeys(name.partition("_")[2] for name in variables_of(law) if "_" in name))


def of_each_gyro(law: str) -> bool:
    """Return whether a law differs from gyro to gyro: it names something along or about the sense axis."""
    parsed(law)  # or LawError
    return not OF_GYROS.keys().isdisjoint(named_in(law))


@lru_cache(4096)
def parsed(law: str) -> tuple[ast.expr, ...]:
    """Return the terms of a law, separated by semicolons, as syntax trees.

    LawError for anything outside the grammar, and for a law that is no text, empty or too long.
    """
    if not isinstance(law, str) or not law.strip() or len(law) > _MOST_CHARACTERS:
        raise LawError(f"{law!r}: a law is a text of 1 to {_MOST_CHARACTERS} characters")
    if not _CHARACTERS.fullmatch(law):
        raise LawError(f"{law!r} has a character that no law has")
    trees = []
    for term in law.split(";"):
        try:
            tree = ast.parse(term.strip(), mode="eval").body
        except (SyntaxError, RecursionError, ValueError):
            raise LawError(f"{term.strip()!r} is no term of a law") from None
        _check_grammar(tree)
        trees.append(tree)
    return tuple(trees)


def _check_grammar(node: ast.expr) -> None:
    """Raise LawError if a syntax tree is not within the grammar of laws.

    That is numbers, known variables, + - * /, whole powers, a minus sign, functions of one argument, and lag, play and
    last of an expression with a variable, with a positive constant (last also without).
    """
    match node:
        case ast.Constant(value=int() | float()):
            return
        case ast.Name(id=name) if name in VARIABLES:
            return
        case ast.BinOp(op=ast.Mult() | ast.Div() | ast.Sub() | ast.Add()):
            _check_grammar(node.left)
            _check_grammar(node.right)
        case ast.BinOp(op=ast.Pow(), right=ast.Constant(value=int())):
            _check_grammar(node.left)
        case ast.UnaryOp(op=ast.USub()):
            _check_grammar(node.operand)
        case ast.Call(func=ast.Name(id=name), args=[inner], keywords=[]) if name in PLAIN_FUNCTIONS:
            _check_grammar(inner)
        case ast.Call(func=ast.Name(id="last"), args=[inner], keywords=[]) if _varies(inner):
            _check_grammar(inner)
        case ast.Call(
            func=ast.Name(id="lag" | "play" | "last"),
            args=[inner, ast.Constant(value=int() | float() as size)],
            keywords=[],
        ) if _varies(inner) and 0 < size < np.inf:
            _check_grammar(inner)
        case _:
            raise LawError(f"{ast.unparse(node)!r} is not of the grammar of laws")
