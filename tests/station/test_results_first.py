"""What a person reads first: the verdict, the states in one unit each, limits as they were written, what to do next."""

from __future__ import annotations

import re
import shutil
from itertools import pairwise
from pathlib import Path

import h5py
import pytest

from station.bench.bench import default_bench_text
from station.cli import main

TURN = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "60 deg/s"\nacceleration = "50 deg/s2"\nduration = "6 s"\n'
UNITS = '[units]\nbias = "deg/s"\nmisalignment = "mrad"\n\n[undeclared]'
LINES, COLUMNS = 24, 80


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Runs of a short script: one fails by the built-in bench, one by a bench with units of its own, one passes."""
    folder = tmp_path_factory.mktemp("runs")
    rest = '[[step]]\nkind = "rest"\nduration = "6 s"\n'
    (folder / "short.toml").write_text(f"{rest}{''.join(map(TURN.format, 'xyz'))}{rest}")
    text = default_bench_text()
    (folder / "own.toml").write_text(text.replace("[undeclared]", UNITS).replace('"0.5 deg"', '"0.09 deg"'))
    loose = re.sub(r'(sd_\w+ = )"[^"]*"', r"#\1", text)
    (folder / "loose.toml").write_text(loose)
    script = ["--script", str(folder / "short.toml"), "--json"]
    assert main(["run", *script, "-o", str(folder / "fail.h5")]) == 1
    assert main(["run", *script, "--bench", str(folder / "loose.toml"), "-o", str(folder / "loose.h5")]) == 0
    shutil.copy(folder / "fail.h5", folder / "own.h5")
    with h5py.File(folder / "own.h5", "r+") as file:  # the bench is all in which such a run would be another
        file.attrs["bench"] = (folder / "own.toml").read_text()
    return folder


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal of 80 columns, without colours."""
    monkeypatch.setenv("COLUMNS", str(COLUMNS))
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("NO_COLOR", "1")


def shown(capsys: pytest.CaptureFixture[str], *words: str) -> list[str]:
    main(list(words))
    return re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("command", ["calibrate", "report", "export"])
def test_verdict_and_states_come_first_and_fit_a_screen(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    path = str(folder / "loose.h5")
    more = {
        "calibrate": [],
        "report": ["-o", str(tmp_path / "r.html")],
        "export": ["--format", "json", "-o", str(tmp_path / "c.json")],
    }
    lines = shown(capsys, command, path, *more[command])
    assert lines[0].startswith("PASS")
    assert "States and their standard deviations" in lines[2]
    assert len(lines) <= LINES
    assert sum(line.startswith("Consistency (NIS): ") for line in lines) == 1
    assert sum(line.startswith("noise: ") for line in lines) == 1
    assert command == "export" or any(line.startswith("next: `station ") for line in lines)
    assert not [line for line in lines if "Uncertainty budget" in line]
    (tmp_path / "r.html").unlink(missing_ok=True)
    (tmp_path / "c.json").unlink(missing_ok=True)
    detailed = shown(capsys, command, path, *more[command], "--details")
    assert [line for line in detailed if "Uncertainty budget" in line]
    assert len(detailed) > len(lines)


@pytest.mark.usefixtures("narrow")
def test_of_a_fail_the_worst_limits_are_told_and_all_with_details(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(folder / "fail.h5")
    broken = re.compile(r" ?gyro\d (± of )?\w+ +[\d.]+ \S+ +[\d.]+ \S+ +[\d.]+ (%|times)")
    lines = shown(capsys, "calibrate", path)
    assert lines[0].startswith("FAIL")
    assert sum(bool(broken.match(line)) for line in lines) == 4
    assert len(lines) < LINES  # with the prompt below them
    count = int(re.match(r"FAIL  (\d+) limits of the bench exceeded", lines[0])[1])  # type: ignore[index]
    detailed = shown(capsys, "calibrate", path, "--details")
    assert sum(bool(broken.match(line)) for line in detailed) == count > 4


@pytest.mark.usefixtures("narrow")
@pytest.mark.parametrize("words", [("calibrate", "fail.h5", "--details"), ("plan",)])
def test_lines_fit_80_columns_and_no_figure_is_parted_from_its_unit(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    monkeypatch.chdir(folder)
    lines = shown(capsys, *words)
    assert max(map(len, lines)) <= COLUMNS
    units = r"(deg|deg/s|deg/h|ppm|urad|s|Hz|degC|min|%)\b"
    parted = [pair for pair in pairwise(lines) if re.search(r"(^| )\d[\d.]*$", pair[0]) and re.match(units, pair[1])]
    assert not parted


def test_each_state_has_one_unit_and_a_limit_is_told_as_written(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    usual = " ".join(shown(capsys, "calibrate", str(folder / "fail.h5"), "--details"))
    assert "100 urad" in usual
    assert not re.search(r"b \(deg/s\)|sigma_j \(deg\)|mrad|\d deg ", usual.replace("deg/s (x", ""))
    own = " ".join(shown(capsys, "calibrate", str(folder / "own.h5"), "--details"))
    assert "5 deg/h (0.001389 deg/s)" in own
    assert "100 urad (0.1 mrad)" in own
    assert "0.09 deg (1.571 mrad)" in own
    assert "sigma_j (mrad)" in own
    assert "b (deg/s)" in own
    assert main(["report", str(folder / "own.h5"), "-o", str(tmp_path / "own.html")]) == 0
    text = (tmp_path / "own.html").read_text(encoding="utf-8")
    assert "mrad" in text
    assert re.search(r"<var>b</var>, °/s", text)  # among the numbers of the correction, too
    assert not re.search(r"<var>b</var>, °/h", text)
    assert "1570.8" not in text
    assert "0.09°" in text or "0.09 °" in text
    capsys.readouterr()
    plan = " ".join(shown(capsys, "plan", "--bench", str(folder / "own.toml")))
    assert "mrad" in plan
    assert "urad" not in plan.partition("Smallest detectable size")[0]


@pytest.mark.usefixtures("narrow")
def test_a_plan_begins_with_its_verdict(capsys: pytest.CaptureFixture[str]) -> None:
    assert shown(capsys, "plan")[0].startswith("OK  every sigma")
