"""Tables of a terminal, all in one style."""

from collections.abc import Iterable, Sequence

from rich.console import OverflowMethod
from rich.table import Table


def rich_table(
    title: str | None,
    heads: Sequence[str],
    align: str = "",
    rows: Iterable[Sequence[str]] = (),
    *,
    fold: bool = False,
    centred: bool = False,
) -> Table:
    """Return a table; ``align`` has "l" or "r" for each column, "d" for a dim "r", the last for all others.

    With ``fold`` cells are broken into lines where there is no room, not cut. ``centred`` is the title.
    """
    table = Table(title=title, title_style="bold", title_justify="center" if centred else "left")
    overflow: OverflowMethod = "fold" if fold else "ellipsis"
    for head, side in zip(heads, align.ljust(len(heads), align[-1:] or "l"), strict=True):
        style = "dim" if side == "d" else None
        table.add_column(head, justify="left" if side == "l" else "right", style=style, overflow=overflow)
    for row in rows:
        table.add_row(*row)
    return table
