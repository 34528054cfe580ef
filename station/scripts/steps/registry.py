"""The kinds of steps by name: built in, of installed packages, and of files that were given."""

from collections.abc import Iterable
from pathlib import Path

from drivers.plugins import Registry, load_files
from station.scripts.steps.kind import StepKind

_PLACE = "station.scripts.steps"

STEPS: Registry[StepKind] = Registry(
    StepKind,
    "turntable_station.steps",
    {
        "rest": f"{_PLACE}.rest",
        "move": f"{_PLACE}.move",
        "rotate": f"{_PLACE}.rotate",
        "pose": f"{_PLACE}.pose",
        "sine": f"{_PLACE}.sine",
    },
)
"""The built-in kinds and those of installed packages; each module holds its record as ``SPEC``."""


def known_steps(plugins: Iterable[Path] = ()) -> Registry[StepKind]:
    """Return all kinds that a script may use, those of these Python files included; PluginError for a bad file."""
    return STEPS.beside(load_files(plugins))
