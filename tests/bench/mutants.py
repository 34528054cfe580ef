"""Mutation score: how many small changes of a module its tests notice.

    python tests/bench/mutants.py estimator.estimation.gram tests/estimator/test_calibrate.py [--most 60]
    python tests/bench/mutants.py --all

Each mutant is one change of the module's syntax tree: a comparison, an operator of arithmetic or logic, a number, a
condition, a returned value. The tests run in a fresh process with the mutated module in the place of the module. What
survives is printed with its line: a change that means the same, or a behaviour that no test shows.
"""

from __future__ import annotations

import argparse
import ast
import importlib.util
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]

WHAT = {
    "estimator.estimation.gram": ["tests/estimator/test_model.py", "tests/estimator/test_calibrate.py"],
    "estimator.estimation.joint": ["tests/estimator/test_joint.py", "tests/estimator/test_error_model.py"],
    "station.run.outcome": ["tests/station/test_outcome.py"],
    "station.run.sequencer": ["tests/station/test_uncommanded.py", "tests/station/test_run.py"],
    "drivers.tables.modbus.cia402": ["tests/drivers/test_cia402.py"],
    "drivers.tables.galil.language": ["tests/drivers/test_galil.py"],
    "drivers.tables.acutrol.language": ["tests/drivers/test_acutrol.py"],
    "drivers.imus.stim300.codec": ["tests/drivers/test_stim300.py"],
    "drivers.imus.vectornav.codec": ["tests/drivers/test_vectornav.py"],
    "drivers.imus.xsens.xbus": ["tests/drivers/test_xbus.py"],
    "drivers.imus.xsens.mtdata2": ["tests/drivers/test_xbus.py"],
    "drivers.imus.aceinna.codec": ["tests/drivers/test_j1939_imu.py"],
}
"""Modules whose score is to be at least 85 %, and the tests that show their behaviour."""

_COMPARED = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
}  # fmt: skip
_COMPUTED = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitAnd,
}  # fmt: skip

_RUNNER = """
import importlib.abc, importlib.util, sys
name, path = sys.argv[1], sys.argv[2]
class Finder(importlib.abc.MetaPathFinder):
    def find_spec(self, fullname, where, target=None):
        return importlib.util.spec_from_file_location(name, path) if fullname == name else None
sys.meta_path.insert(0, Finder())
import pytest
sys.exit(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *sys.argv[3:]]))
"""


def mutants(source: str) -> Iterator[tuple[int, str, str]]:
    """Yield line, description and text of every mutant of a module."""
    count = sum(1 for _ in _places(ast.parse(source)))
    for number in range(count):
        tree = ast.parse(source)
        node = next(node for i, node in enumerate(_places(tree)) if i == number)
        before = ast.unparse(node)
        _change(node)
        after = ast.unparse(ast.fix_missing_locations(node))
        if after != before:
            yield node.lineno, f"{before[:70]}  ->  {after[:70]}", ast.unparse(ast.fix_missing_locations(tree))


def _places(tree: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    documented = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    # Annotations, and how a class is made by its decorator, are no behaviour.
    for node in ast.walk(tree):
        said = [getattr(node, name, None) for name in ("annotation", "returns")] + getattr(node, "decorator_list", [])
        documented |= {id(inner) for part in said if part is not None for inner in ast.walk(part)}
    for node in ast.walk(tree):
        if id(node) in documented:
            continue
        number = isinstance(node, ast.Constant) and type(node.value) in (int, float, bool) and hasattr(node, "lineno")
        computed = isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _COMPUTED
        signed = isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not)
        if number or computed or signed or isinstance(node, ast.Compare | ast.BoolOp | ast.If | ast.IfExp):
            yield node  # type: ignore[misc]


def _change(node: ast.expr | ast.stmt) -> None:
    if isinstance(node, ast.Compare):
        node.ops[0] = _COMPARED[type(node.ops[0])]()
    elif isinstance(node, ast.BoolOp):
        node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
    elif isinstance(node, ast.If | ast.IfExp):
        node.test = ast.UnaryOp(ast.Not(), node.test)
    elif isinstance(node, ast.BinOp | ast.AugAssign):
        node.op = _COMPUTED[type(node.op)]()
    elif isinstance(node, ast.UnaryOp):
        node.op = ast.UAdd() if isinstance(node.op, ast.USub) else ast.Not()
        if isinstance(node.op, ast.Not):
            node.operand = ast.UnaryOp(ast.Not(), node.operand)
    elif isinstance(node, ast.Constant):
        node.value = not node.value if isinstance(node.value, bool) else node.value + 1


def score(module: str, tests: Sequence[str], most: int, seed: int) -> float:
    """Print what survived of at most so many mutants, and return the share that was noticed."""
    spec = importlib.util.find_spec(module)
    assert spec is not None
    assert spec.origin is not None
    every = list(mutants(Path(spec.origin).read_text(encoding="utf-8")))
    tried = every if len(every) <= most else sorted(random.Random(seed).sample(every, most))
    present = [test for test in tests if (ROOT / test).exists()]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mutated.py"
        path.write_text(Path(spec.origin).read_text(encoding="utf-8"), encoding="utf-8")
        begun = time.monotonic()
        if not _passes(module, path, present, 300.0):
            raise SystemExit(f"{module}: its tests fail without any change")
        patience_s = 10.0 + 4 * (time.monotonic() - begun)
        survived = 0
        for line, what, text in tried:
            path.write_text(text, encoding="utf-8")
            if _passes(module, path, present, patience_s):
                survived += 1
                print(f"  survived  {module}:{line}  {what}", flush=True)
    noticed = 1 - survived / max(len(tried), 1)
    print(f"{module}: {noticed:.0%} of {len(tried)} mutants noticed, of {len(every)} possible", flush=True)
    return noticed


def _passes(module: str, path: Path, tests: Sequence[str], patience_s: float) -> bool:
    command = [sys.executable, "-c", _RUNNER, module, str(path), *tests]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, timeout=patience_s)
    except subprocess.TimeoutExpired:
        return False  # a change by which the tests come to no end is noticed
    return done.returncode == 0


def main() -> int:
    """Try the mutants; return 0 if every module reaches 85 %."""
    parser = argparse.ArgumentParser(description="mutation score of a module")
    parser.add_argument("module", nargs="?")
    parser.add_argument("tests", nargs="*")
    parser.add_argument("--all", action="store_true", help="every module of the list")
    parser.add_argument("--most", type=int, default=60, help="mutants a module, drawn at random")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    what = WHAT if arguments.all else {arguments.module: arguments.tests or WHAT[arguments.module]}
    scores = [score(module, tests, arguments.most, arguments.seed) for module, tests in what.items()]
    return 0 if min(scores) >= 0.85 else 1


if __name__ == "__main__":
    raise SystemExit(main())
