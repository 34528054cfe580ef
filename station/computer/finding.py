"""Findings about the computer."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One remark on the computer.

    ``about`` is the subject (a port, an interface, the clock), ``text`` the remark, ``command`` what helps, empty if no
    command does. ``wrong``: a run cannot work like this; otherwise it is advice.
    """

    about: str
    text: str
    command: str = ""
    wrong: bool = False
