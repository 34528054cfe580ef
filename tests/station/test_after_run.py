"""The program of the bench file that is given the result of each run."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from support import forked

from station.bench.bench import default_bench_text
from station.cli import main
from station.remote.after_run import tell_program

SCRIPT = '[[step]]\nkind = "rest"\nduration = "9 s"\n'


def _bench(folder: Path, *after_run: str) -> str:
    """Write a bench whose after_run is a command, and a short script beside it; return the name of the bench file."""
    (folder / "bench.toml").write_text(f"[station]\nafter_run = {json.dumps(after_run)}\n{default_bench_text()}")
    (folder / "script.toml").write_text(SCRIPT)
    return str(folder / "bench.toml")


def _run(folder: Path, *after_run: str) -> int:
    """Run a short script on a bench whose after_run is a command; the recording is run.h5."""
    bench = _bench(folder, *after_run)
    return main(["run", "--bench", bench, "--script", str(folder / "script.toml"), "-o", str(folder / "run.h5")])


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


def test_what_a_program_leaves_running_is_not_waited_for() -> None:
    assert tell_program(["sh", "-c", "sleep 60 & exit 0"], {}, limit_s=30.0) == ""


def test_the_result_is_told_before_the_program_has_ended(tmp_path: Path) -> None:
    waits = "import os, sys, time; open('begun', 'w').close()\nwhile not os.path.exists('seen'): time.sleep(0.01)"
    bench = _bench(tmp_path, sys.executable, "-c", waits)
    words = forked("run", "--bench", bench, "--script", "script.toml", "-o", "run.h5")
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as run:
        assert run.stdout is not None
        lines = [next(run.stdout)]
        while "more: --details" not in lines[-1]:
            lines.append(next(run.stdout))
        assert run.poll() is None
        (tmp_path / "seen").touch()
        told = run.stderr.read() if run.stderr is not None else ""
    assert "after_run" not in told
    assert run.returncode in (0, 1)
