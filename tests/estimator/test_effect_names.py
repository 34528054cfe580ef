"""The name of an effect stands in the catalogue alone."""

import ast
from pathlib import Path

from estimator.effects.catalogue import records
from estimator.effects.constructed import CONSTRUCTED

ROOT = Path(__file__).parents[2]
KEYS_OF_FILES = {"estimator/importing/mapping"}
"""Where a word is the key of a file that a person writes, not an effect."""


def test_no_effect_is_named_in_the_source_outside_the_catalogue() -> None:
    names = {record.name for record in records() if record is not CONSTRUCTED}
    names |= {name.replace("_", " ") for name in names}
    found = []
    for package in ("estimator", "station"):
        for path in sorted((ROOT / package).rglob("*.py")):
            where = path.relative_to(ROOT).as_posix()
            if where.startswith("estimator/effects/") or any(where.startswith(folder) for folder in KEYS_OF_FILES):
                continue
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and node.value in names:
                    found.append(f"{where}:{node.lineno}: {node.value}")
    assert not found


def test_every_effect_of_the_catalogue_is_one_that_the_station_can_work_with() -> None:
    for record in records():
        record.check()
    names = {record.name for record in records()}
    beside = {record.odds.beside[0] for record in records() if record.odds.beside}
    assert beside <= names
