"""Recordings made elsewhere: real extracts end to end, and what is refused."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import GYRO, STAMPED, imported, written

from estimator.calibration.values import Calibration
from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.importing.importing import SOURCE
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import AttitudeReadings, RateReadings, TableReadings, Turns
from estimator.recordings.writing import write_recording

DATA = Path(__file__).parents[1] / "data"

RATE_MAPPING = """\
[device]
name = "unit 7"

[file]
format = "csv"

[time]
rate_hz = 100

[gyro]
columns = ["gx", "gy", "gz"]
unit = "deg/s"
axes = ["x", "-y", "z"]

[reference]
kind = "rate"
columns = ["rx", "ry", "rz"]
unit = "deg/s"
"""


def through_file(tmp_path: Path, recording: Recording) -> Recording:
    path = tmp_path / "recording.h5"
    write_recording(path, recording)
    return read_recording(path)


def calibrated(tmp_path: Path, mapping: Path, *files: Path) -> tuple[Recording, Calibration]:
    recording = through_file(tmp_path, imported(mapping, *files).recording)
    return recording, calibrate(recording)


def states(calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    return np.array([g.states for g in calibration.gyros]), np.array([g.sd for g in calibration.gyros])


def rate_rows(count: int = 600, k: float = 0.01) -> list[str]:
    """Rows of a gyro triad whose y axis is mounted upside down, beside the body rates in deg/s."""
    t = np.arange(count) / 100
    w = np.column_stack([30 * np.sin(t), 20 * np.cos(1.3 * t), 25 * np.sin(0.7 * t)])
    y = (1 - k) * w * [1, -1, 1] - 0.5
    return ["gx,gy,gz,rx,ry,rz"] + [",".join(f"{v:.9f}" for v in (*a, *b)) for a, b in zip(y, w, strict=True)]


# --- real data, end to end


def test_two_optical_trials_agree_within_their_sigmas_and_are_a_percent_from_nominal(tmp_path: Path) -> None:
    results = []
    for trial in ("01_undisturbed_slow_rotation_A", "04_undisturbed_slow_rotation_with_breaks_A"):
        (tmp_path / trial).mkdir()
        recording, calibration = calibrated(
            tmp_path / trial, DATA / "broad/mapping.toml", DATA / f"broad/{trial}_60s.mat"
        )
        assert isinstance(recording.reference, AttitudeReadings)
        results.append(states(calibration))
    (first, first_sd), (second, second_sd) = results
    for x in (first, second):
        assert np.abs(x[:, 0]).max() < 0.01  # k: a frame or a sign that is wrong gives 1 or 2
        assert np.abs(x[:, 2:]).max() < 0.01
        assert x[2, 1] == pytest.approx(np.radians(-0.48), abs=np.radians(0.1))  # bias of z, as at rest
    apart = (first - second) / np.hypot(first_sd, second_sd)
    assert np.sqrt((apart**2).mean()) < 2
    assert np.abs(apart).max() < 4


def test_the_bias_from_the_optical_reference_is_the_mean_at_rest(tmp_path: Path) -> None:
    from scipy.io import loadmat

    file = DATA / "broad/04_undisturbed_slow_rotation_with_breaks_A_60s.mat"
    _, calibration = calibrated(tmp_path, DATA / "broad/mapping.toml", file)
    raw = loadmat(file)
    at_rest = raw["imu_gyr"][raw["movement"][:, 0] == 0].mean(axis=0)
    x, sd = states(calibration)
    np.testing.assert_allclose(x[:, 1], -at_rest, atol=4 * float(sd[:, 1].max()))


def test_a_ferraris_session_gives_what_its_segment_means_give(tmp_path: Path) -> None:
    folder = DATA / "ferraris"
    recording, calibration = calibrated(tmp_path, folder / "mapping.toml", folder / "session.csv")
    assert isinstance(recording.reference, Turns)
    raw = np.genfromtxt(folder / "session.csv", delimiter=",", names=True)
    gyro = np.column_stack([raw[f"gyr_{axis}"] for axis in "xyz"])
    limits = json.loads((folder / "session_list.json").read_text())
    rest = np.mean([gyro[s["start"] : s["end"]].mean(axis=0) for n, s in limits.items() if "rot" not in n], axis=0)
    x, sd = states(calibration)
    np.testing.assert_allclose(np.degrees(x[:, 1]), -rest, atol=0.02)
    for i, axis in enumerate("xyz"):
        s = limits[f"{axis}_rot"]
        turned_deg = ((gyro[s["start"] : s["end"], i] - rest[i]).sum()) / 102.4
        assert x[i, 0] == pytest.approx(1 - turned_deg / -360, abs=5e-4)
    assert sd[:, 0] == pytest.approx(2 / 360, rel=0.05)  # the doubt that was stated


def test_raw_counts_give_the_published_calibration_of_the_same_session(tmp_path: Path) -> None:
    folder = DATA / "ferraris"
    _, calibration = calibrated(tmp_path, folder / "mapping_counts.toml", folder / "session_counts.csv")
    x, _ = states(calibration)
    count_dps = 2000 / 2**15
    published = 1 - np.array([16.67769559, 16.18789520, 16.25336264]) * count_dps
    np.testing.assert_allclose(x[:, 0], published, atol=1e-3)
    bias_counts = np.array([1.960686, -4.472838, -3.651179])
    np.testing.assert_allclose(-np.degrees(x[:, 1]) / count_dps, bias_counts, atol=0.3)


@pytest.mark.parametrize(("phone", "mapping"), [("Iphone14pro", "iphone"), ("SamsungGalaxyS215G", "samsung")])
def test_a_phone_on_a_bench_is_a_percent_from_nominal_and_its_runs_agree(
    tmp_path: Path, phone: str, mapping: str
) -> None:
    files = sorted((DATA / "phones").glob(f"{phone}_*.csv"))
    recording, calibration = calibrated(tmp_path, DATA / f"phones/mapping_{mapping}.toml", *files)
    x, sd = states(calibration)
    assert np.abs(x[:, 0]).max() < 0.02
    assert (np.abs(x[:, 0]) < 4 * sd[:, 0]).all()
    assert np.abs(np.degrees(x[:, 1])).max() < 1
    assert isinstance(recording.reference, Turns)
    assert len(recording.reference.sd_rad) == len(files)
    data = recording.sources[SOURCE]
    for start, end, turn in zip(
        recording.reference.t_start_ns, recording.reference.t_end_ns, recording.reference.turn_rad, strict=True
    ):
        inside = (data.t_ns >= start) & (data.t_ns <= end)
        t_s = (data.t_ns[inside] - start) * 1e-9
        turned = np.trapezoid(data.rate_rps[inside] + x[:, 1], t_s, axis=0)
        assert np.linalg.norm(turned - turn) < 0.04 * np.linalg.norm(turn) + np.radians(2)


def test_a_stepper_motor_with_an_encoder_gives_the_factor_of_its_axis(tmp_path: Path) -> None:
    run = imported(DATA / "mpu6050" / "yaw.toml", DATA / "mpu6050" / "yaw_medium_110s.mat")
    assert "2 duplicate rows were skipped" in run.notes
    data, reference = run.recording.sources[SOURCE], run.recording.reference
    assert len(data.t_ns) == 11000 - 561 - 2
    assert data.t_ns[0] == 0
    assert isinstance(reference, TableReadings)
    assert reference.gimbals == ("z",)
    # The table of the source has a factor of -1.0065 to the encoder, whose sense the mapping turns round.
    over_1_s = slice(50, -50, 100)
    turned = np.cumsum(data.rate_rps[:, 2]) * np.median(np.diff(data.t_ns)) * 1e-9
    slope = np.polyfit(reference.angle_rad[over_1_s, 0], turned[over_1_s], 1)[0]
    assert slope == pytest.approx(1.0065, abs=0.01)
    assert data.accel_mps2 is not None
    np.testing.assert_allclose(data.accel_mps2.mean(axis=0), [0, 0, 9.8], atol=0.2)


def test_part_of_a_file_is_read_by_rows_or_by_seconds(tmp_path: Path) -> None:
    def limited(limits: str) -> ImuData:
        mapping = RATE_MAPPING.replace('format = "csv"', f'format = "csv"\n{limits}')
        return imported(*written(tmp_path, mapping, "\n".join(rate_rows()))).recording.sources[SOURCE]

    whole = limited("")
    by_row, by_time = limited("from_row = 100\nuntil_row = 350"), limited("from_s = 1\nuntil_s = 3.495")
    for part in (by_row, by_time):
        np.testing.assert_array_equal(part.rate_rps, whole.rate_rps[100:350])
        np.testing.assert_array_equal(part.t_ns, whole.t_ns[:250])
    with pytest.raises(RecordingError, match="has 600 rows to read: check from_row and until_row"):
        limited("from_row = 600")
    with pytest.raises(RecordingError, match=r"lasts 5.99 s. Check from_s and until_s"):
        limited("from_s = 7")
    (tmp_path / "mapping.toml").write_text(RATE_MAPPING.replace('"csv"', '"csv"\nfrom_s = 5\nuntil_s = 3', 1))
    with pytest.raises(RecordingError, match=r"line 7: file.until_s: 3 is not after from_s 5"):
        read_mapping(tmp_path / "mapping.toml")


COUNTS = """
[temperature]
column = "t"
unit = "raw"
count = 0.00294117647
count_unit = "degC"
offset = -12420.2           # MPU-6050: raw / 340 + 36.53

