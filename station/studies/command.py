"""The command `station study`: which study, what is checked before the long work, what is printed."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from station.campaigns.campaigns import Failure
from station.errors import UsageError
from station.exports.investigation_file import check_new_file
from station.studies import baselines, detection, paper, printed
from station.studies.pictures import check_picture, draw_convergence

EXIT_INCOMPLETE = 1


def command_study(arguments: argparse.Namespace) -> int:
    """Run a study; 0 if all of it ran, 1 if some seeds failed, 2 for wrong usage."""
    failures = _STUDIES[arguments.study](arguments)
    for failure in failures:
        print(f"station: seed {failure.item} failed: {failure.reason}", file=sys.stderr)
    return EXIT_INCOMPLETE if failures else 0


def _paper(arguments: argparse.Namespace) -> tuple[Failure, ...]:
    picture = Path(arguments.plot) if arguments.plot else None
    output = Path(arguments.output) if arguments.output else None
    if picture is not None:
        check_picture(picture)
    if output is not None:
        check_new_file(output, "--output")
    study = paper.run_study(arguments.seeds, **_where(arguments))
    if picture is not None or output is not None:
        recording = paper.our_recording(paper.MEMS_NOISE, 0)
        ours = paper.our_curve(recording)
        if picture is not None:
            draw_convergence(picture, ours, study.letter)
        if output is not None:
            paper.write_curves(output, recording, ours, study.letter)
    if arguments.json:
        print(json.dumps({**printed.paper_object(study), "plot": arguments.plot, "output": arguments.output}))
    else:
        printed.print_paper(study)
        for name, path in (("picture", picture), ("curves", output)):
            if path is not None:
                print(f"{name}: {path}")
    return study.failures


def _baselines(arguments: argparse.Namespace) -> tuple[Failure, ...]:
    study = baselines.run_study(arguments.seeds, **_where(arguments))
    if arguments.json:
        print(json.dumps(printed.baselines_object(study)))
    else:
        printed.print_baselines(study)
    return study.failures


def _detection(arguments: argparse.Namespace) -> tuple[Failure, ...]:
    groups = [name.strip() for name in arguments.effects.split(",")]
    known = {*detection.GROUPS, *detection.KNOWN, *detection.UNKNOWN}
    for group in groups:
        if group not in known:
            raise UsageError(f"--effects: there is no {group}; choose from {', '.join(sorted(known))}")
    try:
        sizes = [float(size) for size in arguments.sizes.split(",")]
    except ValueError:
        raise UsageError(f"--sizes takes numbers, for instance 1,0.3,0.1, not {arguments.sizes}") from None
    study = detection.run_study(groups, sizes, arguments.seeds, **_where(arguments))
    if arguments.json:
        print(json.dumps(printed.detection_object(study)))
    else:
        printed.print_detection(study)
    return study.failures


def _where(arguments: argparse.Namespace) -> dict[str, Any]:
    return {"scheduler": arguments.scheduler, "workers": arguments.jobs, "quiet": arguments.json}


_STUDIES = {"paper": _paper, "baselines": _baselines, "detection": _detection}
