"""Recordings of others by kind = "poses": what was published of them is found again, and the file opens again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from handheld import Log, Session, Truth, device, general_poses, make, on_board

from estimator.errors import RecordingError
from estimator.importing.hands.mapping import read_pose_mapping
from estimator.importing.hands.session import calibrate_by_hand
from estimator.poses.calibration import PoseCalibration, PoseSession, gyro_vector
from estimator.poses.file import read_pose_session, write_pose_session
from estimator.poses.intrinsic import Intrinsic

DATA = Path(__file__).parents[1] / "data" / "poses"
MG = 9.80665e-3
MAPPING = """\
[device]
name = "by hand"
[file]
format = "csv"
[time]
column = "t"
unit = "s"
[accelerometer]
columns = ["ax", "ay", "az"]
unit = "m/s2"
[reference]
kind = "poses"
"""


def imported(name: str, data: str) -> PoseSession:
    return calibrate_by_hand(read_pose_mapping(DATA / f"{name}.toml"), [DATA / data])


def upper_form(result: PoseCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Return the scales K (3,) of x = T K (raw - b), T upper triangular with ones, and b in m/s2."""
    inverse = np.linalg.inv(result.intrinsic.matrix)
    _, upper = np.linalg.qr(inverse)
    return np.abs(np.diag(upper)), result.intrinsic.offset


def test_means_of_24_poses_give_the_published_scales_and_biases() -> None:
    result = imported("poses24", "poses24.mat").accelerometer
    scales, biases = upper_form(result)
    assert scales == pytest.approx([1.0079, 0.9968, 0.9923], abs=2e-4)
    assert biases[0] == pytest.approx(0.9 * MG, abs=0.5 * MG)
    assert -5.7 * MG - 0.5 * MG < biases[1] < -5.2 * MG + 0.5 * MG
    assert 13.6 * MG - 0.5 * MG < biases[2] < 14.1 * MG + 0.5 * MG
    assert result.before_mps2 == pytest.approx(15.4 * MG, rel=0.02)
    assert result.after_mps2 < 0.5 * MG
    assert len(result.used) == 24


def test_a_phone_with_coarse_steps_is_calibrated_as_published() -> None:
    result = imported("phone", "phone_lis3dh_30_poses.mat").accelerometer
    assert 0.1 < result.before_mps2 < 0.12
    assert result.after_mps2 < 0.033
    assert len(result.used) >= 28


def test_a_session_by_hand_without_a_list_of_rests_is_calibrated() -> None:
    result = imported("imu0", "imu0_50hz.log").accelerometer
    assert result.before_mps2 == pytest.approx(0.207, abs=0.01)
    assert result.after_mps2 < 0.004
    assert 19 <= len(result.used) <= 26
    assert result.shown.all()


def test_the_written_file_opens_again_with_everything(tmp_path: Path) -> None:
    session = imported("phone", "phone_lis3dh_30_poses.mat")
    write_pose_session(tmp_path / "phone.h5", session)
    again = read_pose_session(tmp_path / "phone.h5")
    assert again.device == "LIS3DH in a phone"
    assert again.notes == session.notes
    first, second = session.accelerometer, again.accelerometer
    assert second.parameters == first.parameters
    assert second.covariance == pytest.approx(first.covariance)
    assert second.gravity == first.gravity
    assert [rest.refused for rest in second.rests] == [rest.refused for rest in first.rests]
    assert [rest.duration_s for rest in second.rests] == [rest.duration_s for rest in first.rests]
    with pytest.raises(RecordingError, match="cannot create"):
        write_pose_session(tmp_path / "phone.h5", session)
    assert read_pose_session(tmp_path / "phone.h5").device == "LIS3DH in a phone"