[accelerometer]
columns = ["gx", "gy", "gz"]
unit = "raw"
count = 0.001
count_unit = "g"
offset = 32768
"""


def test_counts_about_a_middle_become_rates_forces_and_temperatures(tmp_path: Path) -> None:
    w = 20 * np.random.default_rng(3).normal(size=(100, 3))
    counts = 32768 + np.round(w / 0.01)
    rows = [",".join(f"{v:.9g}" for v in (*c, *r, -340)) for c, r in zip(counts, w, strict=True)]
    raw = 'unit = "raw"\ncount = 0.01\ncount_unit = "deg/s"\noffset = 32768\naxes = ["x", "y", "z"]'
    mapping = RATE_MAPPING.replace('unit = "deg/s"\naxes = ["x", "-y", "z"]', raw) + COUNTS
    run = imported(*written(tmp_path, mapping, "\n".join(["gx,gy,gz,rx,ry,rz,t", *rows])))
    data = run.recording.sources[SOURCE]
    np.testing.assert_allclose(np.degrees(data.rate_rps), w, atol=0.0051)
    assert data.temperature_c is not None
    assert data.accel_mps2 is not None
    np.testing.assert_allclose(data.temperature_c, 35.53, atol=1e-3)
    np.testing.assert_allclose(data.accel_mps2, (counts - 32768) * 9.80665e-3)


def test_the_sense_of_a_turn_is_taken_from_the_data(tmp_path: Path) -> None:
    run = imported(DATA / "phones/mapping_iphone.toml", DATA / "phones/Iphone14pro_XG_10_1800_1.csv").recording
    assert isinstance(run.reference, Turns)
    np.testing.assert_allclose(np.degrees(run.reference.turn_rad), [[-1800, 0, 0]])


def test_runs_that_begin_or_end_in_motion_are_refused_by_name() -> None:
    phones = DATA / "phones"
    moving = [phones / "Iphone12_ZG_1_180_1_begins_late.csv", phones / "Iphone12_ZG_2_360_1_ends_early.csv"]
    result = imported(phones / "mapping_iphone.toml", phones / "Iphone12_ZG_1_180_1.csv", *moving)
    assert [r.name for r in result.refused] == [path.name for path in moving]
    assert "not at rest at the start" in result.refused[0].reason
    assert "not at rest at the end" in result.refused[1].reason
    assert result.recording.attributes["imported_from"] == "Iphone12_ZG_1_180_1.csv"
    assert moving[0].name in result.recording.attributes["refused"]
    with pytest.raises(RecordingError, match=r"begins_late.csv: it is not at rest at the start"):
        imported(phones / "mapping_iphone.toml", *moving)


def test_samples_that_were_written_twice_are_counted_once() -> None:
    run = imported(DATA / "phones/mapping_iphone.toml", DATA / "phones/Iphone14pro_ZG_2_90_1.csv").recording
    assert run.attributes["replayed_rows"] == 61
    assert len(run.sources[SOURCE].t_ns) == 229 - 61
    assert (np.diff(run.sources[SOURCE].t_ns) > 0).all()


def test_decimal_commas_and_scattered_stamps_become_an_even_grid() -> None:
    run = imported(DATA / "phones/mapping_samsung.toml", DATA / "phones/SamsungGalaxyS215G_ZG_10_1800_1.csv").recording
    data = run.sources[SOURCE]
    assert np.ptp(np.diff(data.t_ns)) <= 1
    assert np.diff(data.t_ns).mean() == pytest.approx(2e6, rel=1e-3)
    assert np.degrees(data.rate_rps[:, 2].max()) == pytest.approx(540, abs=30)
    assert "uniform rate of 499.9" in run.attributes["time_fit"]


# --- small files


def test_rates_of_another_instrument_are_a_reference_and_flipped_axes_are_allowed(tmp_path: Path) -> None:
    mapping, rows = written(tmp_path, RATE_MAPPING, "\n".join(rate_rows()))
    recording, calibration = calibrated(tmp_path, mapping, rows)
    assert isinstance(recording.reference, RateReadings)
    x, _ = states(calibration)
    np.testing.assert_allclose(x[:, 0], 0.01, atol=1e-5)
    np.testing.assert_allclose(np.degrees(x[:, 1]), 0.5, atol=1e-4)
    np.testing.assert_allclose(recording.sources[SOURCE].array.p[1], [0, -1, 0])


def test_the_recording_says_where_it_comes_from(tmp_path: Path) -> None:
    text = RATE_MAPPING.replace('"unit 7"', '"unit 7"\nlicence = "CC0"\nsource = "bench 3"')
    mapping, rows = written(tmp_path, text, "\n".join(rate_rows()))
    attributes = through_file(tmp_path, imported(mapping, rows).recording).attributes
    assert attributes["device"] == "unit 7"
    assert attributes["imported_from"] == "log.csv"
    assert attributes["mapping"] == text
    assert attributes["licence"] == "CC0"
    assert attributes["source"] == "bench 3"
    assert attributes["time_fit"] == "log.csv: 100 Hz as stated"
    assert attributes["skipped_lines"] == 0


def test_files_follow_each_other_with_a_gap(tmp_path: Path) -> None:
    mapping, first = written(tmp_path, RATE_MAPPING, "\n".join(rate_rows(300)))
    second = tmp_path / "second.csv"
    second.write_text("\n".join(rate_rows(200)))
    t_ns = imported(mapping, first, second).recording.sources[SOURCE].t_ns
    assert len(t_ns) == 500
    assert t_ns[300] - t_ns[299] == 10_000_000_000


def test_temperature_accelerometer_and_inverted_attitudes_come_along(tmp_path: Path) -> None:
    half = np.radians(30) * np.arange(400) / 100 / 2  # 30 deg/s about z
    noise = np.random.default_rng(1).normal(scale=0.01, size=(400, 3))
    rows = ["t,gx,gy,gz,ax,ay,az,temp,qx,qy,qz,qw"]
    for i, a in enumerate(half):
        blank = i in (50, 51)
        q = ",,," if blank else f"0,0,{-np.sin(a):.12f},{np.cos(a):.12f}"
        g = noise[i] + [0, 0, 30 * 0.99]
        rows.append(f"{i * 10},{g[0]:.6f},{g[1]:.6f},{g[2]:.6f},0,0,1,298.15,{q}")
    text = """\
