"""A terminal of 80 columns shows every figure whole, in any command that prints a table of states."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import shutil
import struct
import subprocess
import termios
from pathlib import Path

import h5py
import pyte
import pytest
from support import command, forked

from station.cli import main

COLUMNS = 80


def written(words: list[str], folder: Path | None = None) -> bytes:
    """Return what a command, begun in a folder, writes to a terminal of 80 columns."""
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, COLUMNS, 0, 0))
    environment = {**os.environ, "TERM": "xterm-256color", "NO_COLOR": "1"}
    environment.pop("COLUMNS", None)
    with subprocess.Popen(words, stdin=slave, stdout=slave, stderr=slave, env=environment, cwd=folder) as process:
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
    assert process.returncode in (0, 1, 2), said.decode()
    return said


def shown(words: list[str], folder: Path | None = None) -> list[str]:
    """Return the lines that a command, begun in a folder, shows in a terminal of 80 columns."""
    said = written(words, folder)
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said.decode())
    # What is before the last return on a line was written over: a bar that went on.
    return [line.rstrip("\r").rpartition("\r")[2] for line in plain.split("\n")]


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
    lines = shown(forked(*words, *files))
    tables = [line for line in lines if "│" in line]
    assert len(tables) > 8
    assert not [line for line in lines if "…" in line]
    assert max(map(len, lines)) <= COLUMNS or any(str(recording) in line for line in lines)
    assert max(map(len, tables)) <= COLUMNS


@pytest.fixture(scope="module")
def folder(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with runs of two benches and two scripts, and a file that is none."""
    folder = tmp_path_factory.mktemp("folder")
    for number, (script, bench) in enumerate([("paper-360s", "bench 1"), ("short", "bench 2")]):
        path = folder / f"run-20261121-10150{number}.h5"
        shutil.copy(recording, path)
        with h5py.File(path, "r+") as file:
            file.attrs.update({"script": script, "station": bench, "device_serial": "SN-0042"})
    (folder / "note.h5").write_text("no recording")
    return folder


@pytest.mark.parametrize(
    "words",
    [
        "history",
        "history . --serial SN-0042",
        "export run-20261121-101500.h5 --all out --details",
        "report run-20261121-101500.h5 -o r.html",
        "calibrate . --jobs 1",
        "calibrate note.h5",
        "run --bench run-20261121-101500.h5",
        "run -o run-20261121-101500.h5",
    ],
)
def test_no_line_is_longer_than_a_terminal(words: str, folder: Path) -> None:
    name, *others = words.split()
    lines = shown(forked(name, *(others or ["."])), folder)
    for line in lines:
        assert len(line) <= COLUMNS, line


def test_a_recording_is_one_line_of_the_history_with_its_date_and_names_whole(folder: Path) -> None:
    screen = pyte.Screen(COLUMNS, 24)
    pyte.ByteStream(screen).feed(written(forked("history", "."), folder))
    lines = [line.rstrip() for line in screen.display]
    for script, name in (("paper-360s", "run-20261121-101500.h5"), ("short", "run-20261121-101501.h5")):
        (line,) = [line for line in lines if name in line]
        assert re.match(r"\d{4}-\d\d-\d\d \d\d:\d\d ", line)
        assert {"SN-0042", "FAIL", script, name} <= set(line.split())
    (line,) = [line for line in lines if "UNREADABLE" in line]
    assert line.split()[-1] == "note.h5"
    assert not [line for line in lines if "reading" in line]


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
