"""No sentence fails when it is to be told: each is there, and is given the values of its fields."""

from __future__ import annotations

import ast
from importlib.resources import files
from pathlib import Path
from string import Formatter

import pytest

from estimator.packaged import packaged_toml, sentence


@pytest.mark.parametrize("package", ["station", "drivers", "estimator"])
def test_every_sentence_is_told_with_the_values_of_its_fields(package: str) -> None:
    asked = {}
    for path in Path(str(files(package))).rglob("*.py"):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == sentence.__name__:
                asked[ast.literal_eval(call.args[0])] = {keyword.arg for keyword in call.keywords}
    tables = packaged_toml(package, "sentences.toml")
    fields = {
        f"{table}.{name}": {field for _, field, _, _ in Formatter().parse(text) if field is not None}
        for table, texts in tables.items()
        for name, text in texts.items()
    }
    assert asked == fields
