"""A run that ends when it has shown enough."""

from __future__ import annotations

import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import changed

from station.bench.bench import default_bench_text
from station.cli import main

TURNS = "".join(
    f"""
[[step]]
kind = "rotate"
axis = "{axis}"
rate = "{sign}40 deg/s"
duration = "8 s"
acceleration = "20 deg/s2"
"""
    for axis in "zyx"
    for sign in ("", "-")
)
WAIT_FOR = str(Path(__file__).parents[2] / "docs/examples/wait_for.py")
WAIT = '\n[[step]]\nkind = "wait_for"\nleast = "60 s"\nmost = "200 s"\nchange = "0 degC"\n'
REST = '\n[[step]]\nkind = "rest"\nduration = "{} s"\n'


@pytest.fixture
def script(tmp_path: Path) -> str:
    """A script whose turns show enough long before its end."""
    return script_file(tmp_path, REST.format(10) + TURNS + TURNS + REST.format(100))


def script_file(folder: Path, steps: str) -> str:
    """Write a script."""
    path = folder / "script.toml"
    path.write_text(steps, encoding="utf-8")
    return str(path)


def bench_file(folder: Path, old: str, new: str) -> str:
    """Write the built-in bench with another text in it."""
    path = folder / "bench.toml"
    path.write_text(changed(default_bench_text(), (old, new)), encoding="utf-8")
    return str(path)


def poor_timing(folder: Path) -> str:
    """Write a bench whose stated timing is poor: it keeps no run going whose ramps have told the offset."""
    bench = Path(bench_file(folder, 'sd_bias = "5 deg/h"', 'sd_bias = "12 deg/h"'))
    stated = bench.read_text(encoding="utf-8")
    assert 'timing = "50 us"' in stated
    bench.write_text(stated.replace('timing = "50 us"', 'timing = "20 ms"'), encoding="utf-8")
    return str(bench)


def test_a_run_ends_once_every_sigma_is_reached_and_says_so_also_where_its_length_is_not_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STATION_PLUGINS", "")  # what main leaves there goes with the test
    path = tmp_path / "run.h5"
    script = script_file(tmp_path, REST.format(10) + TURNS + TURNS + WAIT)
    arguments = ["run", "--bench", poor_timing(tmp_path), "--script", script, "--end-early", "-o", str(path)]
    assert main([*arguments, "--plugin", WAIT_FOR, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["outcome"] == "PASS"
    sd = np.array([list(gyro["sd"].values()) for gyro in result["gyros"]])
    assert (sd <= [100e-6, np.radians(12 / 3600), 100e-6, 100e-6]).all()
    with h5py.File(path) as file:
        why = str(file.attrs["ended_early"])
        events = [text.decode() for text in file["events/text"][:]]
        ended_s = file["events/t_ns"][-1] * 1e-9
    assert why == result["ended_early"]
    assert re.match(r"after [0-9.]+ s of [0-9.]+ to [0-9.]+ s, in step '", why)
    assert "every required sigma is reached" in why
    assert "Mean NIS" in why
    assert [event.split(" after")[0] for event in events] == ["script begins", "ended early", "table at rest"]
    assert 40 < ended_s < 130


@pytest.mark.full
def test_a_run_that_ends_early_does_so_at_the_same_instant_each_time_and_prints_it(
    script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first.h5", tmp_path / "second.h5"
    arguments = ["run", "--bench", poor_timing(tmp_path), "--script", script, "--end-early", "-o"]
    assert main([*arguments, str(first)]) == 0
    printed = capsys.readouterr().out
    assert "ended early after" in printed
    assert "PASS" in printed
    assert main([*arguments, str(second), "--json"]) == 0
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.full
def test_a_run_that_never_shows_enough_goes_to_its_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = script_file(tmp_path, REST.format(5) + TURNS + REST.format(5))
    bench = bench_file(tmp_path, 'sd_bias = "5 deg/h"', 'sd_bias = "0.5 deg/h"')
    output = tmp_path / "run.h5"
    assert main(["run", "--bench", bench, "--script", script, "--end-early", "-o", str(output), "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["ended_early"] is None
    with h5py.File(output) as file:
        assert "ended_early" not in file.attrs
        assert len(file["steps/label"]) == 8


@pytest.mark.full
def test_a_residual_that_is_not_clean_keeps_the_run_going(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = script_file(tmp_path, REST.format(5) + TURNS + REST.format(15))
    bench = bench_file(tmp_path, "nis_high = 1.2", "nis_high = 0.85")
    assert (
        main(["run", "--bench", bench, "--script", script, "--end-early", "-o", str(tmp_path / "r.h5"), "--json"]) == 1
    )
    assert json.loads(capsys.readouterr().out)["ended_early"] is None


def test_a_bench_that_requires_no_sigma_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "".join(line for line in default_bench_text().splitlines(keepends=True) if not line.startswith("sd_"))
    path = tmp_path / "bench.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["run", "--bench", str(path), "--end-early", "-o", str(tmp_path / "r.h5")]) == 2
    assert "needs required sigmas" in capsys.readouterr().err
    assert not (tmp_path / "r.h5").exists()


WHOLE_IMU = Path(__file__).parents[1] / "data/benches/full_imu.toml"
POSE = """
[[step]]
kind = "pose"
{axes}
rate = "60 deg/s"
acceleration = "50 deg/s2"
settle = "1 s"
duration = "6 s"
"""
POSES = ('x = "90 deg"', 'x = "-90 deg"', 'x = "180 deg"', 'x = "0 deg"\ny = "90 deg"', 'y = "-90 deg"', 'y = "45 deg"')


def test_a_run_does_not_end_before_its_accelerometers_are_known_and_says_that_it_waits_for_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Turns about z show nothing of two accelerometers, which gravity reaches once y and x have turned."""
    bench = tmp_path / "whole.toml"
    limits = '[limits.accelerometers]\nsd_scale_factor_error = "75 ppm"\nsd_lever_arm = "20 mm"\n\n[undeclared]'
    wider = ('sd_bias = "5 deg/h"', 'sd_bias = "20 deg/h"')
    text = changed(WHOLE_IMU.read_text(encoding="utf-8"), ("[undeclared]", limits), wider)
    bench.write_text(text, encoding="utf-8")
    poses = "".join(POSE.format(axes=axes) for axes in POSES)
    script = script_file(tmp_path, REST.format(10) + TURNS + TURNS + REST.format(20) + poses + REST.format(100))
    path = tmp_path / "run.h5"
    assert main(["run", "--bench", str(bench), "--script", script, "--end-early", "-o", str(path), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["outcome"] == "PASS"
    assert result["ended_early"]
    sd = [one["sd"]["k"] for source in result["accelerometers"] for one in source["accelerometers"]]
    assert max(sd) < 75e-6
    with h5py.File(path) as file:
        events = [text.decode() for text in file["events/text"][:]]
        waited_s, ended_s = (
            file["events/t_ns"][next(i for i, event in enumerate(events) if words in event)] * 1e-9
            for words in ("waiting for", "ended early")
        )
    (waits,) = [event for event in events if "waiting for" in event]
    assert re.search(r"waiting for accel [xyz] k", waits)
    assert waited_s + 5 < ended_s
