"""The sizes that keep the house easy to find one's way in."""

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from jinja2 import Environment, nodes

ROOT = Path(__file__).parents[1]
PACKAGES = ("drivers", "estimator", "sims", "station")

MOST_LINES, MOST_LINES_OF_A_FUNCTION, MOST_MODULES = 450, 60, 12
LONG_FUNCTIONS = {  # mathematics and tables: in parts they would be harder to check
    "station/run/table_watch.py: watch_table",
    # Results with many values, each named in a line of its own.
    "estimator/estimation/joint.py: _estimated",
    "estimator/importing/clocks/timefit.py: fit_times",
    "estimator/tracing/investigate.py: _conclude",
}
LONG_MODULES = {  # for the same reason, by a few lines
    "estimator/estimation/joint.py",
    "estimator/importing/importing.py",
    "station/run/session.py",
}
WIDE_FOLDERS = {
    "station/commands",  # one module for each command
    "station/run",  # one module for each part of a run, none of which makes sense without the session
}


def modules() -> Iterator[Path]:
    """Yield every module of the packages."""
    for package in PACKAGES:
        yield from sorted((ROOT / package).rglob("*.py"))


@cache
def nodes_of(path: Path) -> tuple[ast.AST, ...]:
    """Return all nodes of the tree of a module."""
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


def named(path: Path) -> str:
    """Return the path of a module in the repository."""
    return path.relative_to(ROOT).as_posix()


def test_a_module_is_short_enough_to_be_read_at_once() -> None:
    long = {named(path) for path in modules() if len(path.read_text(encoding="utf-8").splitlines()) > MOST_LINES}
    assert long == LONG_MODULES


def test_a_function_fits_a_screen() -> None:
    long = {
        f"{named(path)}: {node.name}"
        for path in modules()
        for node in nodes_of(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and (node.end_lineno or 0) - node.lineno >= MOST_LINES_OF_A_FUNCTION
    }
    assert long == LONG_FUNCTIONS


def test_a_folder_holds_what_can_be_kept_in_mind() -> None:
    folders = {path.parent for path in modules()}
    wide = {
        named(folder)
        for folder in folders
        if sum(path.name != "__init__.py" for path in folder.glob("*.py")) > MOST_MODULES
    }
    assert wide == WIDE_FOLDERS


def test_every_folder_of_modules_is_a_package() -> None:
    bare = {named(path.parent) for path in modules() if not (path.parent / "__init__.py").exists()}
    assert not bare


def test_no_import_runs_in_a_circle_not_even_for_types() -> None:
    paths = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in modules()
    }
    sorter: TopologicalSorter[str] = TopologicalSorter()
    for module, path in paths.items():
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
                sorter.add(module, *((imported & paths.keys()) - {module}))
    sorter.prepare()  # raises CycleError with the circle


def test_nothing_but_the_kinds_of_steps_asks_of_which_kind_a_step_is() -> None:
    kinds = ROOT / "station" / "scripts" / "steps"
    steps = _subclasses("Step", sorted(kinds.glob("*.py")))
    assert {"Rest", "Move", "Rotate"} < steps
    assert not [place for path, place in _places_that_ask_for(steps) if kinds not in path.parents]


MOST_ASKING_FOR_REFERENCES = 35


def test_few_places_ask_of_which_kind_a_reference_is() -> None:
    """A reference is asked for what it can give, so that a new kind of it does not touch every module."""
    readings = _subclasses("Reference", [ROOT / "estimator/recordings/reference.py"])
    in_mappings = {"Measured", "Rests", "StatedTurns"}
    assert {"TableReadings", "RateReadings", "Turns"} < readings
    assert len(list(_places_that_ask_for(readings | in_mappings))) <= MOST_ASKING_FOR_REFERENCES


def _subclasses(base: str, paths: Iterable[Path]) -> set[str]:
    """Return the name of a class and those of the classes in some modules that derive from it."""
    found = {base}
    for path in paths:
        for node in nodes_of(path):
            if isinstance(node, ast.ClassDef) and any(isinstance(b, ast.Name) and b.id == base for b in node.bases):
                found.add(node.name)
    return found


def _places_that_ask_for(classes: set[str]) -> Iterator[tuple[Path, str]]:
    """Yield each module and place that compares a value with one of some classes."""
    for path in modules():
        for node in nodes_of(path):
            if isinstance(node, ast.Call | ast.MatchClass) and classes & set(_classes_asked_for(node)):
                yield path, f"{named(path)}, line {node.lineno}"


