"""A terminal of 80 columns shows every figure whole, in any command that prints a table of states."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
from pathlib import Path

import pytest
from support import command

from station.cli import main

COLUMNS = 80


def shown(words: list[str]) -> list[str]:
    """Return the lines that a command shows in a terminal of 80 columns."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color", "NO_COLOR": "1"}
    environment.pop("COLUMNS", None)
    with subprocess.Popen(words, stdin=slave, stdout=slave, stderr=slave, env=environment) as process:
        os.close(slave)
        said = b""
        while True:
            try:
                said += os.read(master, 65536)
            except OSError:
                break
            if not said:
                break
    os.close(master)
    assert process.returncode in (0, 1), said.decode()
    return re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said.decode()).replace("\r", "").split("\n")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a short script on the built-in twins, which fails: also that is shown."""
    folder = tmp_path_factory.mktemp("narrow")
    turn = '[[step]]\nkind = "rotate"\naxis = "{}"\nrate = "60 deg/s"\nacceleration = "50 deg/s2"\nduration = "6 s"\n'
    (folder / "short.toml").write_text('[[step]]\nkind = "rest"\nduration = "6 s"\n' + "".join(map(turn.format, "xyz")))
    assert main(["run", "--json", "--script", str(folder / "short.toml"), "-o", str(folder / "r.h5")]) == 1
    return folder / "r.h5"


@pytest.mark.parametrize("words", [("calibrate", "--details"), ("plan",)])
def test_no_figure_is_cut_at_80_columns(words: tuple[str, ...], recording: Path) -> None:
    files = [str(recording)] if words[0] == "calibrate" else []
    lines = shown(command(*words, *files))
    tables = [line for line in lines if "│" in line]
    assert len(tables) > 8
    assert not [line for line in lines if "…" in line]
    assert max(map(len, lines)) <= COLUMNS or any(str(recording) in line for line in lines)
    assert max(map(len, tables)) <= COLUMNS


def test_a_terminal_of_ascii_alone_gets_other_letters(recording: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command("calibrate", str(recording)), capture_output=True, text=True, env=environment)
    assert done.returncode == 1, done.stderr
    assert "+-" in done.stdout
    assert "Traceback" not in done.stderr


def test_an_output_that_cannot_be_written_is_told_before_the_work(
    recording: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["investigate", str(recording), "-o"], ["report", str(recording), "-o"]):
        assert main([*words, "/proc/x.html"]) == 2
        told = capsys.readouterr()
        assert "/proc/x.html cannot be written" in told.err
        assert "%" not in told.err  # no progress of work that is for nothing