def test_a_calibration_that_cannot_be_written_leaves_no_file_in_the_way_of_the_next_attempt(tmp_path: Path) -> None:
    session = imported("poses24", "poses24.mat")
    with pytest.raises(RecordingError, match="cannot create"):
        write_pose_session(tmp_path / "new.h5", replace(session, notes=("a text that HDF5 cannot hold: \0",)))
    write_pose_session(tmp_path / "new.h5", session)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "poses"', 'kind = "poses"\ngravity_mps2 = 980', "line 13: reference.gravity_mps2: .*write 9.7 to 9.9"),
        ('kind = "poses"', 'kind = "poses"\nheight_m = 100', "height_m: needs gravity_mps2, or a table .site."),
        ('kind = "poses"', 'kind = "poses"\ndata = "means"', 'is not for data = "means"'),
        ('kind = "poses"', 'kind = "poses"\nrests = 1', "rests: unknown key; did you mean rest_s?"),
        ('[time]\ncolumn = "t"\nunit = "s"\n', "", "has no table .time.: add it"),
        ('unit = "m/s2"', 'unit = "raw"\noffset = 1\ncount_unit = "g"', "count_unit: cannot be combined"),
    ],
)
def test_a_wrong_mapping_is_refused_with_its_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "mapping.toml"
    path.write_text(MAPPING.replace(old, new), encoding="utf-8")
    with pytest.raises(RecordingError, match=message):
        read_pose_mapping(path)


def test_rests_of_several_files_are_joined_and_a_broken_file_costs_only_itself(tmp_path: Path) -> None:
    rng = np.random.default_rng(21)
    truth = device(rng)
    poses = general_poses(rng, 18)
    for number, own in enumerate((poses[:9], poses[9:])):
        make(rng, truth, Session(up=own)).write(tmp_path / f"{number}.csv")
    (tmp_path / "2.csv").write_text("nothing\n", encoding="utf-8")
    (tmp_path / "mapping.toml").write_text(MAPPING + "gravity_mps2 = 9.81\n", encoding="utf-8")
    session = calibrate_by_hand(
        read_pose_mapping(tmp_path / "mapping.toml"), [tmp_path / f"{number}.csv" for number in range(3)]
    )
    result = session.accelerometer
    assert len(result.used) == 18
    assert {rest.file for rest in result.rests} == {"0.csv", "1.csv"}
    assert session.refused_files[0].startswith("2.csv: ")
    errors = [(own.value - true) / own.u95 for own, true in zip(result.parameters, truth.nine, strict=True)]
    assert np.abs(errors).max() < 2


GYRO = '[gyro]\ncolumns = ["gx", "gy", "gz"]\nunit = "rad/s"\n'


def turned(tmp_path: Path, seed: int = 31, change: str = "") -> tuple[Truth, PoseSession]:
    """Return the truth and the calibration of a session with gyros; ``change`` replaces their columns."""
    rng = np.random.default_rng(seed)
    truth = device(rng)
    path = make(rng, truth, Session(up=general_poses(rng, 18))).write(tmp_path / "log.csv")
    text = MAPPING + "gravity_mps2 = 9.81\n" + (change or GYRO)
    (tmp_path / "mapping.toml").write_text(text, encoding="utf-8")
    return truth, calibrate_by_hand(read_pose_mapping(tmp_path / "mapping.toml"), [path])


def test_gyros_are_calibrated_by_the_turns_between_rests(tmp_path: Path) -> None:
    truth, session = turned(tmp_path)
    result = session.gyro
    assert result is not None
    assert result.turns == 17
    # The frame of the accelerometers' matrix is turned against the body in which the truth is stated.
    frame = np.linalg.solve(Intrinsic.of_matrix(truth.accel, truth.bias).matrix, truth.accel)
    expected = gyro_vector(truth.gyro @ frame.T, truth.gyro_bias)
    errors = [(own.value - true) / own.u95 for own, true in zip(result.parameters, expected, strict=True)]
    assert np.abs(errors).max() < 2
    assert result.after_rad < 0.2 * result.before_rad
    write_pose_session(tmp_path / "session.h5", session)
    again = read_pose_session(tmp_path / "session.h5").gyro
    assert again is not None
    assert again.parameters == result.parameters


