"""What the tables of all studies share."""

from collections.abc import Iterable

from rich.markup import escape

from station.render.terminal import Shown


def list_of(title: str, lines: Iterable[str]) -> list[Shown]:
    """Return a title and the lines below it, each with a dash, after an empty line."""
    how = {"highlight": False}
    return [("", how), (f"[bold]{escape(title)}[/]", how), *((f"- {escape(line)}", how) for line in lines)]
