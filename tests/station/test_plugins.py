"""A table and an IMU of one's own, each one file with its twin, brought by a bench file or an installed package."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from support import command

from drivers.imus.registry import IMUS
from drivers.plugins import PluginError
from drivers.tables.registry import TABLES
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


def test_a_table_and_an_imu_out_of_two_files_are_calibrated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
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


def packed(path: Path) -> Path:
    """Pack both examples as a wheel that announces them by entry points."""
    files = {f"{name}.py": (EXAMPLES / f"{name}.py").read_text() for name in ("numbered_table", "counted_imu")}
    files["mine-1.0.dist-info/METADATA"] = "Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n"
    files["mine-1.0.dist-info/WHEEL"] = (
        "Wheel-Version: 1.0\nGenerator: hand\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    )
    files["mine-1.0.dist-info/entry_points.txt"] = (
        "[turntable_station.tables]\nnumbered = numbered_table:SPEC\n"
        "[turntable_station.imus]\ncounted = counted_imu:SPEC\nbroken = counted_imu:NO_SUCH\nempty = counted_imu:SYNC\n"
    )
    files["mine-1.0.dist-info/RECORD"] = "".join(f"{name},,\n" for name in files)
    wheel = path / "mine-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return wheel


def test_an_installed_package_brings_devices_by_entry_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(packed(tmp_path)))  # a wheel can be imported as it is
    imus, tables = IMUS.beside([]), TABLES.beside([])
    assert list(imus)[-3:] == ["counted", "broken", "empty"]
    assert (imus["counted"].name, tables["numbered"].name) == ("counted", "numbered")
    for name, told in (
        ("broken", r"entry point broken of turntable_station.imus \(counted_imu:NO_SUCH\): AttributeError: .*NO_SUCH"),
        ("empty", "empty: bytes is no ImuSpec"),
    ):
        with pytest.raises(PluginError, match=told):
            imus[name]


@pytest.mark.full
def test_both_run_the_360_s_script_out_of_a_wheel_that_pip_installed(tmp_path: Path) -> None:
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", str(tmp_path / "site")]
    subprocess.run([*pip, str(packed(tmp_path))], check=True, timeout=120)
    (tmp_path / "bench.toml").write_text(BENCH.format(plugins=""))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "site")}
    run = command("run", "--bench", "bench.toml", "--json", "-o", "run.h5")
    ended = subprocess.run(run, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=110, check=False)
    assert ended.returncode == 0, ended.stderr
    assert [gyro["k"] for gyro in json.loads(ended.stdout)["gyros"]] == pytest.approx([3e-3, -2e-3, 1e-3], abs=2e-4)
