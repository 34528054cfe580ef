"""Formats and layouts of foreign files: two files joined by time, binary records, calendar stamps, units, messages."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import CSV, GYRO, MAPPING, RATE, SHAPES, STAMPED

from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.importing.importing import SOURCE, Imported, import_recording
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.reference import AttitudeReadings, RateReadings, TableReadings

K, BIAS_DPS = 0.01, 0.5


def rates(t: np.ndarray) -> np.ndarray:
    return np.column_stack([30 * np.sin(t), 20 * np.cos(1.3 * t), 25 * np.sin(0.7 * t)])


def gyro(t: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(5).normal(scale=0.02, size=(len(t), 3))
    return np.asarray((1 - K) * rates(t) - BIAS_DPS + noise)


def table(path: Path, heading: str, rows: np.ndarray, spec: str = "%.9g") -> Path:
    np.savetxt(path, rows, fmt=spec, delimiter=",", header=heading, comments="")
    return path


def imported(tmp_path: Path, mapping: str, *files: Path) -> Imported:
    (tmp_path / "mapping.toml").write_text(mapping)
    return import_recording(read_mapping(tmp_path / "mapping.toml"), files)


def assert_calibrates(run: Imported) -> None:
    """The states that the gyros of this file were made with are found again."""
    for found in calibrate(run.recording).gyros:
        assert found.states[0] == pytest.approx(K, abs=max(5 * found.sd[0], 2e-4))
        assert np.degrees(found.states[1]) == pytest.approx(BIAS_DPS, abs=max(5 * np.degrees(found.sd[1]), 2e-3))


# --- a reference in a file of its own


def beside(tmp_path: Path, *, late_s: float = 0.0, until_s: float = 35.0) -> tuple[Path, Path]:
    """A triad at 100 Hz with stamps in s, and its reference at 37 Hz in a file with stamps in us and semicolons."""
    t, other = 50 + np.arange(3000) / 100, np.arange(48, 50 + until_s, 1 / 37)
    log = table(tmp_path / "run1.csv", "t,gx,gy,gz", np.column_stack([t, gyro(t)]))
    rows = np.column_stack([np.round((other - late_s) * 1e6), rates(other)])
    heading = "micros;rx;ry;rz"
    np.savetxt(tmp_path / "run1_table.txt", rows, fmt="%.6f", delimiter=";", header=heading, comments="")
    return log, tmp_path / "run1_table.txt"


BESIDE = (SHAPES / "two_files.toml").read_text()


def test_samples_and_reference_in_two_files_are_joined_by_their_stamps(tmp_path: Path) -> None:
    log, _ = beside(tmp_path)
    run = imported(tmp_path, BESIDE, log)
    assert isinstance(run.recording.reference, RateReadings)
    t_s = run.recording.reference.t_ns * 1e-9
    assert np.median(np.diff(t_s)) == pytest.approx(1 / 37, rel=1e-6)
    assert t_s[0] == pytest.approx(-1, abs=1 / 37)  # a second to each side is kept, the rest belongs to nothing
    assert t_s[-1] == pytest.approx(30.99, abs=1 / 37)
    np.testing.assert_allclose(np.degrees(run.recording.reference.rate_rps), rates(t_s + 50), atol=1e-4)
    assert_calibrates(run)


def test_a_clock_that_is_off_by_a_known_time_is_put_right_by_an_offset(tmp_path: Path) -> None:
    log, _ = beside(tmp_path, late_s=1000)
    with pytest.raises(RecordingError, match=r"run1_table.txt lasts from -1002 to .*state offset_s, which is added"):
        imported(tmp_path, BESIDE, log)
    assert_calibrates(imported(tmp_path, BESIDE.replace("offset_s = 0", "offset_s = 1000"), log))


def test_a_reference_that_ends_early_is_told(tmp_path: Path) -> None:
    log, _ = beside(tmp_path, until_s=20)
    run = imported(tmp_path, BESIDE, log)
    assert any("run1_table.txt does not cover 10 of 29.99 s" in note for note in run.notes)
    assert_calibrates(run)


def test_a_reference_that_is_named_as_data_is_no_data(tmp_path: Path) -> None:
    log, reference = beside(tmp_path)
    run = imported(tmp_path, BESIDE, log, reference)
    assert run.refused == ()
    assert run.lost_files == 0


def test_a_reference_may_have_stamps_of_its_own_in_the_same_file(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    later = t + 0.037
    rows = np.column_stack([t, gyro(t), later * 1e3, rates(later)])
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,ms,rx,ry,rz", rows)
    mapping = MAPPING + 'file = "{stem}.csv"\n[reference.time]\ncolumn = "ms"\nunit = "ms"\n'
    assert_calibrates(imported(tmp_path, mapping, log))


def test_files_without_stamps_begin_together(tmp_path: Path) -> None:
    t, other = np.arange(3000) / 100, np.arange(1200) / 40
    log = table(tmp_path / "a.csv", "gx,gy,gz", gyro(t))
    table(tmp_path / "a_encoder.csv", "rx,ry,rz", rates(other + 0.25))
    mapping = CSV + "[time]\nrate_hz = 100\n" + GYRO + RATE + 'file = "{stem}_encoder.csv"\n'
    run = imported(tmp_path, mapping + "[reference.time]\nrate_hz = 40\noffset_s = 0.25\n", log)
    assert_calibrates(run)


def test_an_angle_and_an_attitude_may_be_in_files_of_their_own(tmp_path: Path) -> None:
    t = np.arange(2000) / 100
    log = table(tmp_path / "a.csv", "t,gz", np.column_stack([t, gyro(t)[:, 0]]))
    slow = np.arange(1000) / 50
    angle = 30 * (1 - np.cos(slow)) + 90
    table(tmp_path / "a_enc.csv", "t,angle", np.column_stack([slow, angle / 360]))
    half = np.radians(angle) / 2
    zero = np.zeros_like(half)
    table(tmp_path / "a_att.csv", "t,w,x,y,z", np.column_stack([slow, np.cos(half), zero, zero, np.sin(half)]))
    one = STAMPED + '[gyro]\ncolumns = ["gz"]\naxes = ["z"]\nunit = "deg/s"\n[reference]\n'
    run = imported(
        tmp_path, one + 'kind = "angle"\ncolumn = "angle"\nunit = "rev"\naxis = "z"\nfile = "{stem}_enc.csv"', log
    )
    assert isinstance(run.recording.reference, TableReadings)
    np.testing.assert_allclose(run.recording.reference.angle_rad[:, 0], np.radians(angle), atol=1e-6)
    columns = 'kind = "attitude"\ncolumns = ["w", "x", "y", "z"]\norder = "wxyz"\nfile = "{stem}_att.csv"'
    run = imported(tmp_path, one + columns, log)
    assert isinstance(run.recording.reference, AttitudeReadings)
    assert len(run.recording.reference.t_ns) == 1000


def test_a_reference_file_that_is_not_there_costs_its_data_file_only(tmp_path: Path) -> None:
    log, _ = beside(tmp_path)
    alone = tmp_path / "run2.csv"
    alone.write_bytes(log.read_bytes())
    run = imported(tmp_path, BESIDE, alone, log)
    assert [(r.name, r.reason) for r in run.refused] == [
        ("run2.csv", "run2_table.txt cannot be read: No such file or directory")
    ]
    assert_calibrates(run)


# --- binary records

BINARY = (SHAPES / "binary_records.toml").read_text()


def binary_log(path: Path, cut: int = 0) -> tuple[Path, np.ndarray]:
    t = np.arange(2000) / 100
    types = [("t", ">f8"), ("gyro", ">f8", 3), ("status", ">u2"), ("reference", ">f4", 3), ("pad", "V2")]
    rows = np.zeros(len(t), dtype=types)
    rows["t"], rows["gyro"], rows["reference"] = t, gyro(t), rates(t)
    raw = b"LOG 2.1 headers." + rows.tobytes()
    path.write_bytes(raw[: len(raw) - cut])
    return path, rows["gyro"].astype(np.float64)


def test_binary_records_of_any_types_are_read(tmp_path: Path) -> None:
    log, expected = binary_log(tmp_path / "log.bin")
    run = imported(tmp_path, BINARY, log)
    np.testing.assert_allclose(np.degrees(run.recording.sources[SOURCE].rate_rps), expected, rtol=1e-12)
    assert run.notes == ()
    assert_calibrates(run)


def test_a_binary_file_that_is_cut_loses_its_last_record(tmp_path: Path) -> None:
    log, expected = binary_log(tmp_path / "log.bin", cut=5)
    run = imported(tmp_path, BINARY, log)
    assert run.notes == ("it ends within a record; the last 43 bytes were skipped",)
    assert len(run.recording.sources[SOURCE].t_ns) == len(expected) - 1


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("t f8", "t f8 s", r"line \d+: file.record: holds 't f8 s': write a name and a type, \"t f8\""),
        ("t f8", "status f8", r"file.record: holds 'status u2'"),
        (
            'columns = "gyro"',
            'columns = "pad"',
            r"has no column pad: record in \[file\] has t, gyro, status, reference;",
        ),
        ("header_bytes = 16", "header_bytes = -1", r"line 8: file.header_bytes: -1: write a number of 0 or more"),
        ("t f8", "time f8", r"log.bin: has no column t: record in \[file\] has time, gyro"),
        ('byte_order = "big"', "", r"no plausible numbers. Check record, header_bytes and byte_order"),
        ("header_bytes = 16", "header_bytes = 900000", r"less than header_bytes plus one record of 48. Check"),
    ],
)
def test_a_record_that_does_not_fit_says_what_to_write(tmp_path: Path, old: str, new: str, message: str) -> None:
    log, _ = binary_log(tmp_path / "log.bin")
    with pytest.raises(RecordingError, match=message):
        imported(tmp_path, BINARY.replace(old, new, 1), log)


# --- times


@pytest.mark.parametrize("style", ["2026-03-29T00:59:50.000+00:00", "2026-03-29 00:59:50.000", "2026-03-29T02:59:50Z"])
def test_stamps_of_the_calendar_are_times(tmp_path: Path, style: str) -> None:
    """Without a zone a time is UTC, so no hour is missing or doubled where summer time begins or ends."""
    start = datetime.fromisoformat(style)
    t = np.arange(3000) / 100
    stamps = [(start + timedelta(seconds=float(s))).isoformat(style[10], "milliseconds") for s in t]
    rows = np.hstack([gyro(t), rates(t)])
    lines = [f"{stamp}," + ",".join(f"{v:.6f}" for v in row) for stamp, row in zip(stamps, rows, strict=True)]
    log = tmp_path / "log.csv"
    log.write_text("when,gx,gy,gz,rx,ry,rz\n" + "\n".join(lines) + "\n")
    mapping = CSV + '[time]\ncolumn = "when"\nunit = "iso"\n' + GYRO + RATE
    run = imported(tmp_path, mapping, log)
    t_s = run.recording.sources[SOURCE].t_ns * 1e-9
    np.testing.assert_allclose(t_s, t, atol=1e-6)
    assert_calibrates(run)


def test_a_converter_with_a_tachometer_is_read_from_its_counts(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    start = datetime(2026, 3, 29, 0, 59, 50)
    counts = np.round(gyro(t)[:, 0] / 0.01) + 32768
    counts[:100] = 0
    rows = [
        f"{(start + timedelta(seconds=float(s))).isoformat()},{count:.0f},-340,{rate / 6:.9f}"
        for s, count, rate in zip(t, counts, rates(t)[:, 0], strict=True)
    ]
    (tmp_path / "log.csv").write_text("when,adc,raw_t,tacho\n" + "\n".join(rows))
    run = imported(tmp_path, (SHAPES / "adc_counts.toml").read_text(), tmp_path / "log.csv")
    data = run.recording.sources[SOURCE]
    assert len(data.t_ns) == 2900
    assert data.temperature_c is not None
    np.testing.assert_allclose(data.temperature_c, 35.53, atol=1e-3)
    assert_calibrates(run)


def test_stamps_of_the_calendar_join_files_of_different_zones(tmp_path: Path) -> None:
    t = np.arange(2000) / 100
    zero = datetime(2026, 11, 2, 12, tzinfo=UTC)
    for name, columns, values, hours in (("a", "gx,gy,gz", gyro(t), 0), ("a_ref", "rx,ry,rz", rates(t), 1)):
        stamps = [(zero + timedelta(seconds=float(s), hours=hours)).replace(tzinfo=None).isoformat() for s in t]
        zone = "" if hours == 0 else "+01:00"
        rows = [
            f"{stamp}{zone}," + ",".join(f"{v:.6f}" for v in row) for stamp, row in zip(stamps, values, strict=True)
        ]
        (tmp_path / f"{name}.csv").write_text(f"t,{columns}\n" + "\n".join(rows) + "\n")
    mapping = STAMPED.replace('"s"', '"iso"') + GYRO + RATE + 'file = "{stem}_ref.csv"'
    assert_calibrates(imported(tmp_path, mapping, tmp_path / "a.csv"))


@pytest.mark.parametrize(
    ("stamp", "unit", "message"),
    [
        ("2026-03-29T00:59:50.", "s", r'write unit = "iso" in \[time\]'),
        ("00:59:50.", "iso", r'write unit = "pattern", pattern = "%H:%M:%S.%f" in \[time\]'),
        ("0:0:0:59:50.", "iso", r"check delimiter and decimal in \[file\], unit in \[time\]"),
    ],
)
def test_stamps_that_are_no_numbers_or_no_dates_say_what_to_write(
    tmp_path: Path, stamp: str, unit: str, message: str
) -> None:
    lines = [f"{stamp}{i:03},{i % 7},0,0,0,0,0" for i in range(500)]
    (tmp_path / "log.csv").write_text("t,gx,gy,gz,rx,ry,rz\n" + "\n".join(lines))
    with pytest.raises(RecordingError, match=message):
        imported(tmp_path, STAMPED.replace('unit = "s"', f'unit = "{unit}"') + GYRO + RATE, tmp_path / "log.csv")


def test_a_counter_that_goes_round_is_a_time(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    count = (np.arange(3000) + 65000) % 65536
    log = table(tmp_path / "log.csv", "n,gx,gy,gz,rx,ry,rz", np.column_stack([count, gyro(t), rates(t)]))
    time = '[time]\ncolumn = "n"\nunit = "raw"\ncount = 10\ncount_unit = "ms"\n'
    with pytest.raises(RecordingError, match=r"if a counter wraps, state wraps_at in \[time\]"):
        imported(tmp_path, CSV + time + GYRO + RATE, log)
    assert_calibrates(imported(tmp_path, CSV + time + "wraps_at = 65536\n" + GYRO + RATE, log))


# --- what spoils samples


def test_gyros_that_do_not_follow_the_reference_are_told(tmp_path: Path) -> None:
    t = np.arange(3000) / 100
    noise = np.random.default_rng(8).normal(scale=30, size=(3000, 3))
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", np.column_stack([t, noise, rates(t)]))
    notes = imported(tmp_path, MAPPING, log).notes
    assert sum("the output hardly follows the reference" in note for note in notes) == 3


@pytest.mark.parametrize("count", range(2990, 3000))
def test_held_samples_end_with_the_file(tmp_path: Path, count: int) -> None:
    t = np.arange(count) / 100
    held = gyro(t)[(np.floor(np.arange(count) / 3.6) * 3.6).astype(int)]
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", np.column_stack([t, held, rates(t)]))
    run = imported(tmp_path, MAPPING, log)
    assert len(run.recording.sources[SOURCE].t_ns) == pytest.approx(count / 3.6, abs=2)
    assert any("the gyro is new in one row of 3.6" in note for note in run.notes)


def test_a_part_of_a_file_without_a_number_is_refused(tmp_path: Path) -> None:
    t = np.arange(2000) / 100
    rows = np.column_stack([t, gyro(t), rates(t)])
    rows[:500, 1:4] = np.inf
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", rows)
    with pytest.raises(RecordingError, match="has a gyro column without any number"):
        imported(tmp_path, MAPPING.replace('"csv"', '"csv"\nuntil_s = 4'), log)


def test_a_number_beyond_measure_is_a_blank(tmp_path: Path) -> None:
    t = np.arange(2000) / 100
    rows = np.column_stack([t, gyro(t), rates(t)])
    rows[500, 1:4], rows[700, 5] = 1e300, -np.inf
    run = imported(tmp_path, MAPPING, table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", rows))
    assert len(run.recording.sources[SOURCE].t_ns) == 1999
    assert_calibrates(run)


def test_a_clock_that_wanders_and_lost_samples_leave_the_samples_even(tmp_path: Path) -> None:
    t = np.arange(30000) / 99.89
    wander = 0.02 * np.sin(t / 40)
    kept = np.delete(np.arange(30000), [9000, 15000, 15001, 21000])
    stamps = np.round((t + wander)[kept], 3)  # to 1 ms: two rates of 190 deg/s would be 10 % apart from row to row
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", np.column_stack([stamps, gyro(t)[kept], rates(t)[kept]]))
    run = imported(tmp_path, MAPPING, log)
    assert "even over seconds at 99.9" in str(run.recording.attributes["time_fit"])
    t_s = run.recording.sources[SOURCE].t_ns * 1e-9
    true = (t + wander)[kept]
    assert np.std(t_s - true) < 1e-4
    assert np.abs(np.diff(t_s) - np.diff(true)).max() < 1e-4


# --- headings, units, messages


@pytest.mark.parametrize("heading", ["# t, gx, gy, gz, rx, ry, rz", "%t,gx,gy,gz,rx,ry,rz", "## t,gx,gy,gz,rx,ry,rz"])
@pytest.mark.parametrize("name", ["t", "#t"])
def test_a_heading_behind_a_comment_sign_is_a_heading(tmp_path: Path, heading: str, name: str) -> None:
    t = np.arange(2000) / 100
    log = table(tmp_path / "log.csv", "# made by logger\n" + heading, np.column_stack([t, gyro(t), rates(t)]))
    assert_calibrates(imported(tmp_path, STAMPED.replace('"t"', f'"{name}"') + GYRO + RATE, log))


@pytest.mark.parametrize(
    ("unit", "in_a_dps"),
    [("rpm", 1 / 6), ("rev/s", 1 / 360), ("deg/h", 3600.0), ("mdps", 1000.0), ("mrad/s", np.pi / 0.18)],
)
def test_rates_come_in_the_units_of_their_trade(tmp_path: Path, unit: str, in_a_dps: float) -> None:
    t = np.arange(2000) / 100
    rows = np.column_stack([t, gyro(t), rates(t) * in_a_dps])
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", rows, "%.12g")
    assert_calibrates(imported(tmp_path, STAMPED + GYRO + RATE.replace("deg/s", unit), log))


@pytest.mark.parametrize(
    ("rows", "change", "message"),
    [
        (("t;gx;gy;gz;rx;ry;rz", ";"), ("", ""), r'it has them with delimiter = ";" in \[file\]'),
        (("gx,gy,gz,rx,ry,rz", ","), ("", ""), r"has no column t.*if it has no time, state rate_hz in \[time\]"),
        (("1,2,3,4,5,6,7", ","), ("", ""), r"name its columns with columns = \[...\] in \[file\]"),
        (("t,gx,gy,gz,rx,ry,rz", ","), ('[time]\ncolumn = "t"\nunit = "s"\n', ""), r"no table \[time\].*or rate_hz"),
        (
            ("t,gx,gy,gz,rx,ry,rz", ","),
            ('column = "t"\n', ""),
            r"time: give one of rate_hz .*, rate_variable .* or column",
        ),
        (("t,gx,gy,gz,rx,ry,rz", ","), ('"t"', '"gy"'), r"check column in \[time\]"),
    ],
)
def test_a_message_names_the_key_that_helps(
    tmp_path: Path, rows: tuple[str, str], change: tuple[str, str], message: str
) -> None:
    t = np.arange(500) / 100
    heading, delimiter = rows
    values = np.column_stack([t, gyro(t), rates(t)])[:, -len(heading.split(delimiter)) :]
    np.savetxt(tmp_path / "log.csv", values, delimiter=delimiter, header=heading, comments="")
    with pytest.raises(RecordingError, match=message):
        imported(tmp_path, MAPPING.replace(*change, 1), tmp_path / "log.csv")


def test_decimal_commas_are_recognised(tmp_path: Path) -> None:
    t = np.arange(500) / 100
    rows = np.column_stack([t, gyro(t), rates(t)])
    lines = [";".join(f"{v:.4f}".replace(".", ",") for v in row) for row in rows]
    (tmp_path / "log.csv").write_text("t;gx;gy;gz;rx;ry;rz\n" + "\n".join(lines))
    mapping = MAPPING.replace('"csv"\n', '"csv"\ndelimiter = ";"\n')
    with pytest.raises(RecordingError, match=r'decimal mark \'.\', .*: write decimal = "," in \[file\]'):
        imported(tmp_path, mapping, tmp_path / "log.csv")


def test_stamps_that_stand_still_ask_for_a_rate(tmp_path: Path) -> None:
    rows = np.column_stack([np.zeros(500), gyro(np.arange(500) / 100), rates(np.arange(500) / 100)])
    log = table(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", rows)
    with pytest.raises(RecordingError, match=r"do not advance: check column in \[time\], or state rate_hz"):
        imported(tmp_path, MAPPING, log)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('file = "{stem}_r.csv"\nkind = "rest"', "reference.file: is for kind = rate, angle or attitude"),
        ('kind = "rest"\n[reference.time]\nrate_hz = 5', "reference.time: unknown key|reference.time: has no place"),
        (RATE[12:] + '[reference.file]\nformat = "csv"', r"reference.file: name is missing"),
    ],
)
def test_a_reference_file_that_has_no_place_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mapping.toml").write_text(STAMPED + GYRO + "[reference]\n" + text)
    with pytest.raises(RecordingError, match=message):
        read_mapping(tmp_path / "mapping.toml")
