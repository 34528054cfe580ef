"""`station history`: recordings of a folder, what has moved, control charts."""

from __future__ import annotations

import csv
import io
import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from station.cli import main

_DAY_S = 86_400
_NOON_S = 1_795_262_400  # 2026-11-21 12:00:00 UTC


def write_run(folder: Path, runs: Path, day: int, moved: float = 0.0, sigmas: float = 0.0, **attributes: str) -> Path:
    """Write the first recording again as that of another day; ``moved``: all states but one, ``sigmas``: bias too."""
    path = folder / f"day-{day:02d}.h5"
    shutil.copy(runs / "first.h5", path)
    with h5py.File(path, "r+") as file:
        file.attrs.update({"clock_zero_utc_s": float(_NOON_S + day * _DAY_S), **attributes})
        sd = file["calibration/sd"][()]
        shift = moved * sd
        shift[0, 1] += sigmas * sd[0, 1]
        file["calibration/states"][...] = file["calibration/states"][()] + shift
    return path


@pytest.fixture
def series(place: Path, runs: Path) -> Path:
    """Return a folder of 12 runs of a device that scatters by half its sigmas and has moved in the last."""
    folder = place / "series"
    folder.mkdir()
    chance = np.random.default_rng(3)
    for day in range(12):
        write_run(folder, runs, day, moved=0.5 * chance.standard_normal(), sigmas=9.0 * (day == 11))
    return folder


def history(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    """Return what `station history` prints."""
    capsys.readouterr()
    assert main(["history", *map(str, arguments)]) == 0
    return capsys.readouterr().out


def test_a_list_is_newest_first_and_can_be_narrowed(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = [line for line in history(capsys, series).splitlines() if "SN-0042" in line]
    assert len(lines) == 12
    assert lines[0].index("2026-12-02") < 6
    found = json.loads(history(capsys, series, "--since", "2026-11-30", "--outcome", "pass", "--json"))
    assert [each["file"] for each in found["recordings"]] == ["day-11.h5", "day-10.h5", "day-09.h5"]
    assert json.loads(history(capsys, series, "--serial", "SN-0001", "--json"))["recordings"] == []


def test_figures_are_those_of_the_files_in_json_and_csv(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    newest = json.loads(history(capsys, series, "--json"))["recordings"][0]
    row = next(csv.DictReader(io.StringIO(history(capsys, series, "--csv"))))
    with h5py.File(series / "day-11.h5") as file:
        bias, sd = file["calibration/states"][0, 1], file["calibration/sd"][0, 1]
    assert newest["gyros"][0]["b_rps"] == float(row["gyro1 b_rps"]) == bias
    assert newest["gyros"][0]["sd"]["b_rps"] == float(row["gyro1 sd b_rps"]) == sd
    assert row["serial"] == newest["serial"] == "SN-0042"


def test_no_name_steers_a_terminal_or_is_a_formula(
    series: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(series, runs, 30, station="=1+2", device_serial="\x1b[31mred[/] [bold]", operator="@SUM(A1)")
    shown = history(capsys, series)
    assert "\x1b" not in shown
    assert "[bold]" in shown
    row = next(csv.DictReader(io.StringIO(history(capsys, series, "--csv"))))
    assert (row["bench"], row["operator"]) == ("'=1+2", "'@SUM(A1)")


@pytest.mark.parametrize("words", [[], ["--serial", "SN-0042"]])
def test_history_fits_80_columns(
    words: Sequence[str], series: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")
    shown = re.sub(r"\x1b\[[0-9;]*m", "", history(capsys, series, *words))
    assert max(map(len, shown.splitlines())) <= 80
    assert "…" not in shown


def test_a_folder_that_is_not_there_is_wrong_usage(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["history", "nowhere"]) == 2
    assert "nowhere" in capsys.readouterr().err
    assert main(["history", ".", "--since", "yesterday"]) == 2
