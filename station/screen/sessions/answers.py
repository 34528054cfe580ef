"""What the station's commands answer to the screen as JSON, read back as values."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, Self, TypeVar

Value = TypeVar("Value")


@dataclass(kw_only=True, frozen=True, slots=True)
class Reply(Generic[Value]):
    """The end of a command: its exit code, and its answer or, if that is None, the ``reason`` in words."""

    code: int
    value: Value | None
    reason: str


@dataclass(kw_only=True, frozen=True, slots=True)
class InvestigationAnswer:
    """The answer of `station investigate`, also as it is stored beside a recording.

    ``next_script`` is the script that tells explanations apart, None if none is needed. ``view`` is the whole object:
    it may be damaged, or of another version of the station.
    """

    verdict: str
    next_script: str | None
    view: Mapping[str, Any]

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the answer in an object of JSON; KeyError or ValueError for an object without a verdict."""
        if not data["verdict"]:
            raise ValueError("an investigation without a verdict")
        return cls(verdict=str(data["verdict"]), next_script=data.get("next_script"), view=data)
