"""Tables of a terminal, all in one style."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table


def rich_table(title: str, heads: Sequence[str], align: str = "", *, fold: bool = False) -> Table:
    """Return a table without rows; ``align`` has "l" or "r" for each column, and the last for all that follow.

    With ``fold`` cells are broken into lines where there is no room, not cut.
    """
    table = Table(title=title, title_style="bold", title_justify="left")
    for head, side in zip(heads, align.ljust(len(heads), align[-1:] or "l"), strict=True):
        table.add_column(head, justify="right" if side == "r" else "left", overflow="fold" if fold else "ellipsis")
    return table
