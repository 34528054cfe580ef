"""The command `station study`: which study, what is checked before the long work, what is printed."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from station.atomic_write import check_new_file, check_picture
from station.errors import UsageError
from station.studies import detection, paper, printed

EXIT_INCOMPLETE = 1


def command_study(arguments: argparse.Namespace) -> int:
    """Run a study; 0 if all of it ran, 1 if some seeds failed, 2 for wrong usage."""
    run, show, object_of = _STUDIES[arguments.study]
    study = run(arguments, scheduler=arguments.scheduler, workers=arguments.jobs, quiet=arguments.json)
    files = {name: getattr(arguments, name) for name in _FILES if hasattr(arguments, name)}
    if arguments.json:
        print(json.dumps({**object_of(study), **files}))
    else:
        show(study)
        for name, path in files.items():
            if path:
                print(f"{_FILES[name]}: {path}")
    for failure in study.failures:
        print(f"station: seed {failure.item} failed: {failure.reason}", file=sys.stderr)
    return EXIT_INCOMPLETE if study.failures else 0


def _paper(arguments: argparse.Namespace, **where: Any) -> paper.PaperStudy:
    picture = Path(arguments.plot) if arguments.plot else None
    output = Path(arguments.output) if arguments.output else None
    if picture is not None:
        check_picture(picture)
    if output is not None:
        check_new_file(output, "--output")
    study = paper.run_study(arguments.seeds, **where)
    if picture is not None or output is not None:
        recording = paper.our_recording(paper.MEMS_NOISE, 0)
        ours = paper.our_curve(recording)
        if picture is not None:
            printed.draw_convergence(picture, ours, study.letter)
        if output is not None:
            paper.write_curves(output, recording, ours, study.letter)
    return study


def _detection(arguments: argparse.Namespace, **where: Any) -> detection.DetectionStudy:
    groups = [name.strip() for name in arguments.effects.split(",")]
    known = {*detection.GROUPS, *detection.KNOWN, *detection.UNKNOWN}
    for group in groups:
        if group not in known:
            raise UsageError(f"--effects: there is no {group}; choose from {', '.join(sorted(known))}")
    try:
        sizes = [float(size) for size in arguments.sizes.split(",")]
    except ValueError:
        raise UsageError(f"--sizes takes numbers, for instance 1,0.3,0.1, not {arguments.sizes}") from None
    return detection.run_study(groups, sizes, arguments.seeds, **where)


_FILES = {"plot": "picture", "output": "curves"}
_STUDIES: dict[str, tuple[Callable[..., Any], Callable[[Any], None], Callable[[Any], dict[str, Any]]]] = {
    "paper": (_paper, printed.print_paper, printed.paper_object),
    "detection": (_detection, printed.print_detection, printed.detection_object),
}
"""By name: what runs a study, what prints it, what --json says of it."""
