"""Texts and tables that ship beside the modules."""

from __future__ import annotations

import tomllib
from importlib import resources
from typing import Any


def packaged_text(package: str, name: str) -> str:
    """Return the text of a file that ships in a package."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


def packaged_toml(package: str, name: str) -> dict[str, Any]:
    """Return what a TOML file that ships in a package holds."""
    return tomllib.loads(packaged_text(package, name))
