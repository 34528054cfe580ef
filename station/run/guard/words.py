"""What the station and its guard say to each other."""

from dataclasses import dataclass

READY, ARM, DISMISS = b"r", b"a", b"d"
"""The guard can act; the table is the station's from now on; the table is at rest, or was never touched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What a guard is told.

    ``table`` is a packed driver (``drivers.tables.recipe``), ``locks`` the descriptors that lock its links, ``pid`` is
    the station's process, ``who`` names it, ``log`` is the file for what the guard did, and ``time_scale`` is how fast
    the clock runs.
    """

    table: bytes
    locks: tuple[int, ...]
    pid: int
    who: str
    log: str
    time_scale: float
