"""IMUs that a file describes, on a bench: what is said of a wrong file, what init asks, a run with two of them."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from support import forked

from station.bench.bench import load_bench
from station.bench.descriptions import DESCRIPTIONS, DescriptionError, load_description
from station.cli import main
from station.errors import BenchError

HI91 = (DESCRIPTIONS / "hipnuc_hi91.toml").read_text()
CSV = (DESCRIPTIONS / "csv.toml").read_text()
BENCH = (Path(__file__).parents[1] / "data" / "benches" / "described.toml").read_text()
SCRIPT = '[[step]]\nkind = "rest"\nduration = "4 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "5 s"\n'
    for axis in "xyz"
)


def test_a_bench_of_two_described_imus_runs_and_passes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "sketch.toml").write_text(CSV)
    (tmp_path / "bench.toml").write_text(BENCH.replace('description = "csv"', 'description = "sketch.toml"'))
    (tmp_path / "script.toml").write_text(SCRIPT)
    arguments = ["--bench", "bench.toml", "--script", "script.toml", "-o", "run.h5"]
    code = main(["run", "--json", *(str(tmp_path / a) if "." in a else a for a in arguments)])
    result = json.loads(capsys.readouterr().out)
    assert (code, result["outcome"]) == (0, "PASS")
    assert [gyro["k"] * 1e6 for gyro in result["gyros"][:2]] == pytest.approx([-2000, 3000], abs=500)
    assert result["lost"] == 0


@pytest.mark.parametrize(
    ("text", "old", "new", "told"),
    [
        (CSV, 'rate = ["gx"', 'rate = ["wx"', r"line 3: rate: there is no 'wx', only gx, gy, gz"),
        (CSV, 'rate = "deg/s"\n', "", r"line 4: units: rate is missing: give one of deg/s, rad/s"),
        (CSV, '"deg/s"', '"deg"', r"line 5: units.rate: 'deg': give one of deg/s"),
        (CSV, "columns", "colums", r"line 6: line: columns is missing"),
        (CSV, "[line]", "[lines]", r"needs either a table \[frame\] or a table \[line\]"),
        (CSV, "[units]", 'time = "gy"\n[units]', r"line 5: units: time is missing: give one of s, ms, us, ns"),
        (
            CSV,
            "[units]",
            'counter = "gz"\ntime = "gy"\n[units]\ntime = "s"',
            r"line 5: time: give either a counter or a time",
        ),
        (CSV, 'columns = ["gx", ', 'columns = ["gx", "gx", ', r"line 7: line.columns: a name occurs twice"),
        (HI91, '"5A A5', '"5A A', r"line \d+: frame.sync: .* write bytes in hex"),
        (HI91, "XMODEM", "XMODEN", r"line \d+: frame.check.name: give one of .*CRC-16/XMODEM"),
        (
            HI91,
            'at = 38, type = "f32"',
            'at = 80, type = "f32"',
            r"line \d+: frame.fields.gyr_z.at: 80: .* 4 bytes fit",
        ),
        (HI91, 'at = 38, type = "f32"', 'at = 36, type = "f32"', r"line \d+: frame: .*overlapping"),
        (HI91, 'at = 38, type = "f32"', 'at = 38, type = "f16"', r"frame.fields.gyr_z.type: 'f16' is not one of u8"),
        (HI91, "check = {", "chek = {", r"line \d+: frame.chek: unknown key; did you mean check\?"),
        (HI91, "check = {", "check = { bits = 16, polynomial = 0x1021, at = 4 }  # {", None),
        (
            HI91,
            "bytes = 82",
            'bytes = 82\nend = "?? 0D"',
            r"line \d+: frame.end: .*: \?\? for any byte can only be in",
        ),
        (HI91, "bytes = 82", "bytes = 5", r"line \d+: frame.(bytes|check.at|fields.*): 5|give a place where"),
        (
            HI91,
            'name = "CRC-16/XMODEM"',
            "bits = 8, polynomial = 0x107",
            r"frame.check.polynomial: 0x107: give 8 bits",
        ),
        (CSV, "[line]", '[line]\nseparator = ""', r"line 7: line.separator: give the separator between"),
        (HI91, 'time = "system_time"', 'time = "pressure"', r"line \d+: time: pressure is not an integer"),
        (
            HI91,
            '{ text = "LOG ENABLE\\r\\n" }',
            '{ text = "LOG", hex = "00" }',
            r"start.1: needs either text or hex",
        ),
    ],
)
def test_a_wrong_description_is_told_with_file_line_and_key(
    text: str, old: str, new: str, told: str | None, tmp_path: Path
) -> None:
    assert old in text
    path = tmp_path / "imu.toml"
    path.write_text(text.replace(old, new, 1))
    if told is None:
        load_description(str(path))
        return
    with pytest.raises(DescriptionError, match=f"imu.toml.*({told})"):
        load_description(str(path))


def test_the_guide_shows_what_ships() -> None:
    guide = (Path(__file__).parents[2] / "docs" / "pages" / "guide" / "describe-an-imu.md").read_text()
    shipped = CSV.partition("\n")[2]
    assert len(shipped.splitlines()) == 6
    assert shipped in guide


def test_a_frame_that_nothing_tells_from_garbage_is_refused(tmp_path: Path) -> None:
    text = 'rate = "g"\nunits.rate = "deg/s"\n[frame]\nsync = "AA ??"\nbytes = 4\nfields.g = { at = 2, type = "i16" }\n'
    (tmp_path / "imu.toml").write_text(text)
    with pytest.raises(DescriptionError, match=r"line 4: frame.sync: .* give at least 2 bytes in"):
        load_description("imu.toml", tmp_path)


def test_a_bench_names_what_is_wrong_with_its_description(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_text(BENCH.replace('description = "csv"', 'description = "none"'))
    with pytest.raises(BenchError, match=r"line \d+: imu.0.description: no description none: give one of csv"):
        load_bench(path)
    path.write_text(BENCH.replace('array = "triad"', 'array = "tetrahedron"', 1))
    with pytest.raises(BenchError, match=r"line \d+: imu.0.array: the description has 3 gyros, but this array has 4"):
        load_bench(path)


def test_init_asks_for_the_description(tmp_path: Path) -> None:
    (tmp_path / "four.toml").write_text(CSV.replace('"gz"]', '"gz", "gu"]'))
    table = ["", "modbus", *[""] * 18]
    answers = [*table, "described", "nothing", "four.toml", "tetrahedron", *[""] * 5, "no", *[""] * 12]
    done = subprocess.run(
        forked("init", "bench.toml"),
        input="\n".join(answers),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "no description nothing: give one of csv, hipnuc_hi91, or the path of a .toml" in done.stdout
    (imu,) = load_bench(tmp_path / "bench.toml").imus
    assert (imu.protocol, len(imu.array)) == ("described", 4)
