"""Templates lay out and word what comes ready from typed values; no type checker sees what they compute."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from jinja2 import Environment, nodes

PACKAGE = Path(__file__).parents[2] / "station"
WORDED = sorted((PACKAGE / "report/templates").glob("*.html"))
COMPUTING = (
    nodes.Assign,
    nodes.BinExpr,  # arithmetic; of text the operator ~ is another
    nodes.Compare,
    nodes.ExprStmt,  # the statement "do"
    nodes.Getitem,
    nodes.Slice,
)
LAYOUT_FILTERS = {"join", "safe", "trim"}


@pytest.mark.parametrize("path", WORDED, ids=lambda path: path.name)
def test_templates_of_a_report_hold_text_and_layout(path: Path) -> None:
    assert list(computed(path.read_text(encoding="utf-8"))) == []


@pytest.mark.parametrize(
    "text",
    [
        "{% do rows.append(1) %}",
        "{% set cells = [] %}",
        "{{ gyro.states[0] }}",
        "{{ value * factor }}",
        "{% if size > 1 %}large{% endif %}",
        "{{ figures.plain(value) }}",
        "{{ rows | length }}",
    ],
)
def test_what_computes_is_found(text: str) -> None:
    assert list(computed(text)) != []


def test_the_screen_has_no_templates() -> None:
    assert not list((PACKAGE / "screen").rglob("templates"))


def computed(template: str) -> Iterator[str]:
    """Yield what a template computes: statements, operators, calls of anything but macros, filters of values."""
    tree = Environment(extensions=["jinja2.ext.do"]).parse(template)
    for node in tree.find_all(nodes.Node):
        line = f"line {node.lineno}: {type(node).__name__}"
        if isinstance(node, COMPUTING) and not isinstance(node, nodes.And | nodes.Or):
            yield line
        elif isinstance(node, nodes.Call) and not isinstance(node.node, nodes.Name):
            yield f"{line} of a function"
        elif isinstance(node, nodes.Filter) and node.name not in LAYOUT_FILTERS:
            yield f"{line} {node.name}"
