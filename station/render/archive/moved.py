"""States of a device that have moved since an earlier run."""

from collections.abc import Sequence

from rich.markup import escape

from station.views.history import Move

_MOST_AFTER_RUN = 4  # named
_MOST_IN_LIST = 2


def moved_since(moves: Sequence[Move]) -> str:
    """Return, as markup, which states moved since the last comparable run; "" if none did.

    The first four are named, with their shifts in combined sigmas, and the others counted.
    """
    if not moves:
        return ""
    words = [move.words for move in moves[:_MOST_AFTER_RUN]]
    others = len(moves) - _MOST_AFTER_RUN
    if others > 0:
        words.append(f"and {others} more")
    since = escape(f"{moves[0].since_when} ({moves[0].since})")
    combined = escape(", ".join(words))
    return f"[bold yellow]MOVED[/] since {since}: {combined} combined sigmas; by chance this happens in one run of 370"


def moved_in(file: str, moves: Sequence[Move]) -> str:
    """Return, as markup, which states of a recording moved, in sigmas of both runs."""
    words = ", ".join(move.words for move in moves[:_MOST_IN_LIST])
    others = len(moves) - _MOST_IN_LIST
    more = f" and {others} more" if others > 0 else ""
    return f"[yellow]![/] {escape(file)} moved: {escape(words)}{more} (combined sigmas)"
