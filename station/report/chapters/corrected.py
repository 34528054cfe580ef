"""What the chapter on the correction shows of effects: formulas, letters, numbers."""

import ast
from collections.abc import Sequence

from markupsafe import Markup

from estimator.calibration.compensation import HeldEffect
from estimator.effects.conditions import SLOPE_S
from estimator.effects.constructed import CONSTRUCTED
from estimator.effects.law import VARIABLES, parsed, variables_of
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


def formula_of(effect: HeldEffect) -> Markup:
    """Return what an effect adds to the outputs, with a factor a for each of its terms."""
    known = effect.known
    if known.record is CONSTRUCTED:
        terms = [Markup("<code>{}</code>").format(term.strip()) for term in known.law.split(";")]
    else:
        terms = [_typeset(tree) for tree in parsed(known.law)] if known.law else [Markup.escape(known.record.formula)]
    subs = [Markup("<sub>{}</sub>").format(n) if len(terms) > 1 else "" for n in range(1, len(terms) + 1)]
    factors = (Markup("<var>a</var>{} {}").format(*pair) for pair in zip(subs, terms, strict=True))
    return Markup(" + ").join(factors)


def _typeset(node: ast.expr) -> Markup:
    match node:
        case ast.Name(id="Tdot"):
            return Markup("d<var>T</var>/d<var>t</var>")
        case ast.Name(id=name):
            return Markup("<var>{}</var><sub>{}</sub>").format(name[0], name[1:].lstrip("_"))
        case ast.UnaryOp(operand=operand):
            return Markup("−{}").format(_typeset(operand))
        case ast.BinOp(left=left, op=ast.Pow(), right=right):
            return Markup("{}<sup>{}</sup>").format(_typeset(left), ast.unparse(right))
        case ast.BinOp(left=left, op=op, right=right):
            shown = {ast.Add: "({} + {})", ast.Sub: "({} − {})", ast.Div: "{} / {}"}.get(type(op), "{} {}")
            return Markup(shown).format(_typeset(left), _typeset(right))
        case ast.Call(func=ast.Name(id="abs"), args=[inner]):
            return Markup("|{}|").format(_typeset(inner))
        case ast.Call(func=ast.Name(id="expm1"), args=[inner]):
            return Markup("(exp({}) − 1)").format(_typeset(inner))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            return Markup("{}({})").format(name, Markup(", ").join(map(_typeset, arguments)))
    return Markup.escape(ast.unparse(node))


_MORE = {
    "u": ", found by iteration",
    "Tdot": f", taken over {SLOPE_S:g} s",
    "t": ", from switching on",
    **dict.fromkeys(("a", "aj", "ak", "jolt"), ", a difference of two samples"),
}


def variables_of_laws(effects: Sequence[HeldEffect]) -> list[str]:
    """Return what the variables mean in the laws of effects."""
    names = {name for effect in effects if effect.known.law for name in variables_of(effect.known.law)}
    return [f"{name}: {VARIABLES[name][2]} in {VARIABLES[name][1]}{_MORE.get(name, '')}" for name in sorted(names)]
