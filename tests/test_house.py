"""The sizes that keep the house easy to find one's way in."""

import ast
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("drivers", "estimator", "sims", "station")

MOST_LINES, MOST_LINES_OF_A_FUNCTION, MOST_MODULES = 450, 60, 12
LONG_FUNCTIONS = {  # mathematics and tables: in parts they would be harder to check
    "station/run/table_watch.py: watch_table",
}
WIDE_FOLDERS = {"station/commands"}  # one module for each command


def modules() -> Iterator[Path]:
    """Yield every module of the packages."""
    for package in PACKAGES:
        yield from sorted((ROOT / package).rglob("*.py"))


def named(path: Path) -> str:
    """Return the path of a module in the repository."""
    return path.relative_to(ROOT).as_posix()


def test_a_module_is_short_enough_to_be_read_at_once() -> None:
    long = {named(path) for path in modules() if len(path.read_text(encoding="utf-8").splitlines()) > MOST_LINES}
    assert not long


def test_a_function_fits_a_screen() -> None:
    long = {
        f"{named(path)}: {node.name}"
        for path in modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
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
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                imported = {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
                sorter.add(module, *((imported & paths.keys()) - {module}))
    sorter.prepare()  # raises CycleError with the circle
