"""Texts made from templates in packages: wording in the templates, values in Python."""

import math
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment


def rendered(package: str, name: str, values: Mapping[str, Any]) -> str:
    """Return the text of template ``name`` in the folder templates of a package.

    In .html, .xml and .rich every text is escaped except markupsafe.Markup. None is printed as nothing; an unknown name
    raises jinja2.UndefinedError. Templates also have the functions of ``station.views`` for values in readable units,
    and ``state_figures``: the states in the usual units, unless ``values`` has others; ``state_units`` has of each
    name, unit and factor.
    """
    from station.views.figures import STATE_FIGURES

    figures = values.get("state_figures", STATE_FIGURES)
    units = [(figure.name, figure.unit, figure.factor) for figure in figures]
    shown = {**values, "state_figures": figures, "state_units": units}
    return _environment(package, name.endswith(".rich")).get_template(name).render(shown)


@cache
def _environment(package: str, rich: bool) -> "Environment":
    """Return the jinja2 environment for the templates of a package, with the shared functions and filters.

    Undefined names are errors. With ``rich`` values are escaped for rich's markup; else None is printed as nothing.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

    from station.views.figures import (
        OUTCOME_STYLES,
        dph,
        human,
        number,
        percent,
        probability,
    )

    environment = Environment(
        loader=PackageLoader(package),
        autoescape=select_autoescape(),
        undefined=StrictUndefined,
        finalize=_for_rich if rich else lambda value: "" if value is None else value,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        extensions=["jinja2.ext.do"],
    )
    shared = (dph, human, number, percent, probability, math.degrees, math.isfinite)
    environment.globals |= {function.__name__: function for function in shared}
    environment.globals |= {"outcome_styles": OUTCOME_STYLES, "inf": math.inf}
    constructed = "estimator.effects.constructed"  # with numpy: not before a text names an effect
    words = environment.globals["words"] = lambda called: import_module(constructed).readable(called)
    environment.filters["words"] = words
    return environment


def _for_rich(value: Any) -> str:
    """Return a value as text for a rich console, escaped unless it is Markup already."""
    from markupsafe import Markup
    from rich.markup import escape

    return "" if value is None else value if isinstance(value, Markup) else escape(str(value))
