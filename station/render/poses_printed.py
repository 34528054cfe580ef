"""A calibration by poses on the terminal: parameters, the length of gravity before and after, refused rests."""

from rich.markup import escape

from estimator.poses.calibration import PoseSession
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.views.poses import (
    gravity_words,
    gyro_rows,
    norm_words,
    parameter_rows,
    rest_words,
    triad_rows,
    turn_words,
    turns_words,
)

_HEADS = ["parameter", "value", "U (95 %)", "unit"]


def print_pose_session(session: PoseSession) -> None:
    """Print a calibration by poses."""
    result = session.accelerometer
    rows = [[own.name, own.value, own.u95, own.unit] for own in parameter_rows(result)]
    title = escape(f"{session.device}: accelerometers")
    shown: list[Shown] = [(rich_table(title, _HEADS, "lrrl", rows), {})]
    shown += [(escape(line), {"highlight": False}) for line in (norm_words(result), gravity_words(result))]
    if result.refused:
        refused = [[escape(rest_words(rest)), escape(rest.refused)] for rest in result.refused]
        shown.append((rich_table("Refused rests", ["rest", "reason"], "ll", refused, fold=True), {}))
    shown += _gyro(session)
    for triad in session.triads:
        own = [[row.name, row.value, row.u95, row.unit] for row in triad_rows(triad)]
        shown.append((rich_table(f"Twelve states of the {triad.kind}s in the stated frame", _HEADS, "lrrl", own), {}))
    notes = [*session.notes, *result.notes, *(session.gyro.notes if session.gyro else ())]
    shown += [(escape(f"note: {note}"), {"highlight": False}) for note in notes]
    print_all(stdout(), shown)


def _gyro(session: PoseSession) -> list[Shown]:
    """Return what is printed of gyros; nothing without them."""
    result = session.gyro
    if result is None:
        return []
    rows = [[own.name, own.value, own.u95, own.unit] for own in gyro_rows(result)]
    title = escape(f"{session.device}: gyros, in the frame of the accelerometers")
    shown: list[Shown] = [(rich_table(title, _HEADS, "lrrl", rows), {})]
    shown.append((escape(turns_words(result)), {"highlight": False}))
    if result.refused:
        refused = [[escape(turn_words(turn)), escape(turn.reason)] for turn in result.refused]
        shown.append((rich_table("Refused turns", ["turn", "reason"], "ll", refused, fold=True), {}))
    return shown
