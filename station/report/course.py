"""How the run went: convergence, innovations, noise, clocks and losses, events."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from estimator.calibration import Calibration
from station.report import figures
from station.report.html import Content, Markup, composed, joined, paragraph, table
from station.report.pictures import allan_picture, convergence_picture, nis_picture
from station.report.recorded import Recorded


@composed
def convergence(recorded: Recorded) -> Iterator[Content]:
    """Return the live estimates of every gyro over time."""
    if not recorded.courses:
        yield paragraph("The recording keeps no live estimates: it was not estimated while it was made.")
        return
    turns_s = [(step.start_ns - recorded.start_ns) * 1e-9 for step in recorded.steps]
    yield paragraph(
        "The live filter takes the noise of the data sheet; the results above take the noise that was found in the "
        "data, so their uncertainties differ. Grey lines: steps of the script begin."
    )
    for source, course in recorded.courses.items():
        names = recorded.recording.sources[source].array.names
        if len(course.t_ns):
            labels = [recorded.label(source, name) for name in names]
            yield from (convergence_picture(n, course, i, recorded.start_ns, turns_s) for i, n in enumerate(labels))


@composed
def innovations(recorded: Recorded) -> Iterator[Content]:
    """Return the normalised innovations squared over time."""
    found = recorded.calibration
    known = found is not None and np.isfinite(found.nis_mean)
    if found is not None and known:
        nis = figures.plain(found.nis_mean, figures.ONE, 4, "calibration@nis_mean")
        yield paragraph("Mean NIS per degree of freedom: ", nis, ". It is 1 if model and noise are what was assumed.")
    courses = [(name, course) for name, course in recorded.courses.items() if len(course.nis)]
    if courses:
        yield nis_picture(courses, recorded.start_ns)
    if not courses and not known:
        yield paragraph("No innovations are kept.")


@composed
def noise(recorded: Recorded, found: Calibration) -> Iterator[Content]:
    """Return the noise that was found in the data, and the Allan deviation at rest."""
    coloured = all(gyro.noise is not None for gyro in found.gyros)
    heads = ["gyro", "one sample, °/s"]
    if coloured:
        heads += ["angle random walk, °/s/√Hz", "bias instability, below, °/h", "rate random walk, below, °/h/√h"]
    rows: list[Sequence[Content]] = []
    for i, gyro in enumerate(found.gyros):
        row: list[Content] = [
            recorded.label(gyro.source, gyro.name),
            figures.plain(gyro.noise_rps, figures.DEG_PER_S, 3, f"calibration/noise_rps[{i}]"),
        ]
        if gyro.noise is not None and coloured:
            row.append(figures.plain(gyro.noise.mean.arw, figures.ARW, 3, f"calibration/noise[{i},0]"))
            row.append(
                figures.plain(gyro.noise.instability_below, figures.DEG_PER_H, 2, f"calibration/noise_below[{i},0]")
            )
            row.append(figures.plain(gyro.noise.walk_below, figures.WALK, 2, f"calibration/noise_below[{i},1]"))
        rows.append(row)
    notes = "“Below”: with a probability of 95 %; one run tells little of bias instability." if coloured else None
    yield table("Noise found in the data", heads, rows, align="l" + "r" * (len(heads) - 1), notes=notes)
    if recorded.allan is not None:
        yield allan_picture([recorded.label(g.source, g.name) for g in found.gyros], *recorded.allan)


_NOTE = "note: "  # what a session writes before a note
_CLOCK = (
    ("clock_drift_ppm", figures.Unit("ppm", 1.0)),
    ("arrival_jitter_rms_s", figures.MILLISECONDS),
    ("time_offset_s", figures.MILLISECONDS),
)


def clocks(recorded: Recorded) -> Markup:
    """Return what was lost of each source, and how its clock went."""
    heads: list[Content] = ["source", "samples", "lost", "lost, %", "repeated", "late", "corrupt"]
    heads += ["clock drift, ppm", "arrival jitter, ms", "offset to the table, ms"]
    rows: list[Sequence[Content]] = []
    for name, data in recorded.recording.sources.items():
        told = recorded.source_attributes.get(name, {})
        count = len(data.t_ns)
        lost = int(told.get("lost", 0))
        where = f"imu/{name}@"
        row: list[Content] = [
            name,
            figures.figure(count, figures.ONE, f"{count}"),
            figures.figure(lost, figures.ONE, f"{lost}", f"{where}lost" if "lost" in told else None),
        ]
        row.append(figures.fixed(lost / max(count + lost, 1), figures.PERCENT, 3))
        for key in ("repeated", "late", "corrupt"):
            row.append(
                figures.figure(int(told[key]), figures.ONE, str(int(told[key])), f"{where}{key}")
                if key in told
                else "–"
            )
        row += [_with_doubt(told, key, unit, where) for key, unit in _CLOCK]
        rows.append(row)
    notes = "Of the clock and the offset: ± one standard deviation. –: not known."
    return table("Clocks and losses of each source", heads, rows, align="l" + "r" * 9, notes=notes)


def _with_doubt(told: Mapping[str, Any], key: str, unit: figures.Unit, where: str) -> Content:
    if key not in told:
        return "–"
    value = figures.fixed(float(told[key]), unit, 2, f"{where}{key}")
    stem, _, ending = key.rpartition("_")
    doubt = f"{stem}_sd_{ending}"
    return (
        joined([value, " ± ", figures.fixed(float(told[doubt]), unit, 2, f"{where}{doubt}")])
        if doubt in told
        else value
    )


def events(recorded: Recorded) -> Markup:
    """Return events and notes of the operator."""
    if not recorded.events:
        return paragraph("None were recorded.")
    rows: list[Sequence[Content]] = []
    for event in recorded.events:
        at = figures.fixed((event.t_ns - recorded.start_ns) * 1e-9, figures.SECONDS, 1)
        is_note = event.text.startswith(_NOTE)
        rows.append([at, "note of the operator" if is_note else "event", event.text.removeprefix(_NOTE)])
    return table("Events and notes of the operator", ("time, s", "kind", "text"), rows, align="lll")
