"""The HDF5 file of a calibration by hand, which opens again with all that was printed."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from estimator.errors import MISSHAPEN, RecordingError, first_line
from estimator.geometry.kinematics import Gravity
from estimator.poses.calibration import (
    GYRO_NAMES,
    TRIAD_NAMES,
    Board,
    BoardImu,
    GyroTurnCalibration,
    PoseCalibration,
    PoseRest,
    PoseSession,
    RefusedTurn,
    Triad,
)
from estimator.poses.intrinsic import NAMES, Intrinsic
from estimator.recordings.safe_open import probe

FORMAT = "turntable-pose-calibration"
"""Attribute "format" of such a file."""
FORMAT_VERSION = 1
_TEXTS = ("device", "licence", "source", "mapping")
_LISTS = ("files", "notes", "refused_files")
_GYRO_NUMBERS = ("factor", "turns", "before_rad", "after_rad")
_NUMBERS = ("factor", "freedom", "before_mps2", "after_mps2", "between_mps2")


def write_pose_session(path: Path, session: PoseSession) -> None:
    """Write a calibration by hand to a new file, with its folders; RecordingError if it exists or cannot be written.

    After a failure no file is left.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = h5py.File(path, "x")
        try:
            with file:
                _put_session(file, session)
        except BaseException:
            path.unlink(missing_ok=True)
            raise
    except (OSError, RuntimeError, ValueError) as error:  # HDF5 has all three
        raise RecordingError(f"cannot create {path}: {first_line(error)}") from None


def read_pose_session(path: Path) -> PoseSession:
    """Return the calibration by poses in a file.

    RecordingError if the file is missing, damaged, of another format, or written by a newer version.
    """
    probe(path)
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT:
                raise RecordingError(f"{path} is not a calibration by poses: station import writes one, kind = poses")
            if int(file.attrs["format_version"]) > FORMAT_VERSION:
                raise RecordingError(f"{path} was written by a newer station: update this one")
            return PoseSession(
                device=str(file.attrs["device"]),
                licence=str(file.attrs["licence"]),
                source=str(file.attrs["source"]),
                mapping=str(file.attrs["mapping"]),
                files=_texts(file, "files"),
                notes=_texts(file, "notes"),
                refused_files=_texts(file, "refused_files"),
                accelerometer=_accelerometer(file["accelerometer"]),
                gyro=_gyro(file["gyro"]) if "gyro" in file else None,
                board=_board(file["board"]) if "board" in file else None,
                triads=tuple(_triad(kind, group) for kind, group in file.get("triads", {}).items()),
            )
    except MISSHAPEN as error:
        raise RecordingError(f"{path} is damaged: {first_line(error)}") from None


def is_pose_session(path: Path) -> bool:
    """Return whether a file is an HDF5 file of this format; false for one that is missing, damaged or cannot be read.

    Any HDF5 file is first read as a whole in another process (``probe``), which takes time for a long recording.
    """
    try:
        if not path.is_file() or not h5py.is_hdf5(path):
            return False
        probe(path)
        with h5py.File(path, "r") as file:
            return bool(file.attrs.get("format") == FORMAT)
    except (RecordingError, OSError):
        return False


def _put_session(file: Any, session: PoseSession) -> None:
    """Write format, texts and all results of a session; gyro, board and triads have groups only if it has them."""
    file.attrs.update({"format": FORMAT, "format_version": FORMAT_VERSION})
    file.attrs.update({key: getattr(session, key) for key in _TEXTS})
    for key in _LISTS:
        _put_texts(file, key, getattr(session, key))
    _put_accelerometer(file.create_group("accelerometer"), session.accelerometer)
    if session.gyro is not None:
        _put_gyro(file.create_group("gyro"), session.gyro)
    if session.board is not None:
        _put_board(file.create_group("board"), session.board)
    for triad in session.triads:
        _put_triad(file.create_group(f"triads/{triad.kind}"), triad)


def _put_texts(group: Any, name: str, texts: tuple[str, ...]) -> None:
    group.create_dataset(name, data=np.array(texts, dtype=object), dtype=h5py.string_dtype())


def _texts(group: Any, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in group[name].asstr()[:])


