"""Laws: the error that an effect adds to the output of a gyro, as an expression of the gyro's conditions.

A law is text, as ``lag(T, 58)*gx``: names of variables, numbers, products, powers, quotients, and some functions. Three
of these remember: ``lag(x, c)`` follows x as a first-order lag of c seconds, ``play(x, c)`` as a linkage with a play of
c follows its drive (Krasnosel'skii, Pokrovskii 1989); ``last(x, c)`` is the sign that x had last beyond c, ``last(x)``
beyond a twentieth of its largest size: of the recording, or so far where conditions are causal. Terms of one law are
separated by semicolons, each with a coefficient of its own. Memory passes over what is not finite.

A law is parsed and compiled once; its variables are worked out once for each gyro under the same conditions.
"""

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from estimator.effects.conditions import Axes, Conditions, follow
from estimator.geometry.kinematics import AXES, GRAVITY_MPS2, into_body
from estimator.packaged import packaged_toml
from estimator.types import Floats

LAST_SHARE = 0.05
"""Share of the largest size beyond which a sign counts."""
_MOST_CHARACTERS = 2000
_EVEN = 1e-6  # share by which steps of time may differ and still be the same
_NAME = re.compile(r"\b[A-Za-z]\w*")
_CHARACTERS = re.compile(r"[A-Za-z0-9_.+\-*/(),; ]*")  # no comments, no line ends: laws stand in source code

VARIABLES: Mapping[str, tuple[str, str, str]] = {
    name.format(axis=axis): (depends, unit, words.format(axis=axis))
    for name, (depends, unit, words) in packaged_toml("estimator.effects", "law.toml").items()
    for axis in (AXES if "{axis}" in name else AXES[:1])
}
"""What a law may name: what it depends on, its unit, and what it is."""
_NEEDS = {"temperature": "temperature", "gravity": "specific force", "angle": "gimbals"}
_OF_GYROS = {
    **dict.fromkeys(("u", "a", "gs", "ms", "ns", *(f"u_{axis}" for axis in AXES)), "p"),
    **dict.fromkeys(("uj", "aj", "gj", "mj", "nj"), "j"),
    **dict.fromkeys(("uk", "ak", "gk", "mk", "nk"), "k"),
}
"""Variables that differ from gyro to gyro, and by which of its axes."""

Compiled = Callable[[Any], Floats]
"""A term of a law: its value (N,), or (), from what gives the value of each variable by name (``Variables``)."""


class LawError(ValueError):
    """A text that is not a law; the message says where."""


def columns_of(law: str, conditions: Conditions, axes: Axes) -> Floats:
    """Return the terms (N, terms) of a law under conditions at N instants, for a gyro with these axes.

    LawError for an invalid text.
    """
    variables = Variables(conditions, axes)
    terms = compiled(law)
    columns = np.empty((len(conditions.t_s), len(terms)))
    for column, term in zip(columns.T, terms, strict=True):
        column[:] = term(variables)
    return columns


@lru_cache(4096)
def needs_of(law: str) -> frozenset[str]:
    """Return the quantities that conditions must offer for a law."""
    parsed(law)  # or LawError
    names = _named_in(law)
    needs = {_NEEDS[VARIABLES[name][0]] for name in names if VARIABLES[name][0] in _NEEDS}
    return frozenset(needs | {"gimbals" for name in names if "_" in name})


