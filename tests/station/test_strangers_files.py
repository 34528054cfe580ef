"""What others made: plug-ins that others can change, expressions that do not end, texts that steer a terminal."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import h5py
import pytest
from support import changed, station

from station.bench.bench import default_bench_text
from station.cli import main

TRACE = "from pathlib import Path\nPath(__file__).with_name('ran').write_text('')\n"
EVIL = "Name\x1b[2J\u202etxt"
SCRIPT = '[[step]]\nkind = "rest"\nduration = "4 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "5 s"\n'
    for axis in "xyz"
)
PHONES = Path(__file__).parents[1] / "data" / "phones"


@pytest.fixture
def plugins(tmp_path: Path) -> Path:
    """A folder plugins/ with a file that tells that it ran, beside a bench."""
    (tmp_path / "bench.toml").write_text(default_bench_text())
    folder = tmp_path / "plugins"
    folder.mkdir(mode=0o755)
    (folder / "mine.py").write_text(TRACE)
    (folder / "mine.py").chmod(0o644)
    return folder


def planned(folder: Path, *options: str) -> tuple[int, str, bool]:
    """Return exit code of `station plan`, what it wrote to stderr, and whether the plug-in ran."""
    done = station(*options, "plan", "--bench", folder.parent / "bench.toml", timeout=30)
    return done.returncode, done.stderr, (folder / "ran").exists()


def test_a_plug_in_of_ones_own_is_loaded(plugins: Path) -> None:
    code, said, ran = planned(plugins)
    assert (code, ran) == (0, True), said


@pytest.mark.skipif(os.name != "posix", reason="rights are those of POSIX")
@pytest.mark.parametrize(
    "what",
    ["the file", "its folder", "a file of another", "a folder of another", "a folder above", "a link of another"],
)
def test_a_plug_in_that_others_can_change_is_not_run(plugins: Path, what: str) -> None:
    if "another" in what and os.geteuid() != 0:
        pytest.skip("only root can give a file away")
    target = plugins if "folder" in what else plugins / "mine.py"
    if what == "a folder above":
        target = plugins.parent
    elif what == "a link of another":  # to a script of one's own
        elsewhere = plugins.rename(plugins.with_name("elsewhere"))
        plugins.symlink_to(elsewhere)
        os.chown(plugins, 54321, 54321, follow_symlinks=False)
    elif "another" in what:
        os.chown(target, 54321, 54321)
    if "another" not in what:
        target.chmod(0o777)
    code, said, ran = planned(plugins)
    assert (code, ran) == (2, False)
    assert "mine.py" in said
    assert "its code would run with your rights" in said
    assert "--plugin" in said
    assert "Traceback" not in said


@pytest.mark.skipif(os.name != "posix", reason="rights are those of POSIX")
def test_a_plug_in_in_a_shared_folder_runs_once_the_operator_names_it(
    plugins: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugins.chmod(0o777)
    monkeypatch.setenv("STATION_PLUGINS", str(plugins / "mine.py"))
    code, said, ran = planned(plugins)
    assert (code, ran) == (0, True), said


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes have names on POSIX only")
def test_a_pipe_in_place_of_a_plug_in_is_told(plugins: Path) -> None:
    os.mkfifo(plugins / "pipe.py", 0o600)
    code, said, _ = planned(plugins)
    assert code == 2
    assert "pipe.py: it is a pipe" in said


def test_an_expression_that_does_not_end_is_told(tmp_path: Path) -> None:
    text = (PHONES / "mapping_iphone.toml").read_text()
    (tmp_path / "mapping.toml").write_text(
        changed(text, (r"_(?P<axis>[XYZ]?)G_[\d.]+_(?P<angle_deg>\d+)", "(a+)+(?P<axis>b)(?P<angle_deg>c)"))
    )
    file = tmp_path / f"{'a' * 60}.csv"
    shutil.copy(PHONES / "Iphone14pro_ZG_1_90_1.csv", file)
    done = station("import", tmp_path / "mapping.toml", file, "-o", tmp_path / "out.h5", timeout=60)
    assert done.returncode == 2
    assert "file_name" in done.stderr
    assert "takes more than" in done.stderr
    assert "Traceback" not in done.stderr


def marked(value: Any) -> Any:
    """Return a JSON value with something harmful behind each of its texts that is a phrase."""
    if isinstance(value, dict):
        return {key: marked(item) for key, item in value.items()}
    if isinstance(value, list):
        return [marked(item) for item in value]
    return f"{value} {EVIL}" if isinstance(value, str) and " " in value else value


@pytest.fixture(scope="module")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of a short run on the built-in twins."""
    folder = tmp_path_factory.mktemp("short")
    (folder / "script.toml").write_text(SCRIPT)
    recording = folder / "run.h5"
    assert main(["run", "--script", str(folder / "script.toml"), "--json", "--seed", "3", "-o", str(recording)]) == 1
    return recording


@pytest.fixture
def recording(short_run: Path, tmp_path: Path) -> Path:
    """Return a copy of the run to be changed."""
    return Path(shutil.copy(short_run, tmp_path))


def test_an_investigation_steers_no_terminal_and_turns_no_text_in_the_report(recording: Path, tmp_path: Path) -> None:
    found = tmp_path / "found.h5"
    assert main(["investigate", str(recording), "-o", str(found), "--most-effects", "1", "--json"]) == 0
    with h5py.File(found, "r+") as file:
        held = json.loads(file["investigation"].attrs["json"])
        file["investigation"].attrs["json"] = json.dumps(marked(held))  # spelt in six harmless letters each
    done = station("report", recording, "--investigation", found, "-o", tmp_path / "report.html")
    assert done.returncode == 0, done.stderr
    for text in (done.stdout, done.stderr, (tmp_path / "report.html").read_text(encoding="utf-8")):
        assert "\x1b" not in text
        assert "\u202e" not in text
    assert "[2J" in (tmp_path / "report.html").read_text(encoding="utf-8")


def test_what_a_recording_holds_steers_no_terminal_and_turns_no_text_in_its_report(
    recording: Path, tmp_path: Path
) -> None:
    with h5py.File(recording, "r+") as file:
        file.attrs["operator"] = EVIL
        file.attrs["reason"] = EVIL
        file.attrs["script_steps"] = [EVIL]
        file["events/text"][0] = EVIL.encode()
        file["steps/label"][0] = EVIL.encode()
    strange = tmp_path / "run\u202e\x1b.h5"
    recording.rename(strange)
    done = station("report", strange, "-o", tmp_path / "report.html")
    assert done.returncode == 0, done.stderr
    for text in (done.stdout, done.stderr, (tmp_path / "report.html").read_text(encoding="utf-8")):
        assert "\x1b" not in text
        assert "\u202e" not in text
    assert "[2J" in (tmp_path / "report.html").read_text(encoding="utf-8")
