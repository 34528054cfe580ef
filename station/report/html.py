"""HTML put together from elements: text is escaped, tables have the headers that a screen reader wants."""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from html import escape
from typing import ParamSpec

P = ParamSpec("P")

_VOID = frozenset({"br", "img", "meta"})


class Markup(str):
    """Text that is HTML already; every other text is escaped."""

    __slots__ = ()


Content = str | None
"""Markup, text, or nothing."""
BLANK = Markup('<span class="blank"></span>')
"""A line to be filled in by hand."""


def element(tag: str, *content: Content, **attributes: str | float | None) -> Markup:
    """Return an element. ``class_`` is the attribute class, ``data_h5`` data-h5; those that are None are left out."""
    named = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{escape(str(value))}"'
        for name, value in attributes.items()
        if value is not None
    )
    return Markup(f"<{tag}{named}>" if tag in _VOID else f"<{tag}{named}>{joined(content)}</{tag}>")


def joined(content: Iterable[Content]) -> Markup:
    """Return pieces one after the other."""
    return Markup("".join(c if isinstance(c, Markup) else escape(c, quote=False) for c in content if c is not None))


def composed(pieces: Callable[P, Iterable[Content]]) -> Callable[P, Markup]:
    """Return a function that joins the pieces which another yields."""

    @wraps(pieces)
    def whole(*arguments: P.args, **options: P.kwargs) -> Markup:
        return joined(pieces(*arguments, **options))

    return whole


def paragraph(*content: Content, class_: str | None = None) -> Markup:
    """Return a paragraph."""
    return element("p", *content, class_=class_)


def bullets(items: Iterable[Content]) -> Markup:
    """Return a list, or nothing without items."""
    found = [element("li", item) for item in items]
    return element("ul", *found) if found else Markup("")


def facts(pairs: Iterable[tuple[str, Content]]) -> Markup:
    """Return names and what they are, two columns; pairs without content are left out."""
    rows = [
        element("tr", element("th", name, scope="row"), element("td", content))
        for name, content in pairs
        if content is not None and content != ""
    ]
    return element("table", element("tbody", *rows), class_="facts")


def table(
    caption: Content,
    heads: Sequence[Content],
    rows: Sequence[Sequence[Content]],
    *,
    align: str,
    notes: Content = None,
) -> Markup:
    """Return a table whose first column names its rows; ``align`` has "l" or "r" for each column."""
    body = element("tbody", *(_row(row, align) for row in rows))
    return _table(caption, heads, [body], align, len(rows), notes)


def grouped(
    caption: Content,
    heads: Sequence[Content],
    groups: Sequence[tuple[Content, Sequence[Sequence[Content]]]],
    *,
    align: str,
    notes: Content = None,
) -> Markup:
    """Return a table of groups of rows; the first column names the group, the second the row."""
    bodies = []
    for name, rows in groups:
        # Not one cell over all rows: browsers break no page within such a cell, nor between it and the heading.
        heads_of = [element("th", name, scope="rowgroup"), *([element("td")] * (len(rows) - 1))]
        lines = [_row(row, align[1:], before=head) for row, head in zip(rows, heads_of, strict=True)]
        bodies.append(element("tbody", *lines, class_="group"))
    return _table(caption, heads, bodies, align, sum(len(rows) for _, rows in groups), notes)


_LONG_ROWS = 24  # more do not fit below a heading: such a table may be broken between rows


def _table(
    caption: Content, heads: Sequence[Content], bodies: Sequence[Markup], align: str, rows: int, notes: Content
) -> Markup:
    columns = (element("th", head, scope="col", class_=_class(side)) for head, side in zip(heads, align, strict=True))
    whole = element(
        "table",
        element("caption", caption),
        element("thead", element("tr", *columns)),
        *bodies,
        class_="long" if rows > _LONG_ROWS else None,
    )
    return joined([whole, paragraph(notes, class_="note") if notes else None])


def _row(cells: Sequence[Content], align: str, before: Markup | None = None) -> Markup:
    first, *others = zip(cells, align, strict=True)
    named = element("th", first[0], scope="row")
    return element("tr", before, named, *(element("td", cell, class_=_class(side)) for cell, side in others))


def _class(side: str) -> str | None:
    return "n" if side == "r" else None


def picture(source: str, alternative: str, caption: Content, size: tuple[float, float]) -> Markup:
    """Return a figure of an image given as a data URI; ``size`` is in inches."""
    image = element("img", src=source, alt=alternative, width=round(96 * size[0]), height=round(96 * size[1]))
    return element("figure", image, element("figcaption", caption))
