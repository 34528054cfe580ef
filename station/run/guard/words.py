"""Messages between the station and its guard."""

from dataclasses import dataclass

READY, ARM, DISMISS = b"r", b"a", b"d"
"""The guard can act; the devices are the station's from now on; they are safe, or were never touched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Order:
    """The guard's instructions.

    ``devices`` are packed drivers (``drivers.recipe``) in the order of making safe, ``locks`` the descriptors that lock
    their links, ``pid`` is the station's process, ``who`` its name, ``log`` the file for the guard's actions, and
    ``time_scale`` is how fast the clock runs.
    """

    devices: tuple[bytes, ...]
    locks: tuple[int, ...]
    pid: int
    who: str
    log: str
    time_scale: float