def _put_accelerometer(group: Any, result: PoseCalibration) -> None:
    """Write all of a result: gravity, unit, figures of the fit, parameters, notes, and the rests as columns.

    Covariance and the flags ``shown`` are in the order of the parameters' ``names``. ``value`` is NaN for parameters
    that are not shown, ``fitted`` has all; numbers that a rest lacks are NaN.
    """
    group.attrs.update({key: getattr(result, key) for key in _NUMBERS})
    group.attrs["unit"] = result.unit
    group.attrs["gravity_mps2"] = result.gravity.value_mps2
    group.attrs["gravity_sd"] = result.gravity.sd
    group.attrs["gravity_source"] = result.gravity.source
    _put_texts(group, "names", NAMES)
    group["value"] = np.where(result.shown, result.intrinsic.vector, np.nan)
    group["fitted"] = result.intrinsic.vector
    group["covariance"] = result.covariance
    group["shown"] = result.shown
    _put_texts(group, "notes", result.notes)
    rests = group.create_group("rests")
    for key in ("start_s", "duration_s", "before_mps2", "after_mps2", "sd_mps2"):
        values = [getattr(rest, key) for rest in result.rests]
        rests[key] = np.array([np.nan if value is None else value for value in values])
    rests["mean"] = np.array([rest.mean for rest in result.rests])
    _put_texts(rests, "file", tuple(rest.file for rest in result.rests))
    _put_texts(rests, "refused", tuple(rest.refused for rest in result.rests))


def _accelerometer(group: Any) -> PoseCalibration:
    """Return the result in a group; KeyError or ValueError if something is missing or has another shape."""
    vector = np.asarray(group["fitted"][:], dtype=np.float64).reshape(len(NAMES))
    covariance = np.asarray(group["covariance"][:], dtype=np.float64).reshape(len(NAMES), len(NAMES))
    numbers = {key: float(group.attrs[key]) for key in _NUMBERS}
    freedom = int(numbers.pop("freedom"))
    return PoseCalibration(
        intrinsic=Intrinsic.of_vector(vector),
        covariance=covariance,
        shown=np.asarray(group["shown"][:], dtype=bool).reshape(len(NAMES)),
        freedom=freedom,
        gravity=Gravity(
            value_mps2=float(group.attrs["gravity_mps2"]),
            sd=float(group.attrs["gravity_sd"]),
            source=str(group.attrs["gravity_source"]),
        ),
        unit=str(group.attrs["unit"]),
        rests=_rests(group["rests"]),
        notes=_texts(group, "notes"),
        **numbers,
    )


def _rests(group: Any) -> tuple[PoseRest, ...]:
    """Return the rests in the columns of a group, numbered from 1; ValueError if they differ in length.

    What is NaN in the file is None in a rest: times of given means, and the sigma of a refused rest.
    """
    columns = {key: np.asarray(group[key][:], dtype=np.float64).tolist() for key in group if key not in _REST_TEXTS}
    files, reasons = _texts(group, "file"), _texts(group, "refused")
    rests = []
    for at, mean in enumerate(np.asarray(group["mean"][:], dtype=np.float64).reshape(len(files), 3)):
        rests.append(
            PoseRest(
                number=at + 1,
                file=files[at],
                start_s=_known(columns["start_s"][at]),
                duration_s=_known(columns["duration_s"][at]),
                mean=mean,
                before_mps2=columns["before_mps2"][at],
                after_mps2=columns["after_mps2"][at],
                sd_mps2=_known(columns["sd_mps2"][at]),
                refused=reasons[at],
            )
        )
    return tuple(rests)


_REST_TEXTS = ("file", "refused")


def _known(value: float) -> float | None:
    return None if np.isnan(value) else value


def _put_gyro(group: Any, result: GyroTurnCalibration) -> None:
    """Write all of a result: figures of the fit, matrix, biases, covariance, flags, notes, and the refused turns.

    Covariance and the flags ``shown`` are in the order of ``names``. A refused turn is a row of the numbers of the
    rests before and after it, with its reason in ``refused``.
    """
    group.attrs.update({key: getattr(result, key) for key in _GYRO_NUMBERS})
    _put_texts(group, "names", GYRO_NAMES)
    for key in ("matrix", "bias_rps", "covariance", "shown"):
        group[key] = getattr(result, key)
    group["refused_turns"] = np.array([(turn.before, turn.after) for turn in result.refused], dtype=np.int64)
    _put_texts(group, "refused", tuple(turn.reason for turn in result.refused))
    _put_texts(group, "notes", result.notes)