def settled(law: str, above_k: float) -> tuple[Floats, Floats] | None:
    """Return the values of a law long after the start, ``above_k`` above the reference temperature, as biases and
    gains.

    Both are (terms,); gains are relative to the rate about the sense axis. None if the law depends on anything but
    temperature, time and that rate, or not linearly on the rate.
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
def variables_of(law: str) -> tuple[str, ...]:
    """Return the variables that a law names, in the order in which they come."""
    return tuple(dict.fromkeys(name for tree in parsed(law) for name in _names(tree)))


def _named_in(text: str) -> frozenset[str]:
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
    return not _OF_GYROS.keys().isdisjoint(_named_in(law))


def in_words(law: str) -> str:
    """Return a law in words: "bias proportional to temperature lagged by 58 s".

    A law of more than four terms is described by its variables and a function only.
    """
    if len(parsed(law)) > _MOST_TERMS_TOLD:
        about = " and ".join(VARIABLES[name][2] for name in variables_of(law))
        how = next((words for name, words in _MANY.items() if name in functions_of(law)), "terms")
        return f"bias that depends on {about} ({len(parsed(law))} {how})"
    words = [_in_words(tree) for tree in parsed(law)]
    return "bias proportional to " + " and to ".join(words)


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
        case ast.Call(func=ast.Name(id=name), args=[inner], keywords=[]) if name in _PLAIN:
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


_PLAIN: Mapping[str, Callable[[Any], Any]] = {
    name: getattr(np, name) for name in ("abs", "sign", "sqrt", "log1p", "expm1", "exp", "tanh", "cos", "sin")
}


class Variables:
    """The variables of laws for one gyro under given conditions, each computed when first used.

    The same holds for functions with memory, which take long: those of a law are computed once for all of its terms,
    and for all gyros while the conditions share them.
    """

    def __init__(self, conditions: Conditions, axes: Axes) -> None:
        self.causal = conditions.causal
        self._conditions, self._axes = conditions, axes
        self._own_memories: dict[str, Floats] = {}

    def __getitem__(self, name: str) -> Floats:
        axis = _OF_GYROS.get(name)
        key = name if axis is None else (name, getattr(self._axes, axis).tobytes())
        return self._conditions.once(key, lambda: np.array(_variable(name, self._conditions, self._axes)))

    def remembered(self, text: str, work: Compiled, *, of_gyro: bool) -> Floats:
        """Return what a function with memory gives, by its text; ``of_gyro``: it differs from gyro to gyro."""
        shared = None if of_gyro else self._conditions.memories
        known = self._own_memories if shared is None else shared
        if text not in known:
            known[text] = work(self)
        return known[text]

    @property
    def steps_s(self) -> Floats:
        """Time (N,) since the instant before, or (1,) if it is always the same."""
        return self._conditions.once("steps", lambda: _steps_s(self._conditions.t_s))


def _variable(name: str, c: Conditions, axes: Axes) -> Floats:
    """Return a variable (N,) of laws under conditions ``c``, for a gyro with these axes.

    The temperature counts from the reference, and is 0 if it is unknown; time counts from the first instant. ValueError
    for an axis that the table does not have.
    """
    match name:
        case "u" | "uj" | "uk":
            return np.asarray(c.w_rps @ getattr(axes, _OF_GYROS[name]))
        case "wx" | "wy" | "wz":
            return c.w_rps[:, AXES.index(name[1])]
        case "a" | "aj" | "ak":
            return np.asarray(c.wdot_rps2 @ getattr(axes, _OF_GYROS[name]))
        case "jolt":
            return np.asarray(np.linalg.norm(c.wdot_rps2, axis=1))
        case "speed":
            return np.asarray(np.linalg.norm(c.w_rps, axis=1))
        case "T":
            return np.zeros(len(c.t_s)) if c.temperature_c is None else c.temperature_c - c.reference_c
        case "Tdot":
            return c.warming_kps
        case "t":
            return np.asarray(c.t_s - c.t_s[0])
        case "gs" | "gj" | "gk":
            return np.asarray(c.specific_force_mps2 / GRAVITY_MPS2 @ getattr(axes, _OF_GYROS[name]))
        case "ms" | "mj" | "mk" | "ns" | "nj" | "nk":
            return np.asarray(_of_the_base("mn".index(name[0]), c) @ getattr(axes, _OF_GYROS[name]))
        case "gx" | "gy" | "gz":
            return c.specific_force_mps2[:, AXES.index(name[1])] / GRAVITY_MPS2
    what, axis = name.split("_")
    column = c.gimbals.index(axis)
    match what:
        case "angle":
            return c.angle_rad[:, column]
        case "rate":
            return c.rate_rps[:, column]
    return np.asarray(c.once(f"turning about {axis}", lambda: _turning_about(axis, c)) @ axes.p)


def _of_the_base(axis: int, c: Conditions) -> Floats:
    """Return a horizontal direction (N, 3) of the base of the table in body axes: x, 0, or y, 1."""
    return c.once(("base", axis), lambda: into_body(np.eye(3)[axis], c.angle_rad, c.gimbals))


def _turning_about(axis: str, c: Conditions) -> Floats:
    """Return the part of the body rate (N, 3), in body axes, that an axis of the table makes."""
    column = c.gimbals.index(axis)
    part = np.zeros((len(c.t_s), 3))
    part[:, AXES.index(axis)] = c.rate_rps[:, column]
    return into_body(part, c.angle_rad[:, column + 1 :], c.gimbals[column + 1 :])


@lru_cache(4096)
def compiled(law: str) -> tuple[Compiled, ...]:
    """Return the terms of a law as functions; LawError for a text that is none."""
    return tuple(_compiled(tree, term.strip()) for tree, term in zip(parsed(law), law.split(";"), strict=True))


def _compiled(node: ast.expr, text: str) -> Compiled:
    """Return a checked syntax tree as a function of the variables; LawError for syntax that laws do not have.

    ``text`` is the term that the tree is a part of.
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
            if name in _PLAIN:
                return function
            its_text = text[node.col_offset : node.end_col_offset]
            of_gyro = not _OF_GYROS.keys().isdisjoint(_named_in(its_text))
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
            return lambda known: _last_of_all(inner(known), causal=known.causal)
    plain = _PLAIN[name]
    return lambda known: np.asarray(plain(inner(known)))


