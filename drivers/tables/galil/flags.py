"""Flags within a word of a device."""

from collections.abc import Callable
from typing import Any


def flag(word_of: Callable[[Any], int], mask: int, what: str, *, when_low: bool = False) -> property:
    """Return a property: whether a bit of a word is set, or not set where that is what it says ``when_low``."""
    return property(lambda device: bool(word_of(device) & mask) is not when_low, doc=what)
