"""What the station and its guard say to each other."""

from dataclasses import dataclass

READY, ARM, DISMISS = b"r", b"a", b"d"
"""The guard can act; the devices are the station's from now on; they are safe, or were never touched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """What a guard is told.

    ``devices`` are packed drivers (``drivers.recipe``) in the order in which they are made safe, ``locks`` the
    descriptors that lock their links, ``pid`` is the station's process, ``who`` names it, ``log`` is the file for what
    the guard did, and ``time_scale`` is how fast the clock runs.
    """

    devices: tuple[bytes, ...]
    locks: tuple[int, ...]
    pid: int
    who: str
    log: str
    time_scale: float