_COMBINED: Mapping[type[ast.operator], Callable[[Floats, Floats], Floats]] = {
    ast.Add: np.add,
    ast.Sub: np.subtract,
    ast.Mult: np.multiply,
    ast.Div: np.divide,
}


def lagged(values: Floats, t_s: Floats, lag_s: float) -> Floats:
    """Return values (N,) at instants (N,) through a first-order lag that begins settled."""
    return follow(values, np.exp(-_steps_s(t_s) / lag_s))


def _steps_s(t_s: Floats) -> Floats:
    """Return the time (N,) since the instant before, or (1,) if it is always the same."""
    steps_s = np.diff(t_s)
    if len(steps_s) and np.ptp(steps_s) < _EVEN * steps_s[0]:
        return steps_s[:1]
    return np.maximum(np.diff(t_s, prepend=t_s[:1]), 0.0)


def played(values: Floats, width: float) -> Floats:
    """Return values (N,) after a play of total ``width``, starting in its middle at the first finite value.

    Values that are not finite are skipped, and returned unchanged.
    """
    out = np.array(values, dtype=np.float64)
    finite = np.flatnonzero(np.isfinite(out))
    x = out[finite]
    # From one instant to the next the play is limited to half a width about the value. Limits one after the other are
    # limits again, so those over 1, 2, 4, ... instants follow from each other, until all agree for any start.
    low, high = x - 0.5 * width, x + 0.5 * width
    low[:1] = high[:1] = x[:1]
    reach = 1
    while reach < len(x) and np.any(low < high):
        ends = low[reach:], high[reach:]
        low[reach:], high[reach:] = np.clip(low[:-reach], *ends), np.clip(high[:-reach], *ends)
        reach *= 2
    out[finite] = low
    return out


def last_sign(values: Floats, limit: Floats | None = None) -> Floats:
    """Return the sign (N,) of the last value beyond a limit, of the largest a twentieth; 0 before the first."""
    size = _finite_sizes(values)
    beyond = size > (LAST_SHARE * size.max(initial=0.0) if limit is None else limit)
    sign = np.where(beyond, np.sign(values), 0.0)
    last = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign)), -1))
    return np.asarray(np.where(last >= 0, sign[np.maximum(last, 0)], 0.0))


def _last_of_all(values: Floats, *, causal: bool) -> Floats:
    """Return the last sign (N,) of values; ``causal``: the largest value is that of those so far."""
    so_far = LAST_SHARE * np.maximum.accumulate(_finite_sizes(values)) if causal else None
    return last_sign(values, so_far)


def _finite_sizes(values: Floats) -> Floats:
    return np.where(np.isfinite(values), np.abs(values), 0.0)


def _same(left: ast.expr, right: ast.expr) -> bool:
    return ast.dump(left) == ast.dump(right)


def _one_side(node: ast.expr, side: str) -> str:
    """Return in words the part of a value less a constant that is on one side of zero, "beyond" or "below" it."""
    match node:
        case ast.BinOp(left=left, op=ast.Sub(), right=ast.Constant(value=int() | float() as limit)):
            return f"{_in_words(left)} {side} {limit:g}"
        case ast.BinOp(left=left, op=ast.Add(), right=ast.Constant(value=int() | float() as limit)):
            return f"{_in_words(left)} {side} {-limit:g}"
    return f"{_in_words(node)} {side} 0"


_POWERS = {"2": "square", "3": "cube"}
_CALLS = {
    "lag": "{} lagged by {} s",
    "play": "{} with a play of {}",
    "last": "the last direction of the {}",
    "abs": "the size of the {}",
    "sign": "the sign of the {}",
}


_MOST_TERMS_TOLD = 4
_MANY = {"play": "plays", "expm1": "decays", "abs": "bends", "lag": "lags"}
"""What a law of many terms is made of, by a function that these have."""


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
