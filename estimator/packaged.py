"""Tables in packages; among them the sentences for users, ``sentences.toml``."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Any


@cache
def packaged_toml(package: str, name: str) -> dict[str, Any]:
    """Return the content of a TOML file in a package; it is read once and must not be changed."""
    return tomllib.loads(files(package).joinpath(name).read_text(encoding="utf-8"))


def sentence(key: str, /, **values: object) -> str:
    """Return the sentence of a name, "table.name", its fields filled in by ``values``; others are ignored.

    KeyError for an unknown name, or a field without a value.
    """
    table, name = key.split(".")
    text: str = packaged_toml("estimator", "sentences.toml")[table][name]
    return text.format(**values)
