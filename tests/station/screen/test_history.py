"""`station history`: recordings of a folder, what has moved, control charts."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import shutil
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from conftest import HistoryFirst, driven, until
from textual.pilot import Pilot

from estimator.estimation.control_charts import control_chart
from station.cli import main
from station.commands.history import calibration_valid_on
from station.errors import UsageError
from station.screen.choices import Choices

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


def test_a_device_that_moved_is_told_at_once(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines = history(capsys, series).splitlines()
    (moved,) = [line for line in lines if "b of gyro1" in line]
    assert moved.startswith("! day-11.h5 moved: ")
    assert [line.split()[0] for line in lines if "PASS !" in line] == ["2026-12-02"]
    (only,) = [each for each in json.loads(history(capsys, series, "--json"))["recordings"] if each["moved"]]
    assert (only["file"], [(m["gyro"], m["state"]) for m in only["moved"]]) == ("day-11.h5", [("gyro1", "b_rps")])
    assert only["moved"][0]["since"] == "day-10.h5"


def test_a_copy_hides_no_move(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(series / "day-11.h5", series / "copy.h5")
    found = json.loads(history(capsys, series, "--json"))["recordings"]
    assert {each["file"] for each in found if each["moved"]} == {"day-11.h5", "copy.h5"}


def test_the_end_of_a_run_tells_that_the_device_has_moved(
    place: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(place, runs, -500, sigmas=90.0)
    for name in ("new.h5", "newer.h5"):
        main(
            [
                "run",
                "--bench",
                "bench.toml",
                "--script",
                str(runs / "tiny.toml"),
                "--serial-number",
                "SN-0042",
                "-o",
                name,
            ]
        )
        shown = " ".join(capsys.readouterr().out.split())
        assert ("MOVED since 2025-07-09 12:00 (day--500.h5): b of gyro1 -" in shown) == (name == "new.h5")
        assert ("MOVED" in shown) == (name == "new.h5")


def test_a_result_on_the_screen_tells_that_the_device_has_moved(series: Path) -> None:
    app = HistoryFirst(Choices(folder=series, operator="A. Operator"))

    def shown(block: str) -> str:
        return " ".join(" ".join(str(static.render()) for static in app.screen.query(block)).split())

    async def drive(pilot: Pilot[None]) -> None:
        for name, before in (("day-11.h5", "day-10.h5"), ("day-10.h5", "day-09.h5")):
            app.switch_mode("history")
            app.open_recording(series / name)
            await until(pilot, lambda before=before: before in shown("#change"))
            told = shown("#verdict")
            assert ("MOVED since 2026-12-01 12:00 (day-10.h5): b of gyro1 +" in told) == (name == "day-11.h5")

    driven(app, drive)


def test_the_change_on_the_screen_is_that_since_the_last_comparable_run(series: Path, runs: Path) -> None:
    write_run(series, runs, 12, moved=30.0, script="longer")
    write_run(series, runs, 13, moved=30.0, outcome="FAIL")
    newest = write_run(series, runs, 14)
    app = HistoryFirst(Choices(folder=series, operator="A. Operator"))

    async def drive(pilot: Pilot[None]) -> None:
        app.open_recording(newest)
        await until(pilot, lambda: "(day-" in " ".join(str(one.render()) for one in app.screen.query("#change")))
        assert "(day-11.h5" in str(app.screen.query_one("#change").render())

    driven(app, drive)


@pytest.mark.parametrize(
    "other",
    [
        pytest.param({"outcome": "FAULT"}, id="FAULT"),
        pytest.param({"station": "another bench"}, id="another bench"),
        pytest.param({"outcome": "ABORTED"}, id="ABORTED", marks=pytest.mark.full),
        pytest.param({"script": "longer"}, id="longer", marks=pytest.mark.full),
    ],
)
def test_only_comparable_runs_are_compared(
    other: dict[str, str], series: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_run(series, runs, 13, moved=300.0, **other)
    found = json.loads(history(capsys, series, "--serial", "SN-0042", "--json"))
    assert not found["recordings"][0]["moved"]
    charts = [chart for chart in found["charts"] if chart["bench"] != "another bench" and chart["script"] != "longer"]
    assert {len(chart["values"]) for chart in charts} == {12}


def test_control_charts_leave_failed_runs_out_of_their_limits(
    series: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    clean = json.loads(history(capsys, series, "--serial", "SN-0042", "--json"))["charts"]
    write_run(series, runs, 12, moved=50.0, outcome="FAIL")
    found = json.loads(history(capsys, series, "--serial", "SN-0042", "--json"))["charts"]
    assert [chart["limits"] for chart in found] == [chart["limits"] for chart in clean]
    assert all(chart["outside"][-1] for chart in found)
    assert "1 FAIL" in history(capsys, series, "--serial", "SN-0042")


def test_charts_of_a_device_name_the_run_that_is_outside(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = history(capsys, series, "--serial", "SN-0042")
    (line,) = [line for line in shown.splitlines() if line.startswith("!") and "b (deg/h) of gyro1" in line]
    assert "2026-12-02" in line


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
    for since in ("yesterday", "2026/11/21", "20261121"):
        assert main(["history", ".", "--since", since]) == 2


def test_a_calibration_of_no_numbers_and_a_name_that_steers_harm_no_list(
    series: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (series / "day-03.h5").rename(series / "day\x1b[31m.h5")
    with h5py.File(series / "day-05.h5", "r+") as file:
        file["calibration/states"][0, 0] = np.nan
    for day in (7, 8):
        with h5py.File(series / f"day-{day:02}.h5", "r+") as file:
            file["calibration/sd"][0, 0] = 0.0
    told = history(capsys, series, "--serial", "SN-0042", "--json")
    (chart,) = json.loads(told, parse_constant=pytest.fail)["charts"]
    assert len(chart["files"]) == 11
    assert "Control charts" in history(capsys, series, "--serial", "SN-0042")
    assert "\x1b" not in history(capsys, series, "--csv")


def test_limits_are_those_of_the_textbook() -> None:
    """Individuals and moving ranges: NIST/SEMATECH e-Handbook of Statistical Methods, 6.3.2.2, its example."""
    values = [49.6, 47.6, 49.9, 51.3, 47.8, 51.2, 52.6, 52.4, 53.6, 52.1]
    chart = control_chart(values, [True] * len(values))
    assert chart.mean == pytest.approx(50.81)
    assert chart.limits == pytest.approx((45.8159, 55.8041), abs=2e-2)
    assert not any(chart.outside)


def test_a_slow_drift_is_seen_by_the_moving_average_before_any_single_run() -> None:
    """Twenty runs in control, then each two sigmas above them."""
    scatter = np.resize([1.0, -1.0, 0.5, -0.5, 0.0], 20)
    chart = control_chart([*scatter, *(scatter[:10] + 1.9)], [True] * 20 + [False] * 10)
    assert not any(chart.outside)
    assert not any(chart.ewma_outside[:20])
    assert any(chart.ewma_outside[20:])


def test_copies_of_one_run_are_within_their_limits() -> None:
    chart = control_chart([0.1] * 7, [True] * 7)
    assert not any(chart.outside)
    assert not any(chart.ewma_outside)


def test_a_folder_that_may_not_be_read_is_an_error_and_no_empty_list(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = place / "locked"
    folder.mkdir(mode=0)
    user = os.geteuid()
    try:
        if user == 0:  # whom no mode keeps out
            os.seteuid(65534)
        assert main(["history", str(folder)]) == 2
    finally:
        os.seteuid(user)
    said = capsys.readouterr()
    assert "locked" in said.err
    assert "Permission denied" in said.err
    assert not said.out


def test_the_calibration_that_was_valid_on_a_day_is_found(
    series: Path, runs: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def valid_on(day: str, expected: int) -> dict[str, Any]:
        capsys.readouterr()
        assert main(["history", str(series), "--serial", "SN-0042", "--valid-on", day, "--json"]) == expected
        return dict(json.loads(capsys.readouterr().out))

    assert valid_on("2026-11-25", 0)["recording"]["file"] == "day-04.h5"
    assert valid_on("2027-11-25", 0)["recording"]["file"] == "day-11.h5"
    assert "the first one is of 2026-11-21" in valid_on("2026-11-01", 1)["reason"]
    write_run(series, runs, 20, outcome="ABORTED")
    assert valid_on("2026-12-20", 0)["recording"]["file"] == "day-11.h5"
    (series / "day-11-certificate.toml").write_text("[certificate]\nnext_due = 2026-12-18\n")
    assert valid_on("2026-12-18", 0)["valid"]
    assert "was due on 2026-12-18" in valid_on("2026-12-20", 1)["reason"]
    write_run(series, runs, 15, outcome="FAIL")
    assert "failed on 2026-12-06" in valid_on("2026-12-10", 1)["reason"]
    found = calibration_valid_on("SN-0042", date(2026, 11, 25), series)
    assert found.gyros[0].name == "gyro1"
    with pytest.raises(UsageError, match="failed on"):
        calibration_valid_on("SN-0042", date(2026, 12, 10), series)


def test_a_day_without_a_device_is_refused(series: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["history", str(series), "--valid-on", "2026-11-25"]) == 2
    assert main(["history", str(series), "--serial", "SN-0042", "--valid-on", "yesterday"]) == 2
    assert "for instance 2026-11-21" in capsys.readouterr().err
