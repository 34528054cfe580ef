"""Laws of effects as expressions of another language."""

import ast
from collections.abc import Callable, Mapping

from estimator.effects.law import parsed
from station.exports.written import number

_OPERATORS: Mapping[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}


def law_terms(law: str, names: Mapping[str, str], call: Callable[[str, str, str], str]) -> list[str]:
    """Return each term of a law, every operation in brackets; ``names`` are those of its variables.

    ``call`` writes a function from its name, its argument, and its constant: that of a power, too; "" if it has none.
    """

    def written(node: ast.expr) -> str:
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