[device]
name = "unit 8"
[file]
format = "csv"
[time]
column = "t"
unit = "ms"
[gyro]
columns = ["gx", "gy", "gz"]
unit = "deg/s"
[accelerometer]
columns = ["ax", "ay", "az"]
unit = "g"
[temperature]
column = "temp"
unit = "K"
[reference]
kind = "attitude"
columns = ["qx", "qy", "qz", "qw"]
order = "xyzw"
direction = "reference to body"
"""
    recording, calibration = calibrated(tmp_path, *written(tmp_path, text, "\n".join(rows)))
    data = recording.sources[SOURCE]
    assert data.temperature_c is not None
    assert data.accel_mps2 is not None
    np.testing.assert_allclose(data.temperature_c, 25)
    np.testing.assert_allclose(data.accel_mps2[0], [0, 0, 9.80665])
    assert isinstance(recording.reference, AttitudeReadings)
    assert np.isnan(recording.reference.attitude_wxyz).all(axis=1).sum() == 2
    # One rate only: scale and bias share the 0.3 deg/s that are missing.
    z = calibration.gyros[2].states
    assert z[0] * np.radians(30) + z[1] == pytest.approx(np.radians(0.3), rel=0.01)


def test_a_few_broken_lines_are_left_out_and_counted(tmp_path: Path) -> None:
    rows = rate_rows()
    rows[100] = "1,2"
    rows[200] = "x,1,1,1,1,1"
    rows.insert(300, "")
    run = imported(*written(tmp_path, RATE_MAPPING, "\n".join(rows))).recording
    assert run.attributes["skipped_lines"] == 2
    assert len(run.sources[SOURCE].t_ns) == 598


def test_a_file_broken_in_more_than_one_line_of_ten_is_refused_with_the_first_of_them(tmp_path: Path) -> None:
    rows = rate_rows(100)
    for i in range(2, 90, 8):
        rows[i] = "lost"
    message = r"log.csv: 11 of 100 lines are not rows of 6 fields with delimiter ','.*the first is line 3 \('lost'\)"
    with pytest.raises(RecordingError, match=message):
        imported(*written(tmp_path, RATE_MAPPING, "\n".join(rows)))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("", "log.csv: is empty"),
        ("gx,gy,gz,rx,ry,rz\n", "has a heading but no rows"),
        ("gx,gy,g_z,rx,ry,rz\n1,2,3,4,5,6\n", "has no column gz: its first line has gx, gy, g_z"),
        ("gx,gy,gz,rx,ry,rz\n" + "1,nan,3,4,5,6\n" * 20, "gyro column without any number"),
        ("gx,gy,gz,rx,ry,rz\n" + "1,2,3,,,\n" * 20, "no usable row of the reference"),
    ],
)
def test_files_without_usable_data_are_refused_with_the_reason(tmp_path: Path, rows: str, message: str) -> None:
    with pytest.raises(RecordingError, match=message):
        imported(*written(tmp_path, RATE_MAPPING, rows))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            '"unit 7"',
            '"unit 7"\ncolour = "red"',
            r"mapping.toml, line 3: device.colour: unknown key; known here: licence",
        ),
        (
            "[reference]",
            "[extra]\na = 1\n[reference]",
            r"mapping.toml, line 15: extra: unknown key; known here: acc",
        ),
        (
            'unit = "deg/s"\naxes',
            'unit = "turns"\naxes',
            r"line 12: gyro.unit: 'turns' is not one of rad/s, deg/s",
        ),
        (
            'kind = "rate"',
            'kind = "magic"',
            r"reference.kind: 'magic' is not one of attitude, rate, angle, turns, rest",
        ),
        ("rate_hz = 100", "rate_hz = 0", r"line 8: time.rate_hz: 0: write a number above 0"),
        ("rate_hz = 100", "", r"line 7: time: give one of rate_hz .*, rate_variable .* or column"),
        ('"-y"', '"w"', r"line 13: gyro.axes: 'w' is not an axis. Write x, y or z"),
        (
            'format = "csv"',
            'format = "csv"\ndecimal = ","',
            "delimiter: ',': write one character",
        ),
        ('name = "unit 7"', "", r"mapping.toml, line 1: device: name is missing"),
        ("[device]", "[device", "not valid TOML"),
        ("[time]\nrate_hz = 100", "", r"has no table \[time\]"),
    ],
)
def test_a_mapping_that_is_wrong_says_where_and_what_to_write(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in RATE_MAPPING
    mapping, _ = written(tmp_path, RATE_MAPPING.replace(old, new, 1), "")
    with pytest.raises(RecordingError, match=message):
        read_mapping(mapping)


@pytest.mark.parametrize(
    ("reference", "line", "message"),
    [
        (
            [f'[reference.files."{n}.csv"]\nup = "z"' for n in range(2500)] + ['[reference.files.last]\nup = "w"'],
            5018,
            "reference.files.last.up: 'w' is not an axis",
        ),
        (["where = [", *['"]where", # ['] * 5000, "]"], 17, "reference.where: "),
        (["# where", *['#"""up'] * 5000, 'where = "nowhere"'], 5018, "reference.where: 'nowhere' is not one of"),
        (['"up" = """', *["where ["] * 5000, '"""', "where = 3"], 5019, "reference.where: 3 is not a text"),
    ],
)
def test_what_is_wrong_in_a_long_mapping_is_told_at_once(
    tmp_path: Path, reference: list[str], line: int, message: str
) -> None:
    head = RATE_MAPPING.partition("kind =")[0]
    text = "\n".join([head + 'kind = "rest"', *reference])
    mapping, _ = written(tmp_path, text, "")
    began = time.process_time()
    with pytest.raises(RecordingError, match=re.escape(f"mapping.toml, line {line}: {message}")):
        read_mapping(mapping)
    assert time.process_time() - began < 5, "seconds: a share of a second, or minutes"


