"""station investigate: effects that the error model lacks, found in existing recordings."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.types import AxisLimits
from estimator.effects.catalogue import records
from estimator.estimation.runs.build import runs_of
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.tracing.accelerometers.trace_forces import trace_forces
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Finding, Investigation
from station.atomic_write import check_new_file, check_picture, free_path, write_whole
from station.bench.bench import load_bench
from station.commands.calibrate import recordings_of
from station.commands.improve.script_file import script_text
from station.errors import UsageError
from station.exports.investigation_file import write_investigation
from station.render.accelerometers.findings import print_force_findings
from station.render.investigation_printed import exit_code_of, print_investigation
from station.render.progress import TracingProgress
from station.report.pictures import draw_investigation
from station.schema.tables import Table
from station.scripts.next_script import NextScript, Past, next_script
from station.views.accelerometers.findings import finding_object
from station.views.investigation import investigation_object, investigation_view

_NEXT_FILE = "next-script.toml"
_MOST_RIVALS = 4  # of an unexplained residual, so many suspects are compared


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits of a table, and where they are stated."""

    axes: Mapping[str, AxisLimits]
    stated_in: str


def command_investigate(arguments: argparse.Namespace) -> int:
    """Look for errors that the model misses, and write picture, results and next script as asked for.

    Return 0 if nothing was found or the effects were added, 1 if causes cannot be separated or explained, or if
    accelerometers have suspects. UsageError for bad input. A next script is written without being asked for, too, where
    there is one.
    """
    picture, model, script_file = _outputs(arguments)
    arguments.recordings, arguments.verify = recordings_of(arguments.recordings), recordings_of(arguments.verify)
    fitted, judging = arguments.recordings, arguments.verify
    _check_apart(fitted, judging)
    recordings, verification = ([read_recording(Path(name)) for name in names] for names in (fitted, judging))
    limits = limits_of(recordings, Path(arguments.bench) if arguments.bench else None)
    with TracingProgress(arguments.json) as progress:
        found = investigate(recordings, verification, most_effects=arguments.most_effects, progress=progress.show)
        following = following_script(found, recordings, verification, limits)
        of_forces = trace_forces(recordings, verification)
    if following is not None:
        script_file = script_file or free_path(Path(_NEXT_FILE))
        write_next(script_file, following, limits)
    written = None if following is None else script_file
    view = investigation_view(found, written, fitted, judging)
    result = investigation_object(view)
    if model is not None:
        write_investigation(model, found, result, of_forces)
    if picture is not None:
        draw_investigation(picture, found)
    if arguments.json:
        forces = {"accelerometers": [finding_object(one) for one in of_forces]} if of_forces else {}
        print(json.dumps({**result, **forces, "output": arguments.output, "plot": arguments.plot}))
    else:
        print_investigation(found, following, written)
        print_force_findings(of_forces)
        if following is None and exit_code_of(found.finding):
            print(f"no next script: {_why_none(recordings, limits)}")
            for line in view.record_next:
                print(f"next, record a run that shows {line}")
        for kind, path in (("picture", picture), ("results", model)):
            if path is not None:
                print(f"{kind}: {path}")
    return max(exit_code_of(found.finding), int(any(one.suspects for one in of_forces)))


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the object for --json if there is no verdict."""
    recordings, verification = list(arguments.recordings), list(arguments.verify)
    return {"verdict": None, "reason": reason, "recordings": recordings, "verification": verification}


def _outputs(arguments: argparse.Namespace) -> tuple[Path | None, Path | None, Path | None]:
    """Return the paths of picture, results and script, None where not asked for, checked before the long work.

    UsageError if one cannot be written, or if results or script exist; a picture that exists is overwritten.
    """
    picture, model, script = (
        Path(name) if name else None for name in (arguments.plot, arguments.output, arguments.next_script)
    )
    if picture is not None:
        check_picture(picture)
    for path, option in ((model, "--output"), (script, "--next-script")):
        if path is not None:
            check_new_file(path, option)
    return picture, model, script


def _check_apart(fitted: Sequence[str], judging: Sequence[str]) -> None:
    both = {Path(name).resolve() for name in fitted} & {Path(name).resolve() for name in judging}
    if both:
        raise UsageError(f"{min(both)} is given both to fit and to verify; a fitted run cannot verify")


def limits_of(recordings: Sequence[Recording], bench: Path | None) -> Limits | None:
    """Return the limits of the table from a bench file, else from the first recording that carries a bench.

    None if there is neither. Recordings without a table do not count. BenchError for an invalid bench file, UsageError
    for an invalid bench in a recording.
    """
    if bench is not None:
        return Limits(load_bench(bench).table.limits, str(bench))
    for recording in recordings:
        text = recording.attributes.get("bench")
        if text and recording.table is not None:
            table = Table.parse(str(text), f"bench in {recording.name}", UsageError).table("table")
            axes = {
                axis: AxisLimits(**table.table(axis).read("bench.axis", list_length=2))
                for axis in recording.table.gimbals
            }
            return Limits(axes, f"the bench in {recording.name}")
    return None


def following_script(
    investigation: Investigation,
    recordings: Sequence[Recording],
    verification: Sequence[Recording],
    limits: Limits | None,
    most_s: float = math.inf,
) -> NextScript | None:
    """Return the script to drive next, of at most ``most_s``, that separates the causes which are left.

    None if the finding is settled, the limits are unknown, no recording was made on a table, or no script helps.
    UsageError if the limits lack an axis about which the recordings turn.
    """
    fitted, judging = ([r for r in own if r.table is not None] for own in (recordings, verification))
    if limits is None or not fitted or investigation.finding in (Finding.NOTHING, Finding.ADDED):
        return None
    table = fitted[0].table
    assert table is not None
    missing = [axis for axis in table.gimbals if axis not in limits.axes]
    if missing:
        raise UsageError(f"{limits.stated_in} has no axis {', '.join(missing)}, about which the recordings turn")
    rivals = investigation.rivals or (_suspects(investigation),)
    known = {suspect.effect: suspect.log_evidence for suspect in investigation.suspects}
    seen_since = _evidence_of(investigation)
    past, since = ([Past.of(run) for recording in own for run in runs_of(recording)[0]] for own in (fitted, judging))
    return next_script(
        rivals,
        {name: max(known.get(name, 0.0), seen_since) for own in rivals for name in own},
        past,
        limits.axes,
        table.gimbals,
        fitted[0].site,
        judging=since,
        most_s=most_s,
    )


def _why_none(recordings: Sequence[Recording], limits: Limits | None) -> str:
    if not any(recording.table is not None for recording in recordings):
        return "these recordings were not made on a table"
    if limits is None:
        return "the limits of the table are unknown. Give its bench file with --bench"
    return "no known script shows more of this"


def _suspects(investigation: Investigation) -> tuple[str, ...]:
    """Return effects of the catalogue that may explain the unexplained residual, by name.

    These are the effects that are suspected of what the residual depends on, those that mainly depend on it first. If
    there are none, or nothing is unexplained, the suspects of the investigation with the most evidence, at most
    ``_MOST_RIVALS``.
    """
    variable = "" if investigation.unexplained is None else investigation.unexplained.depends_on
    of_its_kind = [record for record in records() if variable in record.suspected_of]
    if of_its_kind:  # those that mainly depend on it first
        return tuple(r.name for r in sorted(of_its_kind, key=lambda record: record.depends_on not in ("", variable)))
    ranked = sorted(investigation.suspects, key=lambda suspect: -suspect.log_evidence)
    return tuple(suspect.effect for suspect in ranked[:_MOST_RIVALS])


def _evidence_of(investigation: Investigation) -> float:
    """Return half the squares, in sigmas, by which the errors on a verification run exceed their noise; at least 0."""
    views = [view for view in investigation.views if view.verification and view.noise_rps > 0]
    squares = sum(float(np.sum((view.after_rps / view.noise_rps) ** 2 - 1)) for view in views)
    return max(0.5 * squares, 0.0)


def write_next(path: Path, following: NextScript, limits: Limits | None) -> None:
    """Write the script that an investigation asks for; UsageError if that fails."""
    rivals = "; ".join(" or ".join(names) for names in following.rivals)
    origin = f"Found by station investigate, within the limits of {limits.stated_in if limits else 'a table'}.\n"
    origin += f"To tell apart: {rivals}. Predicted probability of that: {following.probability:.2f}."
    write_whole(path, script_text(following.script, origin))
