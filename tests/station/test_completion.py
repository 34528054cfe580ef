"""station --help and station completion: what a first-time user sees and types."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support import command, station

from station.cli import COMMANDS, main

HELP_S = 0.3


def test_help_comes_in_under_a_third_of_a_second() -> None:
    taken = []
    for _ in range(5):  # the least, and of the processor: other tests run beside this one
        before = os.times()
        subprocess.run(command("--help"), capture_output=True, check=True)
        after = os.times()
        spent = after.children_user - before.children_user + after.children_system - before.children_system
        taken.append(spent)
    assert min(taken) < HELP_S


def test_help_imports_none_of_the_heavy_libraries() -> None:
    code = (
        "import sys, station.cli\ntry:\n    station.cli.main(['--help'])\nexcept SystemExit:\n    print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.splitlines()[-1].split())
    heavy = {
        "numpy",
        "scipy",
        "h5py",
        "matplotlib",
        "rich",
        "textual",
        "pymodbus",
        "can",
        "cantools",
        "asyncio",
        "shtab",
    }
    assert not loaded & heavy


def test_help_lists_every_command_once_under_a_heading_with_what_it_does(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--help"])
    assert ended.value.code == 0
    said = capsys.readouterr().out
    commands = {name: said["line"] for name, said in COMMANDS.items()}
    listed = re.findall(r"^  ([a-z]+) {2,}(\S.*)$", said, re.MULTILINE)
    assert dict(listed) == commands
    assert len(listed) == len(commands)
    order = [said.index(f"\n  {name} ") for name in ("init", "check", "plan", "run", "calibrate", "export")]
    assert order == sorted(order)
    assert "more:" not in said  # every command has its place
    examples = re.findall(r"^  station ([a-z]+)", said.partition("examples:")[2], re.MULTILINE)
    assert len(examples) >= 5
    assert set(examples) <= set(commands)
    assert "exit codes" in said
    assert max(map(len, said.splitlines())) <= 120


def test_each_command_has_help_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    for name in COMMANDS:
        with pytest.raises(SystemExit) as ended:
            main([name, "--help"])
        assert ended.value.code == 0
        assert f"usage: station {name}" in capsys.readouterr().out


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish", "tcsh"])
def test_every_shell_gets_every_command(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell]) == 0
    script = capsys.readouterr().out
    assert all(name in script for name in COMMANDS)


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash here")
@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("che", ["check"]),
        ("export run.h5 --fo", ["--force", "--format"]),
        ("export run.h5 --format ka", ["kalibr"]),
        ("export ru", ["run.h5"]),
        ("run --bench be", ["bench.toml"]),
        ("completion z", ["zsh"]),
        ("loop --output re", ["recordings"]),
        ("study de", ["detection"]),
    ],
)
def test_bash_completes_commands_options_and_files(tmp_path: Path, typed: str, offered: list[str]) -> None:
    (tmp_path / "complete.bash").write_text(station("completion", "bash").stdout)
    for name in ("run.h5", "bench.toml"):
        (tmp_path / name).touch()
    (tmp_path / "recordings").mkdir()
    words = ["station", *typed.split(" ")]
    code = (
        f"source complete.bash; COMP_WORDS=({' '.join(words)}); COMP_CWORD={len(words) - 1}; "
        f'_shtab_station station {words[-1]} {words[-2]}; printf "%s\\n" "${{COMPREPLY[@]}}"'
    )
    done = subprocess.run(["bash", "-c", code], capture_output=True, text=True, cwd=tmp_path, check=False)
    assert sorted({line.strip().rstrip("/") for line in done.stdout.split("\n") if line.strip()}) == offered, (
        done.stderr
    )
