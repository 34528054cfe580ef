"""A command that is forked does what one that is started does, so that tests may be served by forks."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import forks
import pytest
from support import command, forked

REST = '[[step]]\nkind = "rest"\nduration = "2 s"\n'
Line = Callable[..., list[str]]


def ended(line: Line, folder: Path, *words: str, **environment: str) -> tuple[int, str, str]:
    """Return exit code, stdout and stderr of a command."""
    typed = "\n" * 60
    given = {**os.environ, **environment}
    done = subprocess.run(line(*words), input=typed, capture_output=True, text=True, cwd=folder, env=given, check=False)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("words", "environment"),
    [
        (["plan", "--script", "rest.toml"], {"COLUMNS": "60", "NO_COLOR": "1"}),
        (["runn"], {}),
        (["init", "bench.toml"], {}),
    ],
    ids=["plan", "no command", "init"],
)
def test_a_fork_says_what_a_new_process_says(tmp_path: Path, words: list[str], environment: dict[str, str]) -> None:
    said = []
    for line in (command, forked):
        folder = tmp_path / line.__name__
        folder.mkdir()
        (folder / "rest.toml").write_text(REST)
        said.append((ended(line, folder, *words, **environment), sorted(path.name for path in folder.iterdir())))
    assert said[0] == said[1]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_fork_is_ended_by_a_signal_as_a_new_process_is(tmp_path: Path, number: signal.Signals) -> None:
    codes = []
    for line in (command, forked):
        with subprocess.Popen(line("twin"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path) as twin:
            assert twin.stdout is not None
            while not json.loads(twin.stdout.readline()).get("ready"):
                pass
            twin.send_signal(number)
            twin.communicate(timeout=30)
            codes.append(twin.returncode)
    assert codes[0] == codes[1]


def test_what_is_no_command_of_the_station_is_started(tmp_path: Path) -> None:
    words = ["-c", "import sys; print(sys.argv, sys.orig_argv[1:])", "a", "-P"]
    said = [
        subprocess.run([python, *words], capture_output=True, text=True, check=True).stdout
        for python in (forks.PYTHON, forks.interpreter())
    ]
    assert said[0] == said[1]
