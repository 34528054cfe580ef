"""station import: converts data measured elsewhere to a recording; shows a file and drafts a mapping."""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from rich.markup import escape

from estimator.importing.hands.mapping import is_poses, read_pose_mapping
from estimator.importing.hands.session import calibrate_by_hand
from estimator.importing.importing import Imported, import_recording
from estimator.importing.looking import Look, look
from estimator.importing.mapping.mapping import read_mapping
from estimator.poses.calibration import PoseSession
from estimator.poses.file import is_pose_session, read_pose_session, write_pose_session
from estimator.recordings.writing import write_recording
from estimator.untrusted import harmless
from station.atomic_write import check_new_file, write_whole
from station.errors import EXIT_USAGE, UsageError
from station.opening.captures import PROTOCOLS
from station.render.lines import tell
from station.render.poses_printed import print_pose_session
from station.render.terminal import print_all, rich_table, stdout
from station.views.accelerometers.poses import session_object


def command_import(arguments: argparse.Namespace) -> int:
    """Convert data of other programs to a recording; return 2 if a file was lost, else 0.

    With --look show a file instead. Sessions in which hands laid the device in many poses become a calibration.
    UsageError without mapping, data or output. RecordingError if nothing can be imported, or the recording exists.
    """
    if arguments.look is not None:
        return _look(arguments)
    if not arguments.mapping or not arguments.data or not arguments.output:
        raise UsageError(
            "give a mapping file, data files, and the recording to write with -o; --look FILE shows a file"
        )
    output = Path(arguments.output)
    if is_poses(Path(arguments.mapping)):
        return _calibrate_by_hand(arguments, output)
    mapping = read_mapping(Path(arguments.mapping), PROTOCOLS)
    imported = import_recording(mapping, [Path(name) for name in arguments.data])
    write_recording(output, imported.recording)
    _print_imported(imported, output, as_json=arguments.json)
    return EXIT_USAGE if imported.lost_files else 0


def _calibrate_by_hand(arguments: argparse.Namespace, output: Path) -> int:
    """Calibrate from rests in many poses, print the result and write it; return 2 if a file was lost, else 0.

    UsageError, before the work, if the file exists; RecordingError if nothing can be calibrated.
    """
    check_new_file(output, "--output")
    mapping = read_pose_mapping(Path(arguments.mapping), PROTOCOLS)
    session = calibrate_by_hand(mapping, [Path(name) for name in arguments.data])
    write_pose_session(output, session)
    _print_pose_session(session, output, as_json=arguments.json)
    return EXIT_USAGE if session.refused_files else 0


def _print_pose_session(session: PoseSession, path: Path, *, as_json: bool) -> None:
    """Print a calibration by poses and its file, or both as JSON; in the former case refused files go to stderr."""
    if as_json:
        print(json.dumps(session_object(session, str(path))))
        return
    print_pose_session(session)
    print(f"calibration: {path}", flush=True)
    for entry in session.refused_files:
        tell(harmless(f"refused {entry}"), sys.stderr)


def _print_imported(imported: Imported, output: Path, *, as_json: bool) -> None:
    """Print the result of an import: notes, samples per source, and what was refused, the latter on stderr.

    With ``as_json`` all are one object on stdout.
    """
    samples = {name: len(data.t_ns) for name, data in imported.recording.sources.items()}
    refused = [{"name": entry.name, "reason": entry.reason} for entry in imported.refused]
    if as_json:
        notes = list(imported.notes)
        print(json.dumps({"recording": str(output), "samples": samples, "refused": refused, "notes": notes}))
        return
    for note in imported.notes:
        tell(f"note: {harmless(note)}")
    print(f"{output}: {', '.join(f'{n} samples of {name}' for name, n in samples.items())}", flush=True)
    for entry in refused:
        tell(harmless(f"refused {entry['name']}: {entry['reason']}"), sys.stderr)


def _look(arguments: argparse.Namespace) -> int:
    """Show the columns of a file with guesses, and print the mapping or write it to --output; return 0.

    A calibration by poses is printed as it was when it was made, unless --output is given. UsageError if that file
    exists, RecordingError if the one to show cannot be read.
    """
    output = Path(arguments.output) if arguments.output else None
    if output is not None:
        check_new_file(output, "--output")
    path = Path(arguments.look)
    if output is None and is_pose_session(path):
        _print_pose_session(read_pose_session(path), path, as_json=arguments.json)
        return 0
    found = look(path)
    if output is not None:
        write_whole(output, found.mapping)
    if arguments.json:
        print(json.dumps({**asdict(found), "output": None if output is None else str(output)}))
        return 0
    _print_look(found, path)
    if output is None:
        print(harmless(found.mapping))
        print(f"-o MAPPING.toml writes it; then: station import MAPPING.toml {path} -o {path.stem}.h5")
    else:
        print(f"mapping: {output}; correct it, then: station import {output} {path} -o {path.stem}.h5")
    return 0


def _print_look(look: Look, path: Path) -> None:
    table = rich_table(path.name, ["column", "first values", "range", "what it may be"], "llll", fold=True)
    for column in look.columns:
        table.add_row(*(escape(harmless(text)) for text in (column.name, column.first, column.range, column.guess)))
    print_all(stdout(), [(table, {})])
    for note in look.notes:
        tell(harmless(note))
