"""The answer of `station check`, as --json prints it and as the screen reads it back."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from station.computer.finding import Finding
from station.opening.checking import DeviceCheck
from station.views.typed_json import view_of


@dataclass(kw_only=True, frozen=True, slots=True)
class BenchCheck:
    """What each device answered, the table first, and findings on this computer. ``ok``: nothing is wrong.

    ``version`` counts changes of the JSON object that break its readers.
    """

    version: int = 1
    ok: bool
    devices: tuple[DeviceCheck, ...]
    computer: tuple[Finding, ...] = ()


def bench_check_of(data: Mapping[str, Any]) -> BenchCheck:
    """Return the answer in an object of JSON; KeyError, TypeError or ValueError if it is none."""
    return view_of(BenchCheck, data)
