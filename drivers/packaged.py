"""Texts and tables in packages; among them the sentences for users, ``sentences.toml``."""

import tomllib
from functools import cache, partial
from importlib import resources
from typing import Any


def packaged_text(package: str, name: str) -> str:
    """Return the text of a file that ships in a package."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


@cache
def packaged_toml(package: str, name: str) -> dict[str, Any]:
    """Return the content of a TOML file in a package; it is read once and must not be changed."""
    return tomllib.loads(packaged_text(package, name))


def packaged_codes(package: str, device: str, kind: str) -> dict[int, str]:
    """Return the meanings of a device's numeric answers, from the codes.toml of a package."""
    return {int(code): text for code, text in packaged_toml(package, "codes.toml")[device][kind].items()}


def sentence_of(tables: dict[str, dict[str, str]], key: str, /, **values: object) -> str:
    """Return the sentence of a name, "table.name", its fields filled in by these values."""
    table, name = key.split(".")
    return tables[table][name].format(**values)


# Read at once: a fault must be reported even where no file can be opened any more.
sentence = partial(sentence_of, packaged_toml("drivers", "sentences.toml"))
