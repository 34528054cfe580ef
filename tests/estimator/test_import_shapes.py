"""Recordings of other people in the shapes they come in: what the mapping examples make of them, and what is told."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import (
    CSV,
    EARTH_DPS,
    GYRO,
    POSES,
    RATE,
    SHAPES,
    broken_log,
    gyro_encoder_angle,
    gyro_encoder_rate,
    hours_of_rest,
    rest_poses,
    spindle,
    temperature_plateaus,
    up_and_down,
)
from support import changed

from estimator.calibration.gyro import GyroCalibration
from estimator.calibration.values import Calibration
from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.importing.importing import SOURCE, Imported, import_recording
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from estimator.recordings.writing import write_recording
from station.opening.captures import PROTOCOLS

TRIAD = CSV + "[time]\nrate_hz = 100\n" + GYRO + RATE

COUNTING = """\
[device]
name = "one gyro"
[file]
format = "csv"
[time]
rate_hz = 200
[gyro]
columns = ["gyro"]
axes = ["z"]
unit = "deg/s"
[reference]
kind = "rate"
columns = ["count"]
axis = "z"
unit = "raw"
count = 72
count_unit = "deg/s"
"""


def shape(name: str, *changes: tuple[str, str]) -> str:
    return changed((SHAPES / f"{name}.toml").read_text(), *changes, most=1)


def imported(tmp_path: Path, mapping: str, *files: Path) -> Imported:
    (tmp_path / "mapping.toml").write_text(mapping)
    return import_recording(read_mapping(tmp_path / "mapping.toml"), files)


def calibrated(tmp_path: Path, mapping: str, *files: Path) -> tuple[Recording, Calibration]:
    recording = imported(tmp_path, mapping, *files).recording
    path = tmp_path / "recording.h5"
    path.unlink(missing_ok=True)
    write_recording(path, recording)
    recording = read_recording(path)
    return recording, calibrate(recording)


def only(calibration: Calibration) -> GyroCalibration:
    assert len(calibration.gyros) == 1
    return calibration.gyros[0]


def assert_within(gyro: GyroCalibration, k: float, b_dps: float, sigmas: float = 4.0) -> None:
    assert abs(gyro.states[0] - k) < sigmas * gyro.sd[0]
    assert abs(np.degrees(gyro.states[1]) - b_dps) < sigmas * np.degrees(gyro.sd[1])


def swinging(count: int = 4000) -> np.ndarray:
    t = np.arange(count) / 100
    return np.column_stack([30 * np.sin(t), 20 * np.cos(1.3 * t), 25 * np.sin(0.7 * t)])


def table_of(path: Path, heading: str, rows: np.ndarray) -> Path:
    """Write rows; NaN becomes a blank."""
    lines = [",".join("" if np.isnan(v) else f"{v:.6f}" for v in row) for row in rows]
    path.write_text(heading + "\n" + "\n".join(lines) + "\n")
    return path


def source(recording: Recording) -> ImuData:
    return recording.sources[SOURCE]


# --- one gyro and an encoder


def test_counts_of_unknown_size_and_sign_calibrate_against_an_encoders_rate(tmp_path: Path) -> None:
    log = gyro_encoder_rate(tmp_path / "log.csv")
    recording, calibration = calibrated(tmp_path, shape("gyro_encoder_rate"), log)
    told = str(recording.attributes["imported"])
    assert "one count is 0.0704 deg/s" in told
    assert 'opposite to the stated axis, so "-z" is used' in told
    np.testing.assert_allclose(source(recording).array.p, [[0, 0, -1]])
    assert_within(only(calibration), k=1 - 14.2 * 0.0704, b_dps=-1.3 * 14.2 * 0.0704)
    assert only(calibration).sd[0] < 1e-3
    assert any("turns about z only" in note for note in calibration.notes)


def test_held_values_repeated_rows_and_coarse_stamps_are_seen_through(tmp_path: Path) -> None:
    log = gyro_encoder_rate(tmp_path / "log.csv")
    run = imported(tmp_path, shape("gyro_encoder_rate"), log)
    notes = "\n".join(run.notes)
    assert "the gyro is new in one row of 4 (50 Hz)" in notes
    assert "the reference is new in one row of 3 (66.7 Hz)" in notes
    assert "duplicate rows were skipped" in notes
    t_s = source(run.recording).t_ns * 1e-9
    assert len(t_s) == pytest.approx(2000, abs=2)
    assert np.median(np.diff(t_s)) == pytest.approx(0.02, rel=1e-3)


@pytest.mark.parametrize(
    ("axis", "count", "told", "k"),
    [
        ("z", 0.0704, r'factor -1.000\). Write axis "-z" instead of "z"', 2.0),
        ("-z", 0.0915, "output is 1.3 times the reference. Check unit and count", -0.3),
    ],
)
def test_a_wrong_sign_or_count_is_told_and_does_not_pull_the_estimate(
    tmp_path: Path, axis: str, count: float, told: str, k: float
) -> None:
    log = gyro_encoder_rate(tmp_path / "log.csv")
    mapping = shape(
        "gyro_encoder_rate",
        ('scale = "from data"', f"count = {count}"),
        ('sign = "from data"', ""),
        ('axes = ["z"]', f'axes = ["{axis}"]'),
    )
    recording, calibration = calibrated(tmp_path, mapping, log)
    assert re.search(told, str(recording.attributes["imported"]))
    assert only(calibration).states[0] == pytest.approx(k, abs=0.002)
    assert any(re.match("z: (its|the) output is", note) for note in calibration.notes)


def test_the_angle_of_an_encoder_is_a_table_of_one_axis(tmp_path: Path) -> None:
    recording, calibration = calibrated(tmp_path, shape("gyro_encoder_angle"), gyro_encoder_angle(tmp_path / "log.csv"))
    assert isinstance(recording.reference, TableReadings)
    assert recording.reference.gimbals == ("z",)
    assert_within(only(calibration), k=0.004, b_dps=-0.4)
    assert only(calibration).sd[0] < 1e-4
    assert any("the table turns about z only" in note for note in calibration.notes)


def test_an_encoder_that_counts_backwards_is_told_or_turned_round(tmp_path: Path) -> None:
    log = gyro_encoder_angle(tmp_path / "log.csv", turn=-1)
    _, calibration = calibrated(tmp_path, shape("gyro_encoder_angle"), log)
    assert any("opposite to the reference, so k is near 2" in note for note in calibration.notes)
    for change in (('axis = "z"', 'axis = "-z"'), ('unit = "deg/s"', 'unit = "deg/s"\nsign = "from data"')):
        _, calibration = calibrated(tmp_path, shape("gyro_encoder_angle", change), log)
        assert_within(only(calibration), k=0.004, b_dps=-0.4)


def test_the_angle_at_which_the_body_is_level_is_the_offset_of_the_encoder(tmp_path: Path) -> None:
    log = gyro_encoder_angle(tmp_path / "log.csv")
    change = ("count_unit", "offset = 1024   # a quarter of a turn\ncount_unit")
    moved = imported(tmp_path, shape("gyro_encoder_angle", change), log).recording.reference
    as_counted = imported(tmp_path, shape("gyro_encoder_angle"), log).recording.reference
    assert isinstance(moved, TableReadings)
    assert isinstance(as_counted, TableReadings)
    np.testing.assert_allclose(as_counted.angle_rad - moved.angle_rad, np.pi / 2, atol=1e-9)


def test_encoder_files_follow_each_other_wherever_the_angle_begins(tmp_path: Path) -> None:
    logs = [gyro_encoder_angle(tmp_path / f"{i}.csv", turn=1) for i in range(2)]
    cut = logs[1].read_text().splitlines()
    logs[1].write_text("\n".join([cut[0], *cut[1250:]]))
    _, calibration = calibrated(tmp_path, shape("gyro_encoder_angle"), *logs)
    assert_within(only(calibration), k=0.004, b_dps=-0.4)


def test_an_encoder_that_counts_per_sample_does_not_make_the_gyro_look_less_sensitive(tmp_path: Path) -> None:
    w = spindle(np.arange(8000) / 200)
    angle = np.concatenate([[0], np.cumsum((w[1:] + w[:-1]) / 400)])
    counted = np.diff(np.floor(angle / 360 * 1000), prepend=0)  # 72 deg/s each, at 40 deg/s
    gyro = 0.995 * w + 0.3 + np.random.default_rng(1).normal(scale=0.1, size=len(w))
    log = table_of(tmp_path / "log.csv", "gyro,count", np.column_stack([gyro, counted]))
    _, calibration = calibrated(tmp_path, COUNTING, log)
    assert_within(only(calibration), k=0.005, b_dps=-0.3)
    assert only(calibration).sd[0] < 0.002


def test_a_triad_on_a_spindle_gives_what_one_axis_can(tmp_path: Path) -> None:
    w = spindle(np.arange(4000) / 100)
    rate = np.column_stack([0 * w, 0 * w, w])
    gyros = 0.99 * rate - [0.1, 0.2, 0.3] + np.random.default_rng(2).normal(scale=0.05, size=rate.shape)
    log = table_of(tmp_path / "log.csv", "gx,gy,gz,rx,ry,rz", np.hstack([gyros, rate]))
    _, calibration = calibrated(tmp_path, TRIAD, log)
    z = calibration.gyros[2]
    assert_within(z, k=0.01, b_dps=0.3)
    for gyro, b in zip(calibration.gyros, (0.1, 0.2, 0.3), strict=True):
        assert np.degrees(gyro.states[1]) == pytest.approx(b, abs=0.02)
    notes = "\n".join(calibration.notes)
    assert "the body turns about z only" in notes
    assert "x: scale factor error k is not determined" in notes
    assert "z: scale factor error k" not in notes


def test_columns_in_the_wrong_order_are_refused_with_the_axis_they_follow(tmp_path: Path) -> None:
    w = swinging()
    log = table_of(tmp_path / "log.csv", "gx,gy,gz,rx,ry,rz", np.hstack([w[:, [1, 0, 2]] * [1, -1, 1], w]))
    with pytest.raises(RecordingError, match=r'x: the output follows the body rate about "y".*y: .* about "-x"'):
        imported(tmp_path, TRIAD, log)


def test_a_gyro_that_has_nothing_to_do_with_the_reference_is_told(tmp_path: Path) -> None:
    w = swinging()
    gyros = w.copy()
    gyros[:, 1] = np.random.default_rng(3).normal(scale=10, size=len(w))
    log = table_of(tmp_path / "log.csv", "gx,gy,gz,rx,ry,rz", np.hstack([gyros, w]))
    (note,) = imported(tmp_path, TRIAD, log).notes
    assert note.startswith("y: the output hardly follows the reference (0% of its variance)")


def test_a_reference_that_is_lost_is_not_bridged_but_one_that_is_slow_is_filled(tmp_path: Path) -> None:
    w = swinging()
    slow = np.where((np.arange(len(w)) % 5 == 0)[:, None], w, np.nan)
    slow[2000:2500] = np.nan
    log = table_of(tmp_path / "log.csv", "gx,gy,gz,rx,ry,rz", np.hstack([0.99 * w, slow]))
    _, calibration = calibrated(tmp_path, TRIAD, log)
    assert calibration.samples == pytest.approx(3 * (len(w) - 500), abs=30)
    for gyro in calibration.gyros:
        assert gyro.states[0] == pytest.approx(0.01, abs=1e-3)


def test_rows_of_other_devices_in_between_are_no_samples_of_the_gyro(tmp_path: Path) -> None:
    w = swinging(2000)
    gyro_rows = np.column_stack([np.arange(2000) / 100, 0.99 * w, np.full((2000, 3), np.nan)])
    reference_rows = np.column_stack([np.arange(2000) / 100 + 0.002, np.full((2000, 3), np.nan), w])
    rows = np.vstack([gyro_rows, reference_rows])
    rows = rows[np.argsort(rows[:, 0])]
    log = table_of(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", rows)
    recording, calibration = calibrated(tmp_path, TRIAD.replace("rate_hz = 100", 'column = "t"\nunit = "s"'), log)
    assert len(source(recording).t_ns) == 2000
    for gyro in calibration.gyros:
        assert gyro.states[0] == pytest.approx(0.01, abs=1e-3)


def test_rounded_values_do_not_pass_for_held_ones(tmp_path: Path) -> None:
    w = swinging()
    log = table_of(tmp_path / "log.csv", "gx,gy,gz,rx,ry,rz", np.hstack([np.round(w), w]))
    run = imported(tmp_path, TRIAD, log)
    assert [note for note in run.notes if "coarser than the noise" not in note] == []
    assert len(source(run.recording).t_ns) == len(w)


# --- rest


def test_rests_are_found_and_carry_the_specific_force(tmp_path: Path) -> None:
    recording, calibration = calibrated(tmp_path, shape("rest_poses"), rest_poses(tmp_path / "log.csv"))
    reference, data = recording.reference, source(recording)
    assert isinstance(reference, RateReadings)
    assert data.accel_mps2 is not None
    still = np.isfinite(reference.rate_rps).all(axis=1)
    assert (reference.rate_rps[still] == 0).all()
    assert "(7 rests)" in str(recording.attributes["imported"])
    for i, pose in enumerate(POSES):
        t_s = reference.t_ns * 1e-9
        inside = still & (t_s >= 12 * i) & (t_s < 12 * i + 12)
        assert 9 < inside.sum() / 100 < 10.1  # ten seconds of rest, two of handling
        up = data.accel_mps2[np.isin(data.t_ns, reference.t_ns[inside])].mean(axis=0)
        np.testing.assert_allclose(up, pose * 9.80665, atol=0.01)
    for gyro in calibration.gyros:
        assert np.degrees(gyro.states[1]) == pytest.approx(-0.5, abs=0.03)
    assert any("only the bias can be estimated" in note for note in calibration.notes)


def test_a_steady_turn_is_no_rest(tmp_path: Path) -> None:
    w = spindle(np.arange(4000) / 100)
    noise = np.random.default_rng(4).normal(scale=0.05, size=(len(w), 3))
    log = table_of(tmp_path / "log.csv", "gx,gy,gz", noise + 3 + np.column_stack([0 * w, 0 * w, w]))
    mapping = TRIAD.split("[reference]")[0] + '[reference]\nkind = "rest"\n'
    run = imported(tmp_path, mapping, log).recording
    assert isinstance(run.reference, RateReadings)
    still = np.isfinite(run.reference.rate_rps).all(axis=1)
    assert np.abs(w[still]).max() < 2
    assert still.sum() > 0.8 * (w == 0).sum()


def test_two_rests_upside_down_give_the_bias_less_earth_rate(tmp_path: Path) -> None:
    log = up_and_down(tmp_path / "log.csv")
    recording, calibration = calibrated(tmp_path, shape("up_and_down"), log)
    assert recording.site is not None
    assert np.degrees(recording.site.latitude_rad) == pytest.approx(48.14)
    assert isinstance(recording.reference, RateReadings)
    vertical = EARTH_DPS * np.sin(np.radians(48.14))
    known = np.degrees(recording.reference.rate_rps[np.isfinite(recording.reference.rate_rps).all(axis=1), 2])
    np.testing.assert_allclose(np.unique(np.round(np.abs(known), 6)), vertical, atol=1e-6)
    # The output in the body frame is z w_z on both rests, so the known rate turns its sign with the pose.
    assert np.sign(known[0]) == -np.sign(known[-1])
    assert_within(only(calibration), k=0, b_dps=0.02)
    assert np.degrees(only(calibration).sd[1]) < 0.001
    recording, calibration = calibrated(tmp_path, shape("up_and_down", ("earth_rate = true", "")), log)
    assert recording.site is None
    assert np.degrees(only(calibration).sd[1]) > 0.001  # the Earth makes a step of the bias
    assert "add earth_rate = true" in str(recording.attributes["imported"])


def test_up_is_taken_from_the_accelerometer_where_it_is_not_stated(tmp_path: Path) -> None:
    mapping = shape("rest_poses", ('kind = "rest"', 'kind = "rest"\nearth_rate = true'))
    run = imported(tmp_path, mapping + "[site]\nlatitude_deg = 90\n", rest_poses(tmp_path / "log.csv")).recording
    assert isinstance(run.reference, RateReadings)
    rate = np.degrees(run.reference.rate_rps)
    for i, pose in enumerate(POSES):
        np.testing.assert_allclose(rate[i * 1200 + 500], EARTH_DPS * pose, atol=1e-5)


def test_the_horizontal_part_of_earth_rate_needs_north(tmp_path: Path) -> None:
    log = rest_poses(tmp_path / "log.csv")
    sections = '[reference.sections]\na = { start_s = 0, end_s = 9, up = "z"NORTH }\n[site]\nlatitude_deg = 60\n'
    mapping = shape("rest_poses", ('kind = "rest"', 'kind = "rest"\nearth_rate = true'))
    unknown = imported(tmp_path, mapping + sections.replace("NORTH", ""), log)
    assert "horizontal part of Earth rate, up to 7.5 deg/h" in unknown.notes[-1]
    known = imported(tmp_path, mapping + sections.replace("NORTH", ', north = "-y"'), log)
    assert isinstance(known.recording.reference, RateReadings)
    expected = EARTH_DPS * np.array([0, -np.cos(np.radians(60)), np.sin(np.radians(60))])
    np.testing.assert_allclose(np.degrees(known.recording.reference.rate_rps[10]), expected, atol=1e-6)


def test_plateaus_of_temperature_come_with_temperature_and_pose(tmp_path: Path) -> None:
    log = temperature_plateaus(tmp_path / "log.csv")
    recording, _ = calibrated(tmp_path, shape("temperature_plateaus"), log)
    data, reference = source(recording), recording.reference
    assert data.temperature_c is not None
    assert data.accel_mps2 is not None
    assert np.isfinite(data.temperature_c).all()  # written once a second, blank between
    assert isinstance(reference, RateReadings)
    still = np.isfinite(reference.rate_rps).all(axis=1)
    assert still.sum() == 18000
    for first, warmth in ((0, -10), (7000, 22), (14000, 55)):
        assert data.temperature_c[first : first + 5900].mean() == pytest.approx(warmth, abs=0.05)
    assert str(recording.attributes["rests"]).count("\n") == 2
    some = imported(tmp_path, shape("temperature_plateaus", ("room = {}", "")), log)
    assert "rows labelled room count as motion" in some.notes


@pytest.mark.parametrize("rate_hz", [1.0, 20.0])
def test_hours_of_rest_show_the_random_walk_and_sigma_holds_it(tmp_path: Path, rate_hz: float) -> None:
    log = hours_of_rest(tmp_path / "log.csv", rate_hz=rate_hz)
    mapping = shape("hours_of_rest", ("rate_hz = 1", f"rate_hz = {rate_hz:g}"))
    recording, calibration = calibrated(tmp_path, mapping, log)
    gyro = only(calibration)
    assert gyro.noise is not None
    assert gyro.rest is not None
    assert gyro.rest.span_s == pytest.approx(3 * 3600, rel=0.01)
    assert np.degrees(gyro.noise.mean.arw) * 60 == pytest.approx(0.3, rel=0.1)
    assert 1 < np.degrees(gyro.noise.walk_below) * 3600 * 60 < 10  # 3 deg/h/rth
    white_dps = 0.3 / 60 / np.sqrt(3 * 3600)
    assert np.degrees(gyro.sd[1]) > 2 * white_dps
    assert np.degrees(gyro.states[1]) == pytest.approx(-0.05, abs=5 * np.degrees(gyro.sd[1]))
    assert np.degrees(gyro.noise_rps) == pytest.approx(0.3 / 60 * np.sqrt(rate_hz), rel=0.05)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        (
            'a = { start_s = 0, end_s = 9, up = "-z" }',
            r"section a: .* should point up, but according to the accelerometer it is \[0.00, 0.00, 1.00\]",
        ),
        ("a = { start_s = 0, end_s = 12 }", "should be at rest but turns at|section a: .*moves at"),
        ("a = { start_s = 900, end_s = 990 }", "begins at 900 s, but the file lasts 83.99 s"),
    ],
)
def test_a_stated_rest_that_is_none_is_refused_by_name(tmp_path: Path, section: str, message: str) -> None:
    mapping = shape("rest_poses", ("rest_s = 3 ", "# ")) + f"[reference.sections]\n{section}\n"
    with pytest.raises(RecordingError, match=message):
        imported(tmp_path, mapping, rest_poses(tmp_path / "log.csv"))


def test_a_file_without_a_rest_says_what_to_state(tmp_path: Path) -> None:
    mapping = TRIAD.split("[reference]")[0] + '[reference]\nkind = "rest"\n'
    log = table_of(tmp_path / "log.csv", "gx,gy,gz", swinging())
    with pytest.raises(RecordingError, match=r"no rest of 2 s was found. State the rests in .*start_s"):
        imported(tmp_path, mapping, log)


def test_an_accelerometer_in_another_unit_is_told(tmp_path: Path) -> None:
    run = imported(tmp_path, shape("rest_poses", ('"g"', '"m/s2"')), rest_poses(tmp_path / "log.csv"))
    assert "at rest the accelerometer shows 1 m/s2 instead of 9.81" in run.notes[-1]


# --- text logs


def test_a_log_with_broken_lines_loses_only_these(tmp_path: Path) -> None:
    recording, calibration = calibrated(tmp_path, shape("broken_log"), broken_log(tmp_path / "log.csv"))
    assert recording.attributes["skipped_lines"] == 42  # 40 spoilt, heading and units once more
    assert "42 broken lines are skipped, the first is line " in str(recording.attributes["imported"])
    t_ns = source(recording).t_ns
    assert t_ns[-1] == (1500 - 1 + 1) * 20_000_000  # each spoilt line keeps its place, as does the row of units
    for gyro in calibration.gyros:
        assert_within(gyro, k=0.01, b_dps=0.5)


def test_a_log_broken_in_too_many_lines_is_refused_with_the_first_of_them(tmp_path: Path) -> None:
    log = broken_log(tmp_path / "log.csv", broken=300)
    with pytest.raises(RecordingError, match=r"302 of 150\d lines are not rows of 6 fields .*the first is line \d+ \("):
        imported(tmp_path, shape("broken_log"), log)
    with pytest.raises(RecordingError, match="decimal mark '.', the first is line 6"):
        imported(tmp_path, shape("broken_log", ('decimal = ","', 'decimal = "."')), log)


def test_a_row_of_units_that_says_otherwise_is_told(tmp_path: Path) -> None:
    run = imported(
        tmp_path, shape("broken_log", ('unit = "deg/s"', 'unit = "rad/s"')), broken_log(tmp_path / "log.csv")
    )
    assert "the row of units says deg/s for the gyro, but the mapping does not. Check unit in [gyro]" in run.notes


def test_a_file_without_a_heading_asks_for_names(tmp_path: Path) -> None:
    log = hours_of_rest(tmp_path / "log.csv", hours=0.1)
    mapping = shape("hours_of_rest", ('columns = ["rate"]        # the file has no heading', ""))
    with pytest.raises(RecordingError, match=r"no column rate.*if it has no heading, name its columns with columns ="):
        imported(tmp_path, mapping, log)


def test_blanks_separate_fields_and_a_heading_may_be_a_comment(tmp_path: Path) -> None:
    w = swinging(500)
    log = tmp_path / "log.txt"
    np.savetxt(log, np.hstack([0.99 * w, w]), header="gx gy gz rx ry rz", fmt="%12.6f")
    run = imported(tmp_path, TRIAD.replace('"csv"', '"csv"\ndelimiter = "space"'), log)
    assert run.recording.attributes["skipped_lines"] == 0
    assert len(source(run.recording).t_ns) == 500


def test_a_degree_sign_in_an_old_encoding_is_read(tmp_path: Path) -> None:
    w = swinging(500)
    heading = "gx [°/s],gy,gz,rx,ry,rz"
    log = tmp_path / "log.csv"
    rows = "\n".join(",".join(f"{v:.6f}" for v in row) for row in np.hstack([0.99 * w, w]))
    log.write_bytes(f"{heading}\n{rows}\n".encode("latin-1"))
    assert len(source(imported(tmp_path, TRIAD.replace('"gx"', '"gx [°/s]"'), log).recording).t_ns) == 500


# --- mappings


@pytest.mark.parametrize("path", sorted(SHAPES.glob("*.toml")), ids=lambda path: path.stem)
def test_every_example_is_a_mapping(path: Path) -> None:
    assert read_mapping(path, PROTOCOLS).device


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("gyro_encoder_rate", 'axis = "z"', "", r'reference.columns: is one column: add axis = "z"'),
        ("gyro_encoder_rate", 'axes = ["z"]', "", r"there are 1 columns but 3 axes .*axes = \[\"z\"\] for one gyro"),
        ("gyro_encoder_rate", 'scale = "from data"', "", r"line \d+: gyro: count is missing"),
        ("gyro_encoder_angle", 'axis = "z"', 'axis = "q"', r"line \d+: reference.axis: 'q' is not an axis"),
        (
            "up_and_down",
            "latitude_deg = 48.14",
            "latitude_deg = 98",
            r"site.latitude_deg: 98: write -90 to 90",
        ),
        (
            "up_and_down",
            "[site]\nlatitude_deg = 48.14",
            "",
            r"reference.earth_rate: needs the latitude: add a table",
        ),
        ("up_and_down", ', up = "-z"', "", r"reference.earth_rate: needs the direction up"),
        ("up_and_down", "end_s = 290", "end_s = 0.5, begin = 2", r"line \d+: reference.sections.up.begin: unknown key"),
        ("up_and_down", "start_s = 310, end_s = 600, ", "", r"reference.sections.down: start_s is missing"),
        (
            "up_and_down",
            "earth_rate = true",
            'earth_rate = "yes"',
            r"reference.earth_rate: 'yes' is not true or false",
        ),
        (
            "rest_poses",
            'axes = ["x", "-y", "-z"]',
            'axes = ["x", "x", "z"]',
            "three orthogonal directions of length 1",
        ),
        (
            "rest_poses",
            'unit = "deg/s"',
            'unit = "deg/s"\nscale = "from data"',
            r'scale = "from data" in \[gyro\] needs a rate',
        ),
        (
            "rest_poses",
            "rest_s = 3",
            'where = "there"',
            r"reference.where: 'there' is not one of found, everywhere",
        ),
    ],
)
def test_a_mapping_that_is_wrong_says_what_to_write(
    tmp_path: Path, name: str, old: str, new: str, message: str
) -> None:
    (tmp_path / "mapping.toml").write_text(shape(name, (old, new)))
    with pytest.raises(RecordingError, match=message):
        read_mapping(tmp_path / "mapping.toml")
