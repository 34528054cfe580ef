"""Files that strangers made are used or refused in a sentence: crafted ones, mutants, and what lies in the folder."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
from untrusted import CONTROL, KINDS, Kind, attempt, brief_recording, campaign, mutants

from drivers.tables.modbus.registers import ProfileError, load_profile
from estimator.errors import RecordingError
from estimator.recordings.reading import read_recording
from estimator.strict_toml import StrictTable
from estimator.untrusted import read_text
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.errors import BenchError, UsageError
from station.opening.twins import hidden_of
from station.render.terminal import stdout
from station.screen.archive.reading import read
from station.screen.sessions.programs import command_line

CRAFTED = Path(__file__).parents[1] / "data/untrusted"


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return brief_recording(tmp_path_factory.mktemp("untrusted") / "recording.h5")


# --- text files


@pytest.mark.parametrize("path", sorted(CRAFTED.glob("*.toml")), ids=lambda path: path.stem)
def test_a_crafted_bench_is_refused_in_a_line(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(path)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said[-1].startswith("station: ")
    assert len(said[-1]) < 1500
    assert not CONTROL.search("".join(said))


TOML = {
    "deep": "a = " + "[" * 50_000 + "]" * 50_000,
    "deep inline tables": "a = " + "{b = " * 20_000 + "1" + "}" * 20_000,
    "a key of 200,000 parts": "a." * 200_000 + "a = 1",
    "a heading of 200,000 parts": "[" + "a." * 200_000 + "a]",
    "an integer of 5,000 digits": "a = " + "1" * 5000,
    "blanks without end": 'a = "1 ' + " " * 300_000 + 'x"',
    "an escape sequence": 'a = "\\u001b[2J"',
    "an escape sequence as key": '"\\u009b2J" = 1',
    "text that turns round": 'a = "\\u202egpj"',
}


@pytest.mark.parametrize("text", TOML.values(), ids=TOML)
def test_toml_made_to_break_the_parser_is_refused_at_once(text: str) -> None:
    began = time.process_time()
    with pytest.raises(UsageError):
        StrictTable.parse(text, "x.toml", UsageError).number("a", 1.0)
    assert time.process_time() - began < 5


def test_a_number_too_large_for_a_float_is_refused_where_one_is_due() -> None:
    table = StrictTable.parse("a = " + "9" * 400, "x.toml", UsageError)
    with pytest.raises(UsageError, match=r"x\.toml, line 1: a"):
        table.number("a")


def test_a_byte_order_mark_and_lines_of_other_systems_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    path.write_bytes(b"\xef\xbb\xbf" + default_bench_text().replace("\n", "\r\n").encode())
    assert load_bench(path).name == "built-in twins"


def test_a_pipe_is_told_to_be_one(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "bench.toml")
    with pytest.raises(BenchError, match="is a pipe or a device"):
        load_bench(tmp_path / "bench.toml")
    with pytest.raises(BenchError, match="is a pipe or a device"):
        read_text(Path("/dev/zero"), BenchError)


def test_a_drive_profile_with_a_list_where_a_name_is_due_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "own.toml"
    path.write_text('name = "x"\nword_order = []\non_open = [{register = [], value = 1}]\nregisters = [1]\n')
    with pytest.raises(ProfileError):
        load_profile(str(path))


# --- HDF5


def external_link(file: h5py.File) -> None:
    del file["table/angle_rad"]
    file["table/angle_rad"] = h5py.ExternalLink("secret.h5", "/secret")


def virtual(file: h5py.File) -> None:
    n = len(file["table/t_ns"])
    del file["table/angle_rad"]
    layout = h5py.VirtualLayout((n, 3), "f8")
    layout[...] = h5py.VirtualSource("secret.h5", "secret", (n, 3))
    file.create_virtual_dataset("table/angle_rad", layout)


def external_storage(file: h5py.File) -> None:
    n = len(file["table/t_ns"])
    del file["table/angle_rad"]
    file.create_dataset("table/angle_rad", (n, 3), "f8", external=[("secret.h5", 0, n * 24)])


def huge(file: h5py.File) -> None:
    del file["table/angle_rad"]
    file.create_dataset("table/angle_rad", (400_000_000, 3), "f8", chunks=(100_000, 3))


def bomb(file: h5py.File) -> None:
    del file["table/angle_rad"]
    file.create_dataset(
        "table/angle_rad", (4_000_000_000, 3), "f8", chunks=(100_000, 3), compression="gzip", fillvalue=1
    )


ELSEWHERE: dict[str, Callable[[h5py.File], None]] = {
    "external link": external_link,
    "virtual dataset": virtual,
    "external storage": external_storage,
    "400 million rows": huge,
    "compressed": bomb,
}


@pytest.mark.parametrize("spoil", ELSEWHERE.values(), ids=ELSEWHERE)
def test_a_recording_that_leads_elsewhere_or_claims_too_much_is_refused(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[h5py.File], None]
) -> None:
    monkeypatch.chdir(tmp_path)
    with h5py.File("secret.h5", "w") as file:
        file["secret"] = np.zeros((100_000, 3))
    path = tmp_path / "recording.h5"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "r+") as file:
        spoil(file)
    with pytest.raises(RecordingError, match="in another file|claims to hold far more"):
        read_recording(path)
    assert "another file" in (wrong := read(path, 0.0, True).entry.wrong) or "far more" in wrong


def test_links_within_a_file_that_go_round_are_no_harm(recording: Path, tmp_path: Path) -> None:
    path = tmp_path / "recording.h5"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "r+") as file:
        file["table/round"] = file["/"]
        file["imu/array/itself"] = h5py.SoftLink("/imu/array/itself")
    assert read_recording(path).sources


def test_names_in_a_recording_do_not_steer_the_terminal(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "recording.h5"
    path.write_bytes(recording.read_bytes())
    with h5py.File(path, "r+") as file:
        file["imu/array"].attrs["names"] = (names := [f"\x1b[2Jg{i}\u202e\x9b31m" for i in range(4)])
        file.attrs["device_serial"] = "\x1b]0;owned\x07"
    shown = (*read_recording(path).sources["array"].array.names, read(path, 0.0, True).entry.serial)
    stdout().print(*names)
    said = capsys.readouterr().out
    assert not CONTROL.search(said + "".join(shown))
    assert "g0" in said


# --- mutants

QUICK = ("bench", "script", "hidden effects", "drive profile", "description", "CAN mapping", "import mapping", "CSV")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.name in QUICK], ids=lambda kind: kind.name)
def test_mutants_are_used_or_refused(kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    kind.beside(tmp_path)
    for name, content in mutants(kind, 5, 1, tmp_path):
        (tmp_path / kind.file).write_bytes(content)
        (tmp_path / "out.h5").unlink(missing_ok=True)
        for typed in kind.typed:
            assert not (ended := attempt(name, typed)).wrong, ended


@pytest.mark.full
@pytest.mark.timeout(900)
def test_mutants_of_every_kind_are_used_or_refused_for_ten_minutes() -> None:
    wrong = [ended for ended in campaign((), 2000, int(time.time()), until_s=600) if ended.wrong]
    assert not wrong, wrong[:20]


# --- what lies in the working folder


@pytest.fixture
def hostile(tmp_path: Path, recording: Path) -> Path:
    """Return a working folder whose modules leave a mark when they are imported."""
    mark = f"open({str(tmp_path / 'imported')!r}, 'a').write(__name__ + '\\n')\n"
    folder = tmp_path / "here"
    for package in ("station", "drivers", "estimator", "sims"):
        (folder / package).mkdir(parents=True)
        (folder / package / "__init__.py").write_text(mark)
    for module in ("h5py", "numpy", "json", "pickle", "tomllib", "textual", "struct", "socket", "pebble", "scipy"):
        (folder / f"{module}.py").write_text(mark)
    for name in ("one.h5", "two.h5"):
        (folder / name).write_bytes(recording.read_bytes())
    return folder


def typed_there(folder: Path, words: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=100, check=False)


SCRIPT = str(Path(sys.executable).with_name("station"))


def test_no_program_imports_from_the_working_folder(hostile: Path) -> None:
    done = typed_there(hostile, command_line(["export", "one.h5", "--format", "json"]))
    assert "holds no calibration" in done.stderr  # which the process that reads files first has found
    assert not (hostile.parent / "imported").exists(), (hostile.parent / "imported").read_text()


@pytest.mark.full
@pytest.mark.parametrize("start", [[SCRIPT], command_line([])], ids=["station", "child"])
def test_no_process_of_a_pool_imports_from_the_working_folder(hostile: Path, start: list[str]) -> None:
    for words in (["calibrate", "one.h5", "two.h5", "--json", "--jobs", "2"], ["study", "paper", "--seeds", "2"]):
        done = typed_there(hostile, [*start, *words])
        assert done.returncode == 0, done.stderr
    assert not (hostile.parent / "imported").exists(), (hostile.parent / "imported").read_text()


def test_a_driver_of_ones_own_that_fails_is_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = (Path(__file__).parents[2] / "docs/examples/counted_imu.py").read_text()
    failing = source.replace('name="counted"', 'name="failing"') + "\n\nasync def fail(self):\n    raise KeyError(7)\n"
    (tmp_path / "own.py").write_text(failing + "\n\nCountedImu.identify = fail\n")
    bench = default_bench_text().partition("[[imu]]")[0].replace("[site] ", 'plugins = ["own.py"]\n[site] ', 1)
    imu = '[[imu]]\nname = "a"\nprotocol = "failing"\narray = "triad"\nrate = "100 Hz"\n'
    imu += '[imu.datasheet]\narw = "0.01 deg/s/rtHz"\n'
    (tmp_path / "bench.toml").write_text(bench + imu)
    assert main(["check", str(tmp_path / "bench.toml")]) == 4
    assert "its driver failed (KeyError: 7)" in " ".join(capsys.readouterr().out.split())


def test_hidden_effects_of_a_device_that_is_not_there_are_refused(tmp_path: Path) -> None:
    bench = default_bench_text().replace("[twin]\n", '[twin]\nhidden = "hidden.toml"\n')
    (tmp_path / "bench.toml").write_text(bench)
    (tmp_path / "hidden.toml").write_text('devices = ["aray"]\n[latency]\ndelay = "1 ms"\n')
    with pytest.raises(BenchError, match=r"line 1: devices: 'aray' is not one of array, stim300; did you mean array"):
        hidden_of(load_bench(tmp_path / "bench.toml"))
