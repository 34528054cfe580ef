"""The main job through the real client and server, python-can and the codecs, in virtual time."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from contextlib import redirect_stdout
from io import StringIO
from itertools import takewhile
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from printed import blocks_of, not_printed
from support import TABLE_1, changed, command, ctrl_c_of_children

from station.bench.bench import default_bench_text
from station.bench.descriptions import DESCRIPTIONS
from station.cli import main

ROOT = Path(__file__).parents[2]
KEYS = ("k", "b_rps", "sigma_j_rad", "sigma_k_rad")

SHORT_SCRIPT = """
name = "short"
[[step]]
kind = "rest"
duration = "4 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "40 deg/s"
acceleration = "20 deg/s2"
duration = "11 s"
[[step]]
kind = "rotate"
axis = "y"
rate = "-40 deg/s"
acceleration = "20 deg/s2"
duration = "11 s"
[[step]]
kind = "rotate"
axis = "z"
rate = "40 deg/s"
acceleration = "20 deg/s2"
duration = "11 s"
[[step]]
kind = "move"
axis = "x"
angle = "30 deg"
rate = "20 deg/s"
[[step]]
kind = "rest"
duration = "4 s"
"""

BRIEF_SCRIPT = '[[step]]\nkind = "rest"\nduration = "4 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "5 s"\n'
    for axis in "xyz"
)
"""As much as an estimate of all states needs: every second of a table costs a twentieth of one of these tests."""


@pytest.fixture
def brief(tmp_path: Path) -> Path:
    path = tmp_path / "brief.toml"
    path.write_text(BRIEF_SCRIPT)
    return path


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SHORT_SCRIPT)
    return path


def bench_file(folder: Path, *changes: tuple[str, str], end: str = "") -> Path:
    """Return the default bench with some of its lines changed; limits on sigmas suit a short script."""
    relaxed = [(f"sd_{name} = ", f"# sd_{name} = ") for name in ("scale_factor_error", "bias", "misalignment")]
    path = folder / "bench.toml"
    path.write_text(changed(default_bench_text(), *relaxed, *changes) + end)
    return path


@pytest.fixture(scope="module")
def brief_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """A folder with a bench, a brief script and run.h5, which is to be read only; what the run printed."""
    folder = tmp_path_factory.mktemp("brief")
    (folder / "brief.toml").write_text(BRIEF_SCRIPT)
    files = ["--bench", bench_file(folder), "--script", folder / "brief.toml", "-o", folder / "run.h5"]
    with redirect_stdout(StringIO()) as printed:
        assert main(["run", "--json", "--seed", "5", *map(str, files)]) == 0
    return folder, json.loads(printed.getvalue())


def run_json(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, dict[str, Any]]:
    code = main(["run", "--json", *map(str, arguments)])
    return code, json.loads(capsys.readouterr().out)


def events(path: Path) -> list[str]:
    with h5py.File(path) as file:
        return [text.decode() for text in file["events/text"][()]]


def assert_pages_show(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """See that README and the first hour show verdict, states and noise as they are printed of this run."""
    assert main(["export", str(recording), "--format", "json", "-o", str(recording.with_suffix(".json"))]) == 0
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    for page in ("README.md", "docs/pages/guide/first-hour.md"):
        (block,) = [block for block in blocks_of(ROOT / page) if block[0].startswith("PASS")]
        shown = list(takewhile(lambda line: not line.startswith("next: "), block))
        assert len(shown) > 10
        assert not not_printed(shown, printed), page


def test_the_paper_script_passes_on_the_built_in_twins_and_finds_the_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"COLUMNS": "80", "FORCE_COLOR": "1", "NO_COLOR": "1"}.items():
        monkeypatch.setenv(name, value)
    code, result = run_json(capsys, "-o", tmp_path / "run.h5")
    assert code == 0
    assert_pages_show(tmp_path / "run.h5", capsys)
    assert result["outcome"] == "PASS"
    assert result["reason"].endswith("within limits; constancy not proved: x, y, z")
    assert [(axis["axis"], axis["proved"]) for axis in result["constancy"]] == [
        ("x", False),
        ("y", False),
        ("z", False),
    ]
    assert result["constancy"][1]["covered_s"] == pytest.approx([163, 199], abs=2)
    assert result["constancy"][1]["concerns"] == ["k", "sigma_j", "sigma_k", "gearing"]
    assert [gyro["name"] for gyro in result["gyros"]] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    errors = [(g[key] - t) / g["sd"][key] for g in result["gyros"] for key, t in zip(KEYS, TABLE_1, strict=True)]
    assert np.abs(errors).max() < 4
    assert 0.95 < result["nis_mean"] < 1.05
    assert result["lost"] == 0
    with h5py.File(tmp_path / "run.h5") as file:
        assert file["calibration"].attrs["live_batch_difference_sigma"] < 1e-6
        (note,) = file["calibration"].attrs["notes"]
        assert note.startswith("constancy not proved for x, y and z")
        assert json.loads(file["calibration"].attrs["constancy"]) == result["constancy"]
        for said, kept in (
            (result["links"]["table"], {key.removeprefix("table_"): n for key, n in file.attrs.items()}),
            (result["links"]["array"], file["imu/gyro1"].attrs),
        ):
            assert said == {key: kept[f"link_{key}"] for key in said}
            assert said["received"] > 30_000
            assert said["timeouts"] == said["error_frames"] == 0
        last = file["table/angle_rad"][-1]
        assert np.abs(last - 8 * np.pi).max() < 2 * np.pi / 65536  # four turns each, home to the count


def test_the_same_bench_and_seed_give_the_same_bytes_and_another_seed_others(
    tmp_path: Path, brief_run: tuple[Path, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = brief_run

    def run(seed: int) -> Path:
        path = tmp_path / f"{seed}.h5"
        files = ["--bench", folder / "bench.toml", "--script", folder / "brief.toml", "-o", path]
        main(["run", "--seed", str(seed), *map(str, files)])
        return path

    def contents(path: Path) -> dict[str, bytes]:
        found: dict[str, bytes] = {}
        with h5py.File(path) as file:
            file.visititems(lambda key, item: found.update({key: item[()].tobytes()} if hasattr(item, "shape") else {}))
        return found

    again, other = run(5), run(6)
    assert contents(again) == contents(folder / "run.h5")
    assert again.read_bytes() == (folder / "run.h5").read_bytes()
    assert contents(again)["imu/gyro1/rate_rps"] != contents(other)["imu/gyro1/rate_rps"]
    assert "PASS" in capsys.readouterr().out


@pytest.mark.full
def test_a_stim300_and_the_array_ride_on_one_table(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(tmp_path)
    code, result = run_json(
        capsys, "--bench", bench, "--script", short, "-o", tmp_path / "r.h5", "--device", "stim300", "--device", "array"
    )
    assert code == 0, result["reason"]
    assert len(result["gyros"]) == 7
    stim = {g["name"]: g for g in result["gyros"]}["x"]
    assert abs(stim["k"] - 300e-6) < 4 * stim["sd"]["k"]


def test_a_recording_calibrates_to_what_its_run_said(
    brief_run: tuple[Path, dict[str, Any]], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, result = brief_run
    assert main(["calibrate", str(folder / "run.h5"), "--json"]) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["gyros"] == result["gyros"]
    assert again["samples"] == result["samples"]


def test_limits_decide_between_pass_and_fail_and_the_reason_names_the_limit(
    tmp_path: Path, brief: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(tmp_path, ('scale_factor_error = "10000 ppm"', 'scale_factor_error = "3000 ppm"'))
    code, result = run_json(capsys, "--bench", bench, "--script", brief, "-o", tmp_path / "r.h5")
    assert code == 1
    assert result["outcome"] == "FAIL"
    assert "gyro1 k" in result["reason"]
    assert "3000 ppm" in result["reason"]


def test_a_table_fault_in_mid_run_ends_at_rest_with_a_readable_file(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(tmp_path, end='\n[twin.fault]\naxis = "y"\nat = "25 s"\n')
    code, result = run_json(capsys, "--bench", bench, "--script", short, "-o", tmp_path / "r.h5")
    assert code == 4
    assert result["outcome"] == "FAULT"
    assert "table" in result["reason"]
    assert "axis y" in result["reason"]
    assert events(tmp_path / "r.h5")[-1] == "table at rest"
    with h5py.File(tmp_path / "r.h5") as file:
        assert file.attrs["outcome"] == "FAULT"
        assert file["imu/gyro1/t_ns"][-1] > 20e9


def test_a_bench_with_lower_limits_refuses_the_script_before_motion(
    tmp_path: Path, short: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(tmp_path, ('max_rate = "100 deg/s"', 'max_rate = "30 deg/s"'))
    code = main(["run", "--bench", str(bench), "--script", str(short), "-o", str(tmp_path / "r.h5")])
    assert code == 2  # the station's own check comes first
    assert "exceeds the limit of axis x" in capsys.readouterr().err
    assert not (tmp_path / "r.h5").exists()


def test_an_existing_recording_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "r.h5"
    path.write_bytes(b"precious")
    assert main(["run", "-o", str(path)]) == 2
    assert "exists already and is never overwritten. Give another name" in capsys.readouterr().err
    assert path.read_bytes() == b"precious"


@pytest.mark.parametrize(
    ("old", "new", "line_of", "says"),
    [
        ("poll_rate =", "pol_rate =", "pol_rate =", "did you mean poll_rate?"),
        ('timeout = "0.2 s"', 'timeout = "0.2 Hz"', "timeout =", "does not measure time"),
        ('latitude = "45 deg"', "latitude = 45", "latitude =", "has no unit"),
        ('array = "tetrahedron"', "p = [[1,0,0],[0,1,0],[1,0,0],[0,1,0]]", "p = [[", "rank < 3"),
        ('array = "tetrahedron"', "p = [[1,0,0],[0,1,0],[0,0,2],[0,1,0]]", "p = [[", "length 2, not 1"),
        ('profile = "kinco"', 'profile = "nobody"', "profile =", "no drive profile"),
        ("seed = 0", "seed = -1", "seed =", "must not be negative"),
        ('k = "5000 ppm"', 'k = ["1 ppm", "2 ppm"]', "k = [", "2 values instead of 4"),
    ],
)
def test_a_wrong_bench_file_is_told_with_its_line_and_nothing_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, line_of: str, says: str
) -> None:
    bench = bench_file(tmp_path, (old, new))
    lines = bench.read_text().splitlines()
    number = next(i for i, line in enumerate(lines, 1) if line.startswith(line_of))
    assert main(["run", "--bench", str(bench), "-o", str(tmp_path / "r.h5")]) == 2
    said = capsys.readouterr().err
    assert f"line {number}:" in said
    assert says in said
    assert "Traceback" not in said


@pytest.mark.parametrize(
    ("step", "says"),
    [
        (
            'kind = "rotate"\naxis = "x"\nrate = "200 deg/s"\nduration = "40 s"',
            "exceeds the limit of axis x, 100 deg/s",
        ),
        ('kind = "rotate"\naxis = "x"\nrate = "20 deg/s"\nduration = "1 s"', "too short for two ramps"),
        ('kind = "rotate"\naxis = "x"\nrate = "2 deg/s"\nacceleration = "80 deg/s2"\nduration = "9 s"', "50 deg/s2"),
        ('kind = "rest"\nduration = "-3 s"', "Give a time above zero"),
        ('kind = "dance"', "'dance' is not one of rest, move, rotate"),
        ('kind = "rest"\nduraton = "3 s"', "duration is missing; is it misspelled as duraton?"),
    ],
)
def test_a_script_that_cannot_be_done_is_refused_before_motion(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], step: str, says: str
) -> None:
    script = tmp_path / "script.toml"
    script.write_text(f"[[step]]\n{step}\n")
    assert main(["run", "--script", str(script), "-o", str(tmp_path / "r.h5")]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "r.h5").exists()


@pytest.mark.parametrize(
    ("link", "code", "says"),
    [
        ("table=tcp://127.0.0.1:1", 4, "table: nothing answers at 127.0.0.1:1"),
        ("table=serial:///dev/null", 4, "table: cannot open serial port /dev/null"),
        ("table=udp://1.2.3.4:5", 2, "is not a link it supports"),
        ("table=tcp://[::1", 2, "table: 'tcp://[::1' is not a link"),
        ("table=rfc2217://1.2.3.4:99999", 2, "is not a link"),
        ("array=can:nosuch:0", 4, "array: cannot open CAN bus"),
        ("array=tcp://1.2.3.4:5", 2, "is not a CAN link"),
        ("stim300=serial:///dev/nosuch", 4, "stim300: cannot open serial port"),
        ("nosuch=twin:", 2, "has no device 'nosuch'"),
        ("nonsense", 2, "write DEVICE=URL"),
    ],
)
def test_a_link_that_leads_nowhere_names_its_device(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], link: str, code: int, says: str
) -> None:
    assert main(["run", "--link", link, "-o", str(tmp_path / "r.h5"), "--json"]) == code
    captured = capsys.readouterr()
    result = json.loads(captured.out)
    assert says in result["reason"]
    assert result["outcome"] == ("FAULT" if code == 4 else None)


def test_ctrl_c_in_mid_run_leaves_the_table_at_rest_and_a_readable_file(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    words = command("run", "--json", "-o", path)
    with ctrl_c_of_children(ignored=True):  # as of a background job: whoever asks a moving table to stop is heard
        run = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (path.exists() and path.stat().st_size > 400_000) and time.monotonic() < deadline:
        assert run.poll() is None
        time.sleep(0.05)  # another process: there is nothing to await
    run.send_signal(signal.SIGINT)
    try:
        out, err = run.communicate(timeout=30)
    finally:
        run.kill()
    result = json.loads(out)
    assert run.returncode == 3
    assert result["outcome"] == "ABORTED"
    assert "Ctrl-C" in result["reason"]
    assert "Traceback" not in err
    assert events(path)[-1] == "table at rest"
    with h5py.File(path) as file:
        assert file.attrs["outcome"] == "ABORTED"
        assert len(file["imu/gyro1/t_ns"]) == len(file["imu/gyro1/rate_rps"])


def test_gyros_of_one_name_on_two_devices_are_told_apart_by_their_sources(
    tmp_path: Path, brief: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    imu = """
[[imu]]
name = "{}"
protocol = "described"
description = "own.toml"
array = "tetrahedron"
rate = "100 Hz"
[imu.datasheet]
arw = "0.01 deg/s/rtHz"
bias_instability = "10 deg/h"
"""
    csv = (DESCRIPTIONS / "csv.toml").read_text()
    (tmp_path / "own.toml").write_text(csv.replace('["gx", "gy", "gz"]', '["gx", "gy", "gz", "g4"]'))
    table = (Path(__file__).parents[1] / "data" / "benches" / "two_triads.toml").read_text().partition("[[imu]]")[0]
    (tmp_path / "bench.toml").write_text(table + imu.format("left") + imu.format("right"))
    _, found = run_json(capsys, "--bench", tmp_path / "bench.toml", "--script", brief, "-o", tmp_path / "run.h5")
    both = {(source, f"gyro{i}") for source in ("left", "right") for i in (1, 2, 3, 4)}
    assert {(gyro["source"], gyro["name"]) for gyro in found["gyros"]} == both
    assert set(found["parity"]) == {f"{source} {name}" for source, name in both}
