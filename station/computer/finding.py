"""What was found about the computer."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing about the computer that a person should know.

    ``about`` names it (a port, an interface, the clock), ``text`` says what is so, ``command`` is what helps, empty if
    no command does. ``wrong``: a run cannot work like this; else it is advice.
    """

    about: str
    text: str
    command: str = ""
    wrong: bool = False
