"""station allan: the noise of the sensors of a recording at rest, with intervals."""

import argparse
import json
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from estimator.errors import RecordingError
from estimator.observations.allan.sensor import SensorNoise, sensor_noise, usable
from estimator.observations.rests import sensor_series
from estimator.recordings.reading import read_recording
from station.atomic_write import check_picture
from station.errors import UsageError
from station.render.lines import tell
from station.render.noise_printed import print_noise
from station.report.pictures import draw_noise
from station.run.outcome import Outcome
from station.schema.quantities import QuantityError, parse
from station.views.noise import noise_object, warnings_of

_PER_DECADE = 10
_MOST_UNCERTAIN = 0.5  # above it the square root of the Fisher information is meaningless


def command_allan(arguments: argparse.Namespace) -> int:
    """Print N, B and K (white noise, instability, random walk) of every sensor of a recording at rest; return 0.

    A sensor that cannot be used is named on stderr; RecordingError if none can. With --plot a picture is drawn, too;
    with --json the one object on stdout holds the notes on sensors, too.
    UsageError for a wrong --uncertainty, and for a picture that cannot be written, before the long work.
    """
    picture = Path(arguments.plot) if arguments.plot else None
    if picture is not None:
        check_picture(picture)
    share = _share(arguments.uncertainty)
    recording = read_recording(Path(arguments.recording))
    found: dict[str, list[list[SensorNoise]]] = {}
    by_source, notes = sensor_series(recording)
    for source, kinds in by_source.items():
        for series in kinds:
            used, reasons = usable(series)
            notes += reasons
            if used is not None:
                found.setdefault(source, []).append(sensor_noise(used, _PER_DECADE))
    if not found:
        raise RecordingError("; ".join(notes))
    if arguments.json:
        print(json.dumps(_object(arguments.recording, found, notes, share)))
    else:
        every = _apart(found)
        for unit in dict.fromkeys(noise.unit for noise in every):
            print_noise([noise for noise in every if noise.unit == unit], share)
        for note in notes:
            tell(f"station: {note}", sys.stderr)
    if picture is not None:
        draw_noise(picture, found)
        if not arguments.json:
            print(f"picture: {picture}")
    return Outcome.PASS.exit_code


def refused(reason: str, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the object for --json if there is no result."""
    return {"recording": arguments.recording, "reason": reason, "sensors": []}


def _apart(by_source: dict[str, list[list[SensorNoise]]]) -> list[SensorNoise]:
    """Return the noise of all sensors; where two have one name, that of their source stands before it."""
    every = [(source, noise) for source, of_kinds in by_source.items() for noises in of_kinds for noise in noises]
    names = Counter(noise.name for _, noise in every)
    return [
        replace(noise, name=f"{source} {noise.name}") if names[noise.name] > 1 else noise for source, noise in every
    ]


def _share(text: str) -> float:
    """Return the share in a text such as "10 %"; UsageError unless it is above 0 and up to 50 %."""
    try:
        share = parse(text, "ratio")
    except QuantityError as error:
        raise UsageError(f"--uncertainty {error}") from None
    if not 0 < share <= _MOST_UNCERTAIN:
        raise UsageError(f'--uncertainty {text}: write a share above 0 and up to 50 %, for instance "10 %"')
    return share


def _object(
    recording: str, by_source: dict[str, list[list[SensorNoise]]], notes: list[str], share: float
) -> dict[str, Any]:
    """Return the noise of all sensors for --json, in SI, with the ``notes`` and the warnings about it.

    ``by_source`` has the sensors of each kind by source; ``share`` is the relative uncertainty to be shown.
    """
    every = [(source, noise) for source, of_kinds in by_source.items() for noises in of_kinds for noise in noises]
    return {
        "recording": recording,
        "uncertainty": share,
        "sensors": [{"source": source, **noise_object(noise, share)} for source, noise in every],
        "notes": notes,
        "warnings": warnings_of([noise for _, noise in every]),
    }
