"""The program of the bench file that is given the result of each run."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from station.bench.bench import default_bench_text
from station.cli import main
from station.remote.after_run import tell_program

SCRIPT = '[[step]]\nkind = "rest"\nduration = "9 s"\n'


def _run(folder: Path, *command: str) -> int:
    """Run a short script on a bench whose after_run is the command; the recording is run.h5."""
    (folder / "bench.toml").write_text(f"[station]\nafter_run = {json.dumps(command)}\n{default_bench_text()}")
    (folder / "script.toml").write_text(SCRIPT)
    bench, script, output = (str(folder / name) for name in ("bench.toml", "script.toml", "run.h5"))
    return main(["run", "--bench", bench, "--script", script, "-o", output])


def test_the_program_beside_the_bench_file_is_given_the_result(tmp_path: Path) -> None:
    program = tmp_path / "tell"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nopen({str(tmp_path / 'told')!r}, 'w').write(sys.stdin.read())\n"
    )
    program.chmod(0o755)
    code = _run(tmp_path, "./tell")
    told = json.loads((tmp_path / "told").read_text())
    assert told["recording"] == str(tmp_path / "run.h5")
    assert told["outcome"] in ("PASS", "FAIL", "ESTIMATED")
    assert code == {"PASS": 0, "ESTIMATED": 0, "FAIL": 1}[told["outcome"]]
    assert {"bench", "script", "operator", "serial_number", "gyros", "nis_mean", "links"} <= told.keys()


def test_a_program_that_fails_changes_no_result_and_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = _run(tmp_path, sys.executable, "-c", "raise SystemExit('no line 3')")
    said = capsys.readouterr().err
    assert "after_run" in said
    assert "exit code 1: no line 3" in said
    assert code in (0, 1)
    assert (tmp_path / "run.h5").is_file()


def test_a_program_that_is_missing_or_does_not_end_is_told() -> None:
    assert "could not be started: No such file" in tell_program(["/nowhere/tell"], {})
    assert "did not end within 0.2 s" in tell_program(["sleep", "60"], {}, limit_s=0.2)
