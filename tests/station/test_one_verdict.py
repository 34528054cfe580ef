"""One recording, one verdict: whoever is asked of a run says how it ended, and the same mean NIS."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import RunOptions, Session
from station.scripts.script import Script, load_script

REST = '[[step]]\nkind = "rest"\nduration = "3 s"\n'
TURN = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "4 s"\n'
LOOSE = (("100 ppm", "10000 ppm"), ('sd_bias = "5 deg/h"', 'sd_bias = "500 deg/h"'), ("100 urad", "10000 urad"))
EXIT_CODES = {"PASS": 0, "ESTIMATED": 0, "MANUAL": 0, "FAIL": 1, "ABORTED": 3, "FAULT": 4}
FAULT = '\n[twin.fault]\naxis = "y"\nat = "11 s"\nkind = "fault"\n'
WANDER = ('bias_instability = "0.5 deg/h"', 'bias_instability = "25 deg/h"')


def bench_text(*others: tuple[str, str], fault: str = "") -> str:
    """The built-in bench with limits that a short script keeps; ``others`` replace what only its twins read."""
    text = default_bench_text()
    for old, new in LOOSE:
        assert old in text
        text = text.replace(old, new)
    rules, twins = text.split("[twin]\n")
    for old, new in others:
        assert old in twins
        twins = twins.replace(old, new)
    return f"{rules}[twin]\n{twins}{fault}"


def session(folder: Path, path: Path, bench: str, script: Script, options: RunOptions, stop_s: float = 0.0) -> None:
    """Run in virtual time, stopped after so many seconds, by hand for some."""
    (folder / "bench.toml").write_text(bench, encoding="utf-8")

    async def run() -> None:
        async with open_bench(load_bench(folder / "bench.toml")) as opened:
            going = Session(opened, script, path, options)
            loop = asyncio.get_running_loop()
            if options.manual:
                loop.call_later(4, lambda: going.drive("jog", {"axis": "z", "rate_rps": 0.2}))
                loop.call_later(10, lambda: going.drive("end", {}))
            elif stop_s:
                loop.call_later(stop_s, going.stop)
            await going.run()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of each outcome, named so, and one that passes with a bias that wanders."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "runs").mkdir()
    turns = "".join(TURN.format(axis) for axis in "zyx")
    (folder / "script.toml").write_text(f'name = "short"\n{REST}{turns}{REST}', encoding="utf-8")
    script, options = load_script(folder / "script.toml"), RunOptions(device_serial="SN-1")
    small = ('b = "0.1 deg/s"', 'b = "0.6 deg/s"')
    for name, text, stop_s in (
        ("PASS", bench_text(), 0.0),
        ("PASS-wander", bench_text(WANDER), 0.0),
        ("FAIL", bench_text(small), 0.0),
        ("ESTIMATED", re.sub(r"(?ms)^\[limits\].*?(?=^\[)", "", bench_text()), 0.0),
        ("FAULT", bench_text(fault=FAULT), 0.0),
        ("ABORTED", bench_text(), 14.5),
        ("ABORTED-early", bench_text(), 0.5),
    ):
        session(folder, folder / f"runs/{name}.h5", text, script, options, stop_s)
    manual = RunOptions(device_serial="SN-1", manual=True)
    session(folder, folder / "runs/MANUAL.h5", bench_text(), Script("manual", ()), manual)
    return folder / "runs"


@pytest.fixture(scope="module")
def written(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A copy of the runs into which their calibrations were written, and what was printed of it."""
    folder = tmp_path_factory.mktemp("written") / "runs"
    shutil.copytree(runs, folder)
    with redirect_stdout(StringIO()) as said:
        assert main(["calibrate", str(folder), "--write", "--jobs", "1"]) == 4
    return folder, said.getvalue()


@pytest.fixture
def folder(runs: Path, tmp_path: Path) -> Path:
    """A copy of the runs, that a test may write into."""
    shutil.copytree(runs, tmp_path / "runs")
    return tmp_path / "runs"


def asked(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, list[dict[str, Any]]]:
    code = main([*words, "--json"])
    return code, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def kept(path: Path) -> tuple[str, float | None]:
    """Return outcome and mean NIS as a recording has them."""
    with h5py.File(path) as file:
        nis = float(file["calibration"].attrs["nis_mean"]) if "calibration" in file else None
        return str(file.attrs["outcome"]), nis


def outcome_of(path: Path) -> str:
    return path.stem.partition("-")[0]


def test_the_runs_are_of_every_outcome(runs: Path) -> None:
    assert [kept(path)[0] for path in sorted(runs.iterdir())] == [outcome_of(path) for path in sorted(runs.iterdir())]
    assert {outcome_of(path) for path in runs.iterdir()} == set(EXIT_CODES)


