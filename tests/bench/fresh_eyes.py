"""Functions drawn at random, shown as signature and docstring with the body hidden, for a reader who explains them.

The reader writes down what each function does, with the cases it treats in a special way, and compares that with the
bodies afterwards. A function that was misread gets a better docstring or a better name.

    python tests/bench/fresh_eyes.py --seed 1              40 functions, the bodies hidden
    python tests/bench/fresh_eyes.py --seed 1 --bodies     the same functions with their bodies
    python tests/bench/fresh_eyes.py --below drivers/links --count 10
"""

from __future__ import annotations

import argparse
import ast
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = ("drivers", "estimator", "sims", "station")


@dataclass(frozen=True, slots=True)
class Function:
    """A function of the source, its class in front of its name, with its lines in two parts."""

    path: str
    line: int
    name: str
    head: str
    """Decorators, signature and docstring."""
    body: str


def functions(folder: Path, at_least: int) -> list[Function]:
    """Return the functions of ``at_least`` lines in the modules of ``folder``, by path and line.

    Lines are counted from ``def`` to the end of the body, docstring included. Nested functions are listed as well.
    """
    found: list[Function] = []
    for path in sorted(folder.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for name, node in _defined(ast.parse(text), ""):
            if (node.end_lineno or 0) - node.lineno + 1 >= at_least:
                found.append(_split(path.relative_to(ROOT).as_posix(), name, node, text.splitlines()))
    return found


def _defined(node: ast.AST, prefix: str) -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef]]:
    """Yield the functions below ``node`` with their qualified names, in the order of the source."""
    for child in ast.iter_child_nodes(node):
        name = f"{prefix}{getattr(child, 'name', '')}"
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            yield name, child
            yield from _defined(child, f"{name}.")
        elif isinstance(child, ast.ClassDef):
            yield from _defined(child, f"{name}.")
        else:
            yield from _defined(child, prefix)


def _split(path: str, name: str, node: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> Function:
    """Split the source of a function behind its docstring, or behind its signature if it has none."""
    first = min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])
    body_from = node.body[0].lineno - 1
    if ast.get_docstring(node) is not None:
        body_from = node.body[0].end_lineno or body_from
    head = "\n".join(lines[first - 1 : body_from])
    body = "\n".join(lines[body_from : node.end_lineno])
    return Function(path, node.lineno, name, head, body)


def _place(seed: int, function: Function) -> bytes:
    """Return the place of a function in a draw, which does not move when others come or go."""
    return hashlib.sha256(f"{seed} {function.path} {function.name}".encode()).digest()


def main() -> None:
    """Draw functions and print them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40, help="functions to draw (default: 40)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draw (default: 1)")
    parser.add_argument("--lines", type=int, default=8, help="least length of a function in lines (default: 8)")
    parser.add_argument("--below", nargs="*", default=PACKAGES, help="folders to draw from (default: all packages)")
    parser.add_argument("--bodies", action="store_true", help="print the bodies as well")
    arguments = parser.parse_args()
    pool = [function for folder in arguments.below for function in functions(ROOT / folder, arguments.lines)]
    drawn = sorted(pool, key=partial(_place, arguments.seed))[: arguments.count]
    for number, function in enumerate(drawn, 1):
        print(f"--- {number} {function.path}:{function.line} {function.name}")
        print(function.head)
        if arguments.bodies:
            print(function.body)
    print(f"--- {len(drawn)} of {len(pool)} functions of at least {arguments.lines} lines, seed {arguments.seed}")


if __name__ == "__main__":
    main()
