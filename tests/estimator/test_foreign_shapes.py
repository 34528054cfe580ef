"""Logs of others in shapes that a researcher has: MATLAB arrays, matrices, two files, labels, clocks of the day."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from foreign_logs import DEVICE, imported as import_of
from foreign_motion import (
    ACCEL,
    ATTITUDE,
    G_MPS2,
    GYRO,
    RATE,
    TIME,
    TOP,
    attitude,
    imported,
    instants,
    outputs,
    quaternions,
    ran,
    rate,
    write,
)
from scipy.io import savemat

from estimator.errors import RecordingError
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.recordings.reference import AttitudeReadings, Turns

T_S = instants(20.0)
W = rate(T_S)
MAT = DEVICE + '[file]\nformat = "mat"\n[time]\ncolumn = "t"\nunit = "s"\n'
MATRIX = '[reference]\nkind = "attitude"\ncolumns = ["R"]\norder = "matrix"\n'


def recorded(capsys: pytest.CaptureFixture[str], folder: Path, mapping: str, *logs: str) -> tuple[Recording, str]:
    """Return the recording of some logs, and what the import said."""
    run, said = imported(capsys, folder, mapping, *logs)
    return read_recording(run), said


@pytest.mark.parametrize("turned", [False, True], ids=["samples first", "samples last"])
def test_arrays_of_matlab_lie_either_way_and_an_attitude_may_be_a_matrix(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], turned: bool
) -> None:
    output = outputs(W)
    matrices = attitude(T_S).as_matrix()
    gyro, poses = (output.T, np.moveaxis(matrices, 0, 2)) if turned else (output, matrices)
    savemat(tmp_path / "log.mat", {"t": T_S, "w": gyro, "R": poses})
    mapping = MAT + '[gyro]\ncolumns = ["w"]\nunit = "deg/s"\n' + MATRIX
    recording, _ = recorded(capsys, tmp_path, mapping, "log.mat")
    np.testing.assert_allclose(recording.sources["imu"].rate_rps, np.radians(output), atol=1e-12)
    reference = recording.reference
    assert isinstance(reference, AttitudeReadings)
    alike = np.abs(np.sum(reference.attitude_wxyz * quaternions(T_S), axis=1))
    np.testing.assert_allclose(alike, 1.0, atol=1e-9)


def test_an_accelerometer_may_be_in_a_file_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "log.csv", "t,gx,gy,gz,qw,qx,qy,qz", T_S, outputs(W), quaternions(T_S))
    at_s = np.arange(0.0, 19.0, 0.02) + 0.013
    felt = attitude(at_s).inv().apply([0.0, 0.0, G_MPS2])
    write(tmp_path / "log_felt.csv", "t,ax,ay,az", at_s, felt)
    recording, _ = recorded(capsys, tmp_path, TOP + ATTITUDE + ACCEL + 'file = "{stem}_felt.csv"\n')
    data = recording.sources["imu"]
    assert data.accel_mps2 is not None
    t_s = data.t_ns * 1e-9
    inside = (t_s > 0.1) & (t_s < 18.9)
    true = attitude(t_s).inv().apply([0.0, 0.0, G_MPS2])
    np.testing.assert_allclose(data.accel_mps2[inside], true[inside], atol=0.05)


def test_a_label_that_comes_again_is_the_same_turn_again(tmp_path: Path) -> None:
    speed = np.interp(T_S % 10, [0, 2, 3, 7, 8, 10], [0, 0, 18, 18, 0, 0])
    labels = np.where((T_S % 10 > 1) & (T_S % 10 < 9), "left", "")
    rows = [f"{t:.2f},{0.1:.2f},{0.2:.2f},{w:.4f},{s}" for t, w, s in zip(T_S, speed + 0.3, labels, strict=True)]
    (tmp_path / "log.csv").write_text("t,gx,gy,gz,what\n" + "\n".join(rows) + "\n")
    turns = '[reference]\nkind = "turns"\nsd_deg = 0.5\nsection_column = "what"\n'
    mapping = TOP + turns + '[reference.sections]\nleft = { axis = "z", angle_deg = 90 }\n'
    (tmp_path / "mapping.toml").write_text(mapping)
    reference = import_of(tmp_path / "mapping.toml", tmp_path / "log.csv").recording.reference
    assert isinstance(reference, Turns)
    turned = reference.turn_rad[np.linalg.norm(reference.turn_rad, axis=1) > 0]
    np.testing.assert_allclose(turned, [[0, 0, np.pi / 2]] * 2, atol=1e-12)


def test_a_clock_of_the_day_goes_on_after_midnight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seconds = (86400 - 5 + T_S) % 86400
    hour, rest = seconds // 3600, seconds % 3600
    clock = [
        f"{(h - 1) % 12 + 1:.0f}:{r // 60:02.0f}:{r % 60:09.6f} {'PM' if h >= 12 else 'AM'}"
        for h, r in zip(hour, np.round(rest, 6), strict=True)
    ]
    values = np.column_stack([outputs(W), W])
    rows = [f"{text},{','.join(f'{v:.6g}' for v in row)}" for text, row in zip(clock, values, strict=True)]
    (tmp_path / "log.csv").write_text("t,gx,gy,gz,rx,ry,rz\n" + "\n".join(rows) + "\n")
    pattern = '[time]\ncolumn = "t"\nunit = "pattern"\npattern = "%I:%M:%S.%f %p"\n'
    recording, _ = recorded(capsys, tmp_path, TOP.replace(TIME, pattern) + RATE)
    np.testing.assert_allclose(np.diff(recording.sources["imu"].t_ns), 1e7, atol=2)


def test_a_heading_with_more_names_than_fields_says_what_to_write(tmp_path: Path) -> None:
    write(tmp_path / "log.csv", "time,t,gx,gy,gz,rx,ry,rz", T_S, outputs(W), W)
    (tmp_path / "mapping.toml").write_text(TOP + RATE)
    with pytest.raises(RecordingError, match=r"names 8 columns .* have 7 fields: name them with columns = \[...\]"):
        import_of(tmp_path / "mapping.toml", tmp_path / "log.csv")


def test_a_record_in_one_text_is_said_to_be_a_list(tmp_path: Path) -> None:
    binary = DEVICE + '[file]\nformat = "binary"\nrecord = "t f8, gyro 3f4"\n' + TIME
    (tmp_path / "mapping.toml").write_text(binary + GYRO + RATE)
    (tmp_path / "log.bin").write_bytes(b"")
    with pytest.raises(RecordingError, match="must be a list with a text for each column"):
        import_of(tmp_path / "mapping.toml", tmp_path / "log.bin")


def test_a_note_on_many_files_is_told_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"log{number}.csv" for number in range(5)]
    for number, name in enumerate(names):
        write(tmp_path / name, "t,gx,gy,gz,rx,ry,rz", T_S, np.round(outputs(W, number) / 2) * 2, W)
    _, said = recorded(capsys, tmp_path, TOP + RATE, *names)
    notes = [line for line in said.splitlines() if "x: the resolution" in line]
    assert len(notes) == 1, said
    assert "5 files" in notes[0] or "4 more files" in notes[0]


@pytest.mark.parametrize("kind", ["csv", "mat"])
def test_a_first_look_writes_a_mapping_that_imports_and_is_right(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    felt = attitude(T_S).inv().apply([0.0, 0.0, G_MPS2])
    log = tmp_path / f"log.{kind}"
    if kind == "csv":
        heading = "time_ms,acc_x,acc_y,acc_z,gyro_x [deg/s],gyro_y [deg/s],gyro_z [deg/s],temp,qw,qx,qy,qz"
        write(log, heading, 1e3 * T_S, felt, outputs(W), np.full(len(T_S), 25.0), quaternions(T_S))
    else:
        savemat(log, {"t": T_S, "gyr": np.radians(outputs(W)).T, "acc": felt.T, "quat": quaternions(T_S)})
    code, said = ran(capsys, "import", "--look", log, "-o", tmp_path / "mapping.toml")
    assert code == 0, said
    assert "100 Hz" in said
    found = import_of(tmp_path / "mapping.toml", log).recording
    data = found.sources["imu"]
    np.testing.assert_allclose(data.rate_rps, np.radians(outputs(W)), atol=1e-3)
    assert data.accel_mps2 is not None
    assert isinstance(found.reference, AttitudeReadings)
    assert (data.temperature_c is not None) == (kind == "csv")


def test_a_first_look_shows_files_that_hold_nothing_known(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "log.csv").write_text("a;b\n" + "1;left\n2;right\n" * 20)
    code, said = ran(capsys, "import", "--look", tmp_path / "log.csv")
    assert code == 0
    assert "no three columns look like a gyro" in said
