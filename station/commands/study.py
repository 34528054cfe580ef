"""station study: proofs on simulated recordings, the paper's experiment and other methods on the same data."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from station.atomic_write import check_new_file, check_picture
from station.errors import UsageError
from station.render.lines import tell
from station.run.outcome import Outcome
from station.studies import baselines, paper
from station.studies.baselines_results import baselines_object, print_baselines
from station.studies.paper_results import draw_convergence, paper_object, print_paper

PAPER = "paper"
_SEEDS_OF_PAPER = 200
_SEEDS_OF_BASELINES = 20


def command_study(arguments: argparse.Namespace) -> int:
    """Run a study and print its results; return 1 if some of its seeds failed, which are named on stderr, else 0.

    Raises UsageError for a file that cannot be written, before the long work, or if there is no result.
    """
    study = _paper(arguments) if arguments.study == PAPER else _baselines(arguments)
    for failure in study.failures:
        tell(f"station: seed {failure.item} failed: {failure.reason}", sys.stderr)
    return Outcome.FAIL.exit_code if study.failures else Outcome.PASS.exit_code


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return what --json prints when there is no result."""
    return {"study": arguments.study, "reason": reason}


def _paper(arguments: argparse.Namespace) -> paper.PaperStudy:
    """Run the study of the paper, print it, and write the picture and the curves that were asked for; return it.

    UsageError, before anything is run, if a file cannot be written there.
    """
    picture = Path(arguments.plot) if arguments.plot else None
    curves = Path(arguments.output) if arguments.output else None
    if picture is not None:
        check_picture(picture)
    if curves is not None:
        check_new_file(curves, "--output")
    study = paper.run_study(arguments.seeds or _SEEDS_OF_PAPER, **_where(arguments))
    if picture is not None or curves is not None:
        recording = paper.our_recording(paper.MEMS_NOISE, 0)
        ours = paper.our_curve(recording)
        if picture is not None:
            draw_convergence(picture, ours, study.letter)
        if curves is not None:
            paper.write_curves(curves, recording, ours, study.letter)
    if arguments.json:
        files = {"plot": arguments.plot, "output": arguments.output}
        print(json.dumps({**paper_object(study), **_failed(study), **files}))
        return study
    print_paper(study, details=arguments.details)
    if picture is not None:
        print(f"picture: {picture}")
    if curves is not None:
        print(f"curves: {curves}")
    return study


def _baselines(arguments: argparse.Namespace) -> baselines.BaselineStudy:
    """Run the comparison with other methods, print and return it; UsageError for options of the other study."""
    if arguments.plot or arguments.output:
        raise UsageError("--plot and --output belong to `station study paper`")
    study = baselines.run_study(arguments.seeds or _SEEDS_OF_BASELINES, **_where(arguments))
    if arguments.json:
        print(json.dumps({**baselines_object(study), **_failed(study)}))
    else:
        print_baselines(study, details=arguments.details)
    return study


def _where(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return where the seeds run, and whether without progress, as ``run_all`` takes it."""
    return {"scheduler": arguments.scheduler, "workers": arguments.jobs, "quiet": arguments.json}


def _failed(study: paper.PaperStudy | baselines.BaselineStudy) -> dict[str, Any]:
    return {"failed": [{"seed": failure.item, "reason": failure.reason} for failure in study.failures]}