def _gyro(group: Any) -> GyroTurnCalibration:
    """Return the result in a group; KeyError or ValueError if something is missing or has another shape."""
    size = len(GYRO_NAMES)
    numbers = {key: float(group.attrs[key]) for key in _GYRO_NUMBERS}
    turns = int(numbers.pop("turns"))
    reasons = _texts(group, "refused")
    ends = np.asarray(group["refused_turns"][:], dtype=np.int64).reshape(len(reasons), 2).tolist()
    return GyroTurnCalibration(
        matrix=np.asarray(group["matrix"][:], dtype=np.float64).reshape(3, 3),
        bias_rps=np.asarray(group["bias_rps"][:], dtype=np.float64).reshape(3),
        covariance=np.asarray(group["covariance"][:], dtype=np.float64).reshape(size, size),
        shown=np.asarray(group["shown"][:], dtype=bool).reshape(size),
        turns=turns,
        refused=tuple(
            RefusedTurn(before=before, after=after, reason=reason)
            for (before, after), reason in zip(ends, reasons, strict=True)
        ),
        notes=_texts(group, "notes"),
        **numbers,
    )


def _put_triad(group: Any, triad: Triad) -> None:
    """Write all of a triad but its kind: matrix, bias, coverage factor, and in the order of ``names`` the others.

    Those are the covariance and the flags ``shown``.
    """
    group.attrs["factor"] = triad.factor
    _put_texts(group, "names", TRIAD_NAMES)
    for key in ("matrix", "bias", "covariance", "shown"):
        group[key] = getattr(triad, key)


def _triad(kind: str, group: Any) -> Triad:
    """Return the triad in a group; KeyError or ValueError if something is missing or has another shape."""
    size = len(TRIAD_NAMES)
    return Triad(
        kind=kind,
        matrix=np.asarray(group["matrix"][:], dtype=np.float64).reshape(3, 3),
        bias=np.asarray(group["bias"][:], dtype=np.float64).reshape(3),
        covariance=np.asarray(group["covariance"][:], dtype=np.float64).reshape(size, size),
        shown=np.asarray(group["shown"][:], dtype=bool).reshape(size),
        factor=float(group.attrs["factor"]),
    )


def _put_board(group: Any, board: Board) -> None:
    """Write the figures of a board, and its IMUs as groups by their number, each with accelerometer and gyro."""
    group.attrs.update({"used": board.used, "saturated": board.saturated, "misfit_mps2": board.misfit_mps2})
    for number, imu in enumerate(board.imus):
        own = group.create_group(f"{number:03d}")
        own.attrs.update({"name": imu.name, "rotation_sd_rad": imu.rotation_sd_rad})
        own.attrs.update({"distance_m": imu.distance_m, "distance_u95_m": imu.distance_u95_m})
        for key in ("rotation", "arm_m", "covariance_m2"):
            own[key] = getattr(imu, key)
        _put_accelerometer(own.create_group("accelerometer"), imu.accelerometer)
        _put_gyro(own.create_group("gyro"), imu.gyro)


def _board(group: Any) -> Board:
    """Return the board in a group; KeyError or ValueError if something is missing or has another shape."""
    imus = [
        BoardImu(
            name=str(own.attrs["name"]),
            accelerometer=_accelerometer(own["accelerometer"]),
            gyro=_gyro(own["gyro"]),
            rotation=np.asarray(own["rotation"][:], dtype=np.float64).reshape(3, 3),
            rotation_sd_rad=float(own.attrs["rotation_sd_rad"]),
            arm_m=np.asarray(own["arm_m"][:], dtype=np.float64).reshape(3),
            covariance_m2=np.asarray(own["covariance_m2"][:], dtype=np.float64).reshape(3, 3),
            distance_m=float(own.attrs["distance_m"]),
            distance_u95_m=float(own.attrs["distance_u95_m"]),
        )
        for own in group.values()
    ]
    return Board(
        imus=tuple(imus),
        used=int(group.attrs["used"]),
        saturated=int(group.attrs["saturated"]),
        misfit_mps2=float(group.attrs["misfit_mps2"]),
    )