@pytest.mark.parametrize(
    "name", ["ABORTED", "ABORTED-early", "ESTIMATED", "FAIL", "FAULT", "MANUAL", "PASS", "PASS-wander"]
)
def test_calibrate_says_how_the_run_ended_and_its_nis(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = folder / f"{name}.h5"
    outcome, nis = kept(path)
    code, (found,) = asked(capsys, "calibrate", str(path))
    assert found["outcome"] == outcome == outcome_of(path)
    assert code == EXIT_CODES[outcome]
    if nis is not None:
        assert found["nis_mean"] == nis
    assert main(["calibrate", str(path)]) == code
    printed = capsys.readouterr().out
    assert outcome in printed
    assert "PASS" not in printed.replace("PASS-wander.h5", "") or outcome == "PASS"
    if nis is not None:
        assert f"{nis:.3f}" in printed


def test_a_bias_that_wanders_does_not_make_two_figures_of_one_nis(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "PASS-wander.h5"
    with h5py.File(path) as file:
        sums = {key: sum(float(np.sum(own[key][()])) for own in file["innovation"].values()) for key in ("nis", "dof")}
    _, (found,) = asked(capsys, "calibrate", str(path))
    assert found["nis_mean"] == pytest.approx(sums["nis"] / sums["dof"], rel=1e-9)
    assert kept(path)[1] == found["nis_mean"]


def test_calibrate_history_report_and_the_folder_give_one_outcome_and_one_nis(
    written: tuple[Path, str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    folder, overview = written
    paths = sorted(folder.iterdir())
    code, objects = asked(capsys, "calibrate", str(folder), "--jobs", "1")
    assert code == 4
    _, (listed,) = asked(capsys, "history", str(folder))
    rows = {row["file"]: row for row in listed["recordings"]}
    for path, found in zip(paths, objects, strict=True):
        row = rows[path.name]
        assert found["outcome"] == row["outcome"] == outcome_of(path)
        assert row["nis_mean"] == found["nis_mean"]
        line = next(line for line in overview.splitlines() if f" {path.name} " in line)
        assert outcome_of(path) in line
        assert found["nis_mean"] is None or f"{found['nis_mean']:.3f}" in line
        if path.stem == "ABORTED-early":  # which holds nothing to report
            continue
        if path.stem != "PASS":  # one report has pictures of the live estimates, which take the most of its time
            with h5py.File(path, "r+") as file:
                file.pop("estimate", None)
        _, (told,) = asked(capsys, "report", str(path), "-o", str(tmp_path / f"{path.stem}.html"))
        assert told["outcome"] == outcome_of(path)
        if outcome_of(path) in ("PASS", "FAIL"):
            assert repr(found["nis_mean"]) in Path(told["html"]).read_text(encoding="utf-8")
    assert "2 PASS" in overview
    assert "2 ABORTED" in overview


def test_a_run_that_failed_is_no_pass_by_its_own_rules_and_told_of_by_others(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "PASS.h5"
    with h5py.File(path, "r+") as file:
        file.attrs.update({"outcome": "FAIL", "reason": "the table was off"})
    code, (found,) = asked(capsys, "calibrate", str(path))
    assert (code, found["outcome"]) == (1, "FAIL")
    assert "the table was off" in found["reason"]
    (tmp_path / "bench.toml").write_text(bench_text(), encoding="utf-8")
    code, (found,) = asked(capsys, "calibrate", str(path), "--bench", str(tmp_path / "bench.toml"))
    assert (code, found["outcome"]) == (0, "PASS")
    assert "the run itself failed: the table was off" in found["reason"]


def test_a_folder_is_compared_by_the_rule_of_history(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copy(folder / "PASS.h5", folder / "other.h5")
    with h5py.File(folder / "other.h5", "r+") as file:
        file.attrs["device_serial"] = "SN-2"
    with h5py.File(folder / "PASS-investigation.h5", "w") as file:
        file.attrs.update({"format": "turntable-investigation", "format_version": 1})
    for name in ("ABORTED", "ABORTED-early", "ESTIMATED", "FAULT", "MANUAL", "FAIL"):
        (folder / f"{name}.h5").unlink()
    assert main(["calibrate", str(folder), "--jobs", "1"]) == 0
    said = capsys.readouterr()
    assert said.out.count("Repeatability") == 1
    assert "Repeatability of SN-1 over 2 runs of short:" in said.out
    assert "1 of 3 recordings compared with no other" in said.out
    assert "skipped 1 file of the station that holds no recording: PASS-investigation.h5" in said.out
    assert "station:" not in said.err
    _, objects = asked(capsys, "calibrate", str(folder), "--jobs", "1")
    assert ["repeatability" in found for found in objects] == [False, True, False]
    assert main(["calibrate", str(folder / "PASS-investigation.h5")]) == 2  # named by itself it is a mistake


def test_one_line_a_recording_and_reasons_after_it(written: tuple[Path, str]) -> None:
    folder, overview = written
    lines = overview.partition("Repeatability")[0].splitlines()
    table = [line for line in lines if line.startswith("│")]
    recordings = list(folder.glob("*.h5"))  # the numbers of their documents lie beside them
    assert len(table) == len(recordings)
    assert all(any(f" {path.name} " in line and outcome_of(path) in line for line in table) for path in recordings)
    reasons = lines[lines.index(next(line for line in lines if line.startswith("└"))) + 1 :]
    assert any("ABORTED.h5: stopped by the operator" in line for line in reasons)
    assert len(reasons) < 25