def test_a_dead_gyro_is_named_and_the_accelerometers_are_calibrated(tmp_path: Path) -> None:
    rng = np.random.default_rng(32)
    log = make(rng, device(rng), Session(up=general_poses(rng, 12)))
    log.gyro[:, 1] = 0.25
    (tmp_path / "mapping.toml").write_text(MAPPING + GYRO, encoding="utf-8")
    session = calibrate_by_hand(read_pose_mapping(tmp_path / "mapping.toml"), [log.write(tmp_path / "log.csv")])
    assert session.gyro is None
    assert "the gyros are not calibrated: gyro y puts out 14.32 deg/s all the time" in session.notes[-1]
    assert session.accelerometer.shown.all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('["gx", "gy", "gz"]', '["gy", "gx", "gz"]', r"gyros taken as \(y, x, z\)"),
        ('["gx", "gy", "gz"]', '["gx", "gy", "gz"]\naxes = ["x", "y", "-z"]', r"\(x, y, -z\); one .* is left-handed"),
        ("rad/s", "deg/s", "gyros taken to be in rad/s"),
    ],
)
def test_gyros_that_contradict_the_accelerometers_are_a_gross_error(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        turned(tmp_path, change=GYRO.replace(old, new))


FERRARIS = Path(__file__).parents[1] / "data" / "ferraris"
IMUCAL_ACC = np.array([[0.996608, -0.014782, -0.007457], [0.008598, 1.002399, 0.001848], [0.013643, 0.00205, 1.023302]])
IMUCAL_GYR = np.array(
    [[1.027903, -0.000467, -0.006591], [-0.000218, 0.982424, -0.002735], [0.009698, 0.007628, 0.998234]]
)
"""K R of imucal 2.6 for this session; its biases follow."""
IMUCAL_BIAS = [0.537117, -0.616203, 0.398867]
IMUCAL_GYR_BIAS = np.radians([-0.599669, -0.369843, 0.058774])


def test_a_ferraris_session_gives_what_imucal_gives_within_its_uncertainty(tmp_path: Path) -> None:
    session = calibrate_by_hand(read_pose_mapping(FERRARIS / "mapping_poses.toml"), [FERRARIS / "session.csv"])
    force, gyro = session.triads
    published = (
        (force, gyro_vector(IMUCAL_ACC, np.array(IMUCAL_BIAS))),
        (gyro, gyro_vector(IMUCAL_GYR, IMUCAL_GYR_BIAS)),
    )
    for triad, values in published:
        for own, other in zip(triad.parameters, values, strict=True):
            assert own.value == pytest.approx(other, abs=own.u95), own.name
    assert force.parameters[0].u95 < 1e-3
    assert gyro.parameters[0].u95 < 0.015
    assert session.accelerometer.after_mps2 < 0.002
    write_pose_session(tmp_path / "session.h5", session)
    again = read_pose_session(tmp_path / "session.h5").triads
    assert [triad.parameters for triad in again] == [triad.parameters for triad in session.triads]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"acc_x", "acc_y"', '"acc_y", "acc_x"', "gross error.*x_p: x is stated to point up, but y does"),
        ('x_p = { up = "x" }', 'x_p = { up = "-x" }', "gross error.*x_p: -x is stated to point up, but x does"),
        (
            'axis = "x", angle_deg = -360',
            'axis = "x", angle_deg = 360',
            "x_rot is stated to turn by 360 deg, but .* -37",
        ),
        ('unit = "m/s2"', 'unit = "g"', "its values look like m/s2 given as g"),
        ('x_p = { up = "x" }', "x_p = {}", "x_p: states nothing: write up"),
        ('axis = "x", angle_deg = -360', 'axis = "x", angle_deg = 0', "x_rot.*angle_deg: is 0: state .* as a rest"),
    ],
)
def test_a_stated_pose_or_turn_that_is_another_is_a_gross_error(
    tmp_path: Path, old: str, new: str, message: str
) -> None:
    text = (FERRARIS / "mapping_poses.toml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "mapping.toml").write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(RecordingError, match=message):
        calibrate_by_hand(read_pose_mapping(tmp_path / "mapping.toml"), [FERRARIS / "session.csv"])


ARMS_MM = np.array([[0.0, 0.0, 0.0], [20.0, 0.0, 1.0], [0.0, 15.0, -1.0], [-10.0, 8.0, 2.0]])


def board_calibrated(folder: Path, logs: list[Log]) -> PoseSession:
    """Return the session of the logs of IMUs on one board, written to a file and imported."""
    columns = ["t"]
    text = '[device]\nname = "board"\n[file]\nformat = "csv"\n[time]\ncolumn = "t"\nunit = "s"\n'
    text += '[reference]\nkind = "poses"\ngravity_mps2 = 9.81\n'
    for number in range(len(logs)):
        force, rate = ([f"{what}{number}{axis}" for axis in "xyz"] for what in "ag")
        columns += [*force, *rate]
        text += f'[[imu]]\nname = "IMU {number + 1}"\naccelerometer = {{ columns = {force}, unit = "m/s2" }}\n'
        text += f'gyro = {{ columns = {rate}, unit = "rad/s" }}\n'
    rows = np.column_stack([logs[0].t_s, *(part for log in logs for part in (log.accel, log.gyro))])
    np.savetxt(folder / "board.csv", rows, "%.9g", ",", header=",".join(columns), comments="")
    (folder / "mapping.toml").write_text(text.replace("'", '"'), encoding="utf-8")
    return calibrate_by_hand(read_pose_mapping(folder / "mapping.toml"), [folder / "board.csv"])


def test_imus_on_one_board_are_located_by_fast_turns_and_saturated_samples_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(41)
    truths = [device(rng) for _ in ARMS_MM]
    limit = 10.0
    logs = on_board(rng, truths, ARMS_MM * 1e-3, Session(up=general_poses(rng, 18), rate_hz=100.0), limit)
    for log in logs:
        log.gyro[-500] = np.nan  # a blank in each column
    session = board_calibrated(tmp_path, logs)
    board = session.board
    assert board is not None
    held = np.any([np.abs(log.gyro) == limit for log in logs], axis=(0, 2))
    assert board.saturated == held.sum() > 50
    for imu, arm in zip(board.imus[1:], ARMS_MM[1:], strict=True):
        true_m = float(np.linalg.norm(arm)) * 1e-3
        assert imu.distance_m == pytest.approx(true_m, abs=2e-4), imu.name
        assert abs(imu.distance_m - true_m) < 1.5 * imu.distance_u95_m
    # The device's own frames differ by what its matrices do not show.
    assert max(np.abs(imu.rotation - np.eye(3)).max() for imu in board.imus) < 0.1
    write_pose_session(tmp_path / "board.h5", session)
    again = read_pose_session(tmp_path / "board.h5").board
    assert again is not None
    assert [imu.distance_m for imu in again.imus] == [imu.distance_m for imu in board.imus]


def test_an_imu_that_shares_no_rest_with_the_first_is_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(41)
    session = Session(up=general_poses(rng, 36), rate_hz=50.0)
    logs = on_board(rng, [device(rng) for _ in range(3)], ARMS_MM[:3] * 1e-3, session, 10.0)
    half = len(logs[0].t_s) // 2
    for log, shaken in zip(logs, (slice(half, None), slice(half, None), slice(half)), strict=True):
        log.accel[shaken] += 3.0 * rng.normal(size=log.accel[shaken].shape)
    with pytest.raises(RecordingError, match="IMU 3 cannot be placed .*: 0 of its rests are also rests of IMU 1"):
        board_calibrated(tmp_path, logs)