@pytest.mark.parametrize(
    "nested",
    ["[" * 5000 + "]" * 5000, "{a=" * 400 + "1" + "}" * 400, "1\nup" + ".a" * 2000 + " = 1"],
)
def test_a_mapping_nested_beyond_reason_is_refused_in_words(tmp_path: Path, nested: str) -> None:
    mapping, _ = written(tmp_path, f"{RATE_MAPPING}axis = {nested}\n", "")
    with pytest.raises(RecordingError, match=r"mapping\.toml: .*nested"):
        read_mapping(mapping)


TURN_MAPPING = STAMPED + GYRO + '[reference]\nkind = "turns"\naxis = "z"\nangle_deg = 90\nsd_deg = 0.5\n'


def turn_rows(stamps: np.ndarray, rate_dps: float = 90.0) -> str:
    """Rows of a turn about z that lasts the second second of three."""
    n = len(stamps)
    rate = np.where((np.arange(n) >= n // 3) & (np.arange(n) < 2 * n // 3), rate_dps, 0.0)
    ripple = 0.01 * np.sin(np.arange(n))
    return "t,gx,gy,gz\n" + "\n".join(
        f"{t:.6f},{r:.6f},0,{w + r:.6f}" for t, r, w in zip(stamps, ripple, rate, strict=True)
    )


def test_a_turn_the_other_way_than_stated_is_refused_unless_the_sense_is_from_the_data(tmp_path: Path) -> None:
    rows = turn_rows(np.arange(300) / 100, -90)
    with pytest.raises(RecordingError, match=r"gyros turn by -90.0 deg, but 90.0 deg are stated. Check axis, sign"):
        imported(*written(tmp_path, TURN_MAPPING, rows))
    run = imported(*written(tmp_path, TURN_MAPPING + 'sign = "from data"\n', rows)).recording
    assert isinstance(run.reference, Turns)
    np.testing.assert_allclose(np.degrees(run.reference.turn_rad[0]), [0, 0, -90])


def test_the_wrong_unit_of_a_gyro_does_not_pass_for_a_scale_error(tmp_path: Path) -> None:
    mapping = TURN_MAPPING.replace('unit = "deg/s"', 'unit = "rad/s"')
    with pytest.raises(RecordingError, match=r"Check axis, sign, angle and \[gyro\] unit"):
        imported(*written(tmp_path, mapping, turn_rows(np.arange(300) / 100)))


def test_a_dead_channel_does_not_spoil_its_neighbours(tmp_path: Path) -> None:
    files = [written(tmp_path, TURN_MAPPING, turn_rows(np.arange(300) / 100, 91), f"run{i}.csv") for i in range(5)]
    _, calibration = calibrated(tmp_path, files[0][0], *(rows for _, rows in files))  # y is 0 throughout
    z = calibration.gyros[2]
    assert z.states[0] * np.radians(30) + z.states[1] == pytest.approx(np.radians(-1 / 3), rel=0.02)


def test_a_turn_about_an_axis_that_no_gyro_senses_is_taken_as_stated(tmp_path: Path) -> None:
    mapping = TURN_MAPPING.replace('["gx", "gy", "gz"]', '["gx"]').replace('"deg/s"', '"deg/s"\naxes = ["x"]')
    rows = turn_rows(np.arange(300) / 100)
    run = imported(*written(tmp_path, mapping, rows)).recording
    assert isinstance(run.reference, Turns)
    np.testing.assert_allclose(np.degrees(run.reference.turn_rad[0]), [0, 0, 90])
    with pytest.raises(RecordingError, match="its sign cannot be found from the data"):
        imported(*written(tmp_path, mapping + 'sign = "from data"\n', rows))


def test_stamps_out_of_order_within_their_scatter_keep_the_order_of_the_rows(tmp_path: Path) -> None:
    stamps = np.arange(300) / 100 + np.where(np.arange(300) % 50 == 7, 0.013, 0.0)
    assert (np.diff(stamps) < 0).any()
    run = imported(*written(tmp_path, TURN_MAPPING, turn_rows(stamps))).recording
    np.testing.assert_allclose(run.sources[SOURCE].t_ns, np.arange(300) * 10_000_000, atol=1000)


def test_uneven_sampling_keeps_its_stamps_and_the_turned_angle(tmp_path: Path) -> None:
    stamps = np.concatenate([np.arange(100) / 100, 1 + np.arange(100) / 50, 3 + np.arange(100) / 100])
    run = imported(*written(tmp_path, TURN_MAPPING, turn_rows(stamps, 45))).recording
    data = run.sources[SOURCE]
    assert "as stamped" in run.attributes["time_fit"]
    turned = np.trapezoid(data.rate_rps[:, 2], data.t_ns * 1e-9)
    assert np.degrees(turned) == pytest.approx(90, rel=0.01)


def test_two_runs_in_one_file_are_refused(tmp_path: Path) -> None:
    stamps = np.concatenate([np.arange(300) / 100, np.arange(300) / 100])
    with pytest.raises(RecordingError, match=r"jumps back by 2.99 s at data row 301.*split it"):
        imported(*written(tmp_path, TURN_MAPPING, turn_rows(stamps)))


def test_a_section_list_must_fit_the_mapping_and_the_file(tmp_path: Path) -> None:
    mapping = TURN_MAPPING.replace('axis = "z"\nangle_deg = 90\n', 'section_list = "{stem}.json"\n')
    mapping += '[reference.sections]\nturn = { axis = "z", angle_deg = 90 }\n'
    files = written(tmp_path, mapping, turn_rows(np.arange(300) / 100))
    with pytest.raises(RecordingError, match=r"its section list log.json is not in the same folder"):
        imported(*files)
    (tmp_path / "log.json").write_text('{"turn": {"start": 50, "end": 900}}')
    with pytest.raises(RecordingError, match=r"section turn is 50 to 900, the file has rows 0 to 300"):
        imported(*files)
    (tmp_path / "log.json").write_text('{"spin": {"start": 50, "end": 250}}')
    with pytest.raises(RecordingError, match=r"the turn of section spin is not stated"):
        imported(*files)
    (tmp_path / "log.json").write_text('{"turn": {"start": 50, "end": 250}}')
    run = imported(*files).recording
    assert isinstance(run.reference, Turns)
    assert run.reference.t_start_ns[0] == pytest.approx(0.5e9, abs=1000)
    with pytest.raises(RecordingError, match="need at least four turns or rests"):
        calibrate(run)


def test_a_file_that_is_no_mat_file_or_lacks_a_variable_is_refused(tmp_path: Path) -> None:
    from scipy.io import savemat

    mapping = DATA / "broad/mapping.toml"
    text = tmp_path / "text.mat"
    text.write_text("this is not MATLAB " * 20)
    with pytest.raises(RecordingError, match=r"text.mat: is no MATLAB file"):
        imported(mapping, text)
    savemat(tmp_path / "other.mat", {"gyr": np.zeros((10, 3)), "sampling_rate": 100.0})
    with pytest.raises(RecordingError, match=r"other.mat: has no column imu_gyr, imu_acc, opt_quat: it has gyr"):
        imported(mapping, tmp_path / "other.mat")
    with pytest.raises(RecordingError, match=r"absent.mat: cannot be read"):
        imported(mapping, tmp_path / "absent.mat")
