"""Contents of a bench file and a script before any device is asked: names, patterns, limits, the motion."""

import math
import os
import re
import shutil
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from station.bench.bench import Limits
    from station.screen.choices import Choices
    from station.scripts.planned import PlannedMotion

_LEAST_FREE_MB = 10.0  # the 360 s script with four gyros of 100 Hz takes 6 MB

ANYTHING = r".*\S.*"
"""Pattern of operators and serial numbers where the bench file gives none: something must be entered."""


@dataclass(frozen=True, slots=True, eq=False)
class Prospect:
    """A bench and a script, or ``manual``, or what is wrong with either; ``files`` are suggestions for names.

    The script takes ``least_s``, or up to ``longer_s`` more. ``shift_s`` is how long an operator counts as confirmed.
    ``limits`` and ``motion`` are None while bench and script cannot be read.
    """

    bench: str = ""
    bench_wrong: str = ""
    operator_pattern: str = ANYTHING
    serial_pattern: str = ANYTHING
    shift_s: float = math.inf
    all_twins: bool = False
    limits: "Limits | None" = None
    script: str = ""
    script_wrong: str = ""
    least_s: float = math.nan
    longer_s: float = 0.0
    motion: "PlannedMotion | None" = None
    folder_wrong: str = ""
    files: tuple[str, ...] = ()
    manual: bool = False


def look_ahead(choices: "Choices") -> Prospect:
    """Read bench and script, and see to the folder; not for the thread that paints: it loads numpy, a disk may hang."""
    found = _read(choices.bench, choices.script, choices.device_options)
    files = sorted(str(path) for pattern in ("*.toml", "*/*.toml") for path in Path().glob(pattern))
    return replace(found, folder_wrong=folder_trouble(choices.folder), files=tuple(files))


def _read(bench_path: str, script_path: str, device_options: tuple[str, ...]) -> Prospect:
    """Read bench and script, the built-in ones for empty paths; errors are part of the result.

    A bench that cannot be read gives a result with ``bench_wrong`` alone. ``device_options`` are options of the command
    line, of which the values of ``--device`` are used.
    """
    from station.bench.bench import load_bench
    from station.errors import ScriptError, UsageError
    from station.opening import needs_only_memory, with_links
    from station.scripts.planned import planned_motion
    from station.scripts.script import check, load_script, paper_script

    devices = [word for option, word in pairwise(device_options) if option == "--device"]
    try:
        bench = with_links(load_bench(Path(bench_path) if bench_path else None), {}, devices)
    except UsageError as error:
        return Prospect(bench_wrong=str(error))
    found = Prospect(
        bench=bench.name,
        operator_pattern=bench.operator_pattern or ANYTHING,
        serial_pattern=bench.serial_pattern or ANYTHING,
        shift_s=bench.shift_s,
        all_twins=needs_only_memory(bench),
        limits=bench.limits,
    )
    try:
        script = paper_script()
        if script_path:
            script = load_script(Path(script_path), bench.plugin_files, bench.table.gimbals[0])
        script = check(script, bench.table.limits)
    except ScriptError as error:
        return replace(found, script_wrong=str(error))
    motion = planned_motion(script, bench.table.gimbals)
    span = script.span
    return replace(found, script=script.name, least_s=span.least_s, longer_s=span.longer_s, motion=motion)


def matches(pattern: str, text: str) -> bool:
    """Return whether a pattern matches all of a text; an invalid pattern matches everything."""
    try:
        return re.fullmatch(pattern, text) is not None
    except re.error:
        return True


def folder_trouble(folder: Path) -> str:
    """Return why recordings cannot be written to a folder, "" if they can.

    For one that does not exist yet, the nearest folder above is looked at: a file, no permission, less than 10 MB free.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free_mb = shutil.disk_usage(there).free / 1e6
    for wrong, words in (
        (not there.is_dir(), f"{there} is a file"),
        (not os.access(there, os.W_OK | os.X_OK), f"{there.absolute()} cannot be written"),
        (free_mb < _LEAST_FREE_MB, f"the disk of {there.absolute()} is almost full ({free_mb:.1f} MB left)"),
    ):
        if wrong:
            return f"{words}: choose another folder with --folder"
    return ""
