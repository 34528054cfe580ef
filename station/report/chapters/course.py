"""How the run went: live estimates, innovations, noise."""

from estimator.calibration.values import Calibration
from station.report.pictures import Picture, allan_picture, convergence_picture, nis_picture
from station.report.recorded import Recorded


def convergence_pictures(recorded: Recorded) -> list[Picture]:
    """Return the live estimates of every gyro over time."""
    turns_s = [(step.start_ns - recorded.start_ns) * 1e-9 for step in recorded.steps]
    return [
        convergence_picture(recorded.label(source, name), course, i, recorded.start_ns, turns_s)
        for source, course in recorded.courses.items()
        for i, name in enumerate(recorded.recording.sources[source].array.names)
        if len(course.t_ns)
    ]


def innovations_picture(recorded: Recorded) -> Picture | None:
    """Return the normalised innovations squared over time, None if none are kept."""
    courses = [(name, course) for name, course in recorded.courses.items() if len(course.nis)]
    return nis_picture(courses, recorded.start_ns) if courses else None


def noise_picture(recorded: Recorded, found: Calibration) -> Picture | None:
    """Return the Allan deviation at rest, None if it is not kept."""
    labels = [recorded.label(g.source, g.name) for g in found.gyros]
    return allan_picture(labels, *recorded.allan) if recorded.allan is not None else None


def doubt_of(key: str) -> str:
    """Return the attribute that has the standard deviation of an attribute of a source, such as "clock_drift_ppm"."""
    stem, _, ending = key.rpartition("_")
    return f"{stem}_sd_{ending}"