def _classes_asked_for(node: ast.Call | ast.MatchClass) -> Iterator[str]:
    """Yield the names of the classes that ``isinstance`` or a pattern compares with."""
    compared: ast.AST | None = None
    if isinstance(node, ast.MatchClass):
        compared = node.cls
    elif isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass") and len(node.args) == 2:
        compared = node.args[1]
    if compared is not None:
        yield from (name.id for name in ast.walk(compared) if isinstance(name, ast.Name))


def test_a_kind_of_step_is_one_file_and_one_line() -> None:
    registry = (ROOT / "station/scripts/steps/registry.py").read_text(encoding="utf-8")
    made = {"pose": {"station/scripts/whole_imu/family.py"}, "sine": set()}  # where the station makes such steps itself
    for kind, places in made.items():
        own = f"station.scripts.steps.{kind}"
        importing = {
            named(path)
            for path in modules()
            for node in nodes_of(path)
            if isinstance(node, ast.ImportFrom | ast.Import)
            and own in {getattr(node, "module", None), *(alias.name for alias in node.names)}
        }
        assert importing == places
        assert sum(f'"{kind}"' in line for line in registry.splitlines()) == 1


MOST_POSITIONAL = 5


def test_a_constructor_names_its_values() -> None:
    """More than five values in a row say nothing of what they are, and the order of two of a kind is easily wrong."""
    unnamed = {
        f"{named(path)}, line {node.lineno}: {called}"
        for path in modules()
        for node in nodes_of(path)
        if isinstance(node, ast.Call)
        and ((called := _name_of(node.func)) == "cls" or called[:1].isupper())
        and len(node.args) > MOST_POSITIONAL
    }
    assert not unnamed


def _name_of(function: ast.expr) -> str:
    """Return the last name of what is called; empty for anything without a name."""
    if isinstance(function, ast.Attribute):
        return function.attr
    return function.id if isinstance(function, ast.Name) else ""


TEXTS_FOR_PEOPLE = ("station/render",)
"""Packages whose templates hold text alone."""
COMPUTING = (nodes.ExprStmt, nodes.Assign, nodes.AssignBlock, nodes.BinExpr, nodes.Neg, nodes.Pos, nodes.Getitem)
LOGIC = (nodes.And, nodes.Or)


def test_templates_for_people_hold_text_only() -> None:
    """What a template computes is seen by no type checker; values come ready from Python, which has one."""
    environment = Environment(extensions=["jinja2.ext.do"])
    computing = set()
    for package in TEXTS_FOR_PEOPLE:
        templates = [path for path in sorted((ROOT / package / "templates").rglob("*")) if path.is_file()]
        assert templates, f"{package} has no templates"
        for path in templates:
            tree = environment.parse(path.read_text(encoding="utf-8"))
            computing |= {f"{named(path)}, line {node.lineno}: {type(node).__name__}" for node in _computed_in(tree)}
    assert not computing


def _computed_in(template: nodes.Template) -> Iterator[nodes.Node]:
    """Yield what is more than text: statements, assignments, arithmetic, subscripts, comparisons with non-strings."""
    for node in template.find_all(nodes.Node):
        is_computing = isinstance(node, COMPUTING) and not isinstance(node, LOGIC)
        if is_computing or (isinstance(node, nodes.Compare) and not _compares_strings(node)):
            yield node


def _compares_strings(comparison: nodes.Compare) -> bool:
    """Return whether a value is only compared, for equality, with strings that stand in the template."""
    return all(
        operand.op in ("eq", "ne") and isinstance(operand.expr, nodes.Const) and isinstance(operand.expr.value, str)
        for operand in comparison.ops
    )


def test_what_the_benches_import_is_there() -> None:
    """Benches run by hand only: a name that moved would be noticed when one is needed."""
    missing = set()
    for path in sorted((ROOT / "tests" / "bench").rglob("*.py")):
        for node in nodes_of(path):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in PACKAGES:
                missing |= {
                    f"{named(path)}: {node.module}.{a.name}" for a in node.names if not _has(node.module, a.name)
                }
    assert not missing


def _has(module: str, name: str) -> bool:
    """Return whether a module defines or imports a name, or a package holds a module of this name."""
    place = ROOT.joinpath(*module.split("."))
    source = place.with_suffix(".py")
    if not source.exists():
        return hasattr(import_module(module), name) or find_spec(f"{module}.{name}") is not None
    return name in _names_in(source)


@cache
def _names_in(path: Path) -> set[str]:
    names = set()
    for node in nodes_of(path):
        match node:
            case ast.FunctionDef() | ast.AsyncFunctionDef() | ast.ClassDef():
                names.add(node.name)
            case ast.Import() | ast.ImportFrom():
                names |= {(alias.asname or alias.name).split(".")[0] for alias in node.names}
            case ast.Assign() | ast.AnnAssign():
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names |= {part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)}
    return names
