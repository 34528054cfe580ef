"""Texts made of templates that ship beside the modules: what is for people stands there, values are made in Python."""

from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def rendered(package: str, name: str, values: Mapping[str, Any]) -> str:
    """Return the text of a template in the folder templates of a package.

    In .html every text is escaped but markupsafe.Markup; None is nothing; a name that is not given raises
    jinja2.UndefinedError.
    """
    return _environment(package).get_template(name).render(values)


@cache
def _environment(package: str) -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    return Environment(
        loader=PackageLoader(package),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        finalize=lambda value: "" if value is None else value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
