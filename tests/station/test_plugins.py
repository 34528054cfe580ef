"""A table and an IMU of somebody's own, each one file with its twin, brought by a bench file or an installed package."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from station.cli import main

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"
BENCH = """
{plugins}

[table]
protocol = "numbered"
[table.z]
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.y]
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"
[table.x]
max_rate = "100 deg/s"
max_acceleration = "50 deg/s2"

[[imu]]
name = "mine"
protocol = "counted"
array = "triad"
rate = "100 Hz"
resolution = "18 deg/h"
[imu.datasheet]
arw = "0.005 deg/s/rtHz"

[undeclared]
effects = "none"

[twin.mine]
k = ["3000 ppm", "-2000 ppm", "1000 ppm"]
b = "0.1 deg/s"
[twin.mine.fault]
dropped = "1 %"
"""
SCRIPT = "".join(
    f'[[step]]\nkind = "rest"\nduration = "3 s"\n[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "60 deg/s"\n'
    'acceleration = "50 deg/s2"\nduration = "12 s"\n'
    for axis in "xyz"
)


def test_a_table_and_an_imu_out_of_two_files_are_calibrated(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [str(EXAMPLES / name) for name in ("numbered_table.py", "counted_imu.py")]
    (tmp_path / "bench.toml").write_text(BENCH.format(plugins=f"plugins = {json.dumps(files)}"))
    (tmp_path / "script.toml").write_text(SCRIPT)
    told = [f"--{key}={tmp_path / name}" for key, name in (("bench", "bench.toml"), ("script", "script.toml"))]
    assert main(["run", *told, "--json", "--seed", "3", "-o", str(tmp_path / "run.h5")]) in (0, 1)
    result = json.loads(capsys.readouterr().out)
    gyros = result["gyros"]
    assert [gyro["k"] for gyro in gyros] == pytest.approx([3000e-6, -2000e-6, 1000e-6], abs=400e-6)
    assert [gyro["b_rps"] for gyro in gyros] == pytest.approx([math.radians(0.1)] * 3, abs=math.radians(0.005))
    assert result["lost"] / result["samples"] == pytest.approx(0.01, abs=0.005)
