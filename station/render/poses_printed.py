"""A calibration by poses on the terminal: parameters, the length of gravity before and after, refused rests."""

from rich.markup import escape

from estimator.poses.calibration import PoseSession
from station.render.terminal import Shown, print_all, rich_table, stdout
from station.views.accelerometers.poses import (
    board_rows,
    board_words,
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
    """Print a calibration by poses: parameters of the accelerometers, norm and gravity, refused rests, and notes.

    Before the notes come gyros, board and the twelve states in the stated frame, where it has them.
    """
    result = session.accelerometer
    rows = [[own.name, own.value, own.u95, own.unit] for own in parameter_rows(result)]
    first = f", {session.board.imus[0].name}" if session.board else ""
    title = escape(f"{session.device}{first}: accelerometers")
    shown: list[Shown] = [(rich_table(title, _HEADS, "lrrl", rows), {})]
    shown += [(escape(line), {"highlight": False}) for line in (norm_words(result), gravity_words(result))]
    if result.refused:
        refused = [[escape(rest_words(rest)), escape(rest.refused)] for rest in result.refused]
        shown.append((rich_table("Refused rests", ["rest", "reason"], "ll", refused, fold=True), {}))
    shown += _gyro(session)
    shown += _board(session)
    for triad in session.triads:
        own = [[row.name, row.value, row.u95, row.unit] for row in triad_rows(triad)]
        shown.append((rich_table(f"Twelve states of the {triad.kind}s in the stated frame", _HEADS, "lrrl", own), {}))
    notes = [*session.notes, *result.notes, *(session.gyro.notes if session.gyro else ())]
    shown += [(escape(f"note: {note}"), {"highlight": False}) for note in notes]
    print_all(stdout(), shown)


def _gyro(session: PoseSession) -> list[Shown]:
    """Return what is printed of gyros: parameters, a line on the turns, and refused turns; nothing without gyros."""
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


def _board(session: PoseSession) -> list[Shown]:
    """Return what is printed of the IMUs of a board: arms, distances with U, angles; nothing for one device."""
    board = session.board
    if board is None:
        return []
    heads = ["IMU", "arm x y z, mm", "distance, mm", "U (95 %)", "turned by x y z, deg"]
    rows = [[escape(row[0]), *row[1:]] for row in board_rows(board)]
    title = f"Accelerometers from {escape(board.imus[0].name)}, in its frame"
    return [
        (rich_table(title, heads, "lrrrr", rows, fold=True), {}),
        (escape(board_words(board)), {"highlight": False}),
    ]
