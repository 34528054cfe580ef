"""The operator's choices: bench, script, folder, and further options of the commands."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from station.atomic_write import new_recording

TWIN_SCALE = 5.0
"""Speed of runs whose devices are all twins in memory, unless another was asked for: a person can follow it."""


def twin_scale(load: float) -> float:
    """Return the speed of twins on the screen for a load by processor, 1 where all are busy."""
    return max(TWIN_SCALE / max(load, 1.0), 1.0)


def load_by_processor() -> float:
    """Return the load of the last minute by processor, 0 if the system does not tell it."""
    try:
        return os.getloadavg()[0] / (os.cpu_count() or 1)
    except (AttributeError, OSError):
        return 0.0


@dataclass(frozen=True, slots=True)
class Choices:
    """The options a run is started with. Empty texts stand for the built-in bench and the 360 s script.

    ``device_options`` are for every command that opens or plans for devices, ``run_options`` for the run only.
    """

    bench: str = ""
    script: str = ""
    folder: Path = Path("recordings")
    operator: str = ""
    serial: str = ""
    scale: float | None = None
    link_options: tuple[str, ...] = ()
    device_options: tuple[str, ...] = ()
    run_options: tuple[str, ...] = ()
    serial_reason: str = ""

    def check_arguments(self, all_twins: bool) -> list[str]:
        """Return the arguments of `station check`; twins in memory are asked in virtual time, whatever the scale."""
        scale = [] if self.scale is None or all_twins else ["--scale", f"{self.scale:g}"]
        return ["check", "--json", *_given(self.bench), *self.link_options, *self.device_options, *scale]

    def plan_arguments(self) -> list[str]:
        bench = ["--bench", self.bench] if self.bench else []
        return ["plan", "--json", *_given(self.script), *bench, *self.device_options]

    def run_arguments(self, recording: Path, scale: float | None) -> list[str]:
        """Return the arguments of `station run`, hosted, with JSON, into ``recording``; empty choices are left out.

        ``scale`` is the speed of time in place of that of the choices, left out if None. Options of links, devices and
        run come last.
        """
        given = {
            "--bench": self.bench,
            "--script": self.script,
            "--operator": self.operator,
            "--serial-number": self.serial,
            "--serial-reason": self.serial_reason,
            "--scale": "" if scale is None else f"{scale:g}",
            "--output": str(recording),
        }
        words = [word for option, value in given.items() if value for word in (option, value)]
        return ["run", "--host", "--json", *words, *self.link_options, *self.device_options, *self.run_options]

    def by_hand(self, all_twins: bool) -> Self:
        """Return the choices for manual mode on the same bench: no script, no serial number; twins in real time."""
        options = ("--manual", *(option for option in self.run_options if option == "--reset-fault"))
        scale = self.scale or (1.0 if all_twins else None)
        return replace(self, script="", serial="", serial_reason="", scale=scale, run_options=options)

    def new_recording(self) -> Path:
        """Return a path in the folder that is free."""
        return new_recording(self.folder)


def _given(text: str) -> list[str]:
    return [text] if text else []
