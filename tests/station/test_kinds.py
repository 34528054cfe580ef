"""A kind of device of one's own: a chamber that is installed, driven in a run, recorded, and left in a safe state."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import TwinProcess, command

from estimator.recordings.reading import read_recording
from station.bench.bench import default_bench_text, load_bench
from station.cli import main
from station.opening import open_bench
from station.run.guard.guard import guard_log_of
from station.scripts.script import load_script

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "climate_chamber.py"
CHAMBER = """
[[chamber]]
protocol = "espec"
temperature = "27 degC"
within = 2
"""
SCRIPT = """
name = "one turn"
[[step]]
kind = "rest"
duration = "4 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "20 deg/s"
duration = "12 s"
"""
LONG = SCRIPT.replace("12 s", "120 s").replace("4 s", "1 s")
IN_REAL_TIME = LONG.replace("120 s", "40 s")  # its step is told after a tenth of it
_WAIT_S = 30.0


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which pip has installed the example as a package that announces its kind."""
    folder = tmp_path_factory.mktemp("chamber")
    about = "chambers-1.0.dist-info"
    files = {
        EXAMPLE.name: EXAMPLE.read_text(),
        f"{about}/METADATA": "Metadata-Version: 2.1\nName: chambers\nVersion: 1.0\n",
        f"{about}/WHEEL": "Wheel-Version: 1.0\nGenerator: hand\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{about}/entry_points.txt": "[turntable_station.kinds]\nchamber = climate_chamber:KIND\n",
    }
    files[f"{about}/RECORD"] = "".join(f"{name},,\n" for name in files)
    wheel = folder / "chambers-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--no-compile"]
    subprocess.run([*pip, "--target", str(folder / "site"), str(wheel)], check=True, timeout=60)
    return folder / "site"


@pytest.fixture
def place(site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a bench that has a chamber, and scripts; the package is installed for this and other processes."""
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.setenv("PYTHONPATH", str(site))
    (tmp_path / "bench.toml").write_text(default_bench_text() + CHAMBER)
    (tmp_path / "script.toml").write_text(SCRIPT)
    (tmp_path / "real-time.toml").write_text(IN_REAL_TIME)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*more: str) -> int:
    return main(["run", "--bench", "bench.toml", "--script", "script.toml", "-o", "run.h5", "--json", *more])


def test_an_installed_chamber_is_brought_to_temperature_before_the_script_and_recorded(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run()
    recording = read_recording("run.h5")
    series = recording.series["chamber"]
    assert series.units == {"temperature_c": "degC", "set_point_c": "degC"}
    with h5py.File("run.h5") as file:
        began_ns = file["steps/t_start_ns"][0]
        assert file["device/chamber/temperature_c"].attrs["units"] == "degC"
        assert file["device/chamber"].attrs["model"] == "ESPEC T,T,S2,160.0"
        assert list(file.attrs["plugins"]) == ["the package chambers 1.0"]
        assert "chamber: it goes to 25 degC" in file["events/text"].asstr()[()]
    within = series.t_ns >= began_ns
    assert 14 <= within.sum() <= 18  # a row a second of the script
    assert np.abs(series.columns["temperature_c"][within] - 27).max() <= 2
    assert series.columns["temperature_c"][0] == 23.0  # where it was
    assert set(series.columns["set_point_c"][within]) == {27.0}
    told = json.loads(capsys.readouterr().out)
    assert told["links"]["chamber"]["timeouts"] == 0
    assert main(["export", "run.h5", "--series", "chamber"]) == 0
    heading, first, *others = capsys.readouterr().out.splitlines()
    assert heading == "t_s,temperature_c (degC),set_point_c (degC)"
    assert first.startswith(f"{series.t_ns[0] * 1e-9:.9f},23.0,")
    assert len(others) == len(series.t_ns) - 1
    assert main(["export", "run.h5", "--series", "oven"]) == 2
    assert "--series oven" in capsys.readouterr().err


def test_a_chamber_is_checked_without_being_told_anything(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "bench.toml", "--json"]) == 0
    *_, chamber = json.loads(capsys.readouterr().out)["devices"]
    assert (chamber["device"], chamber["kind"], chamber["experimental"]) == ("chamber", "espec", True)
    assert chamber["values"] == {"temperature_c": 23.0, "set_point_c": 23.0}


def test_a_set_point_that_a_device_would_refuse_ends_the_run_before_anything_moves(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "bench.toml").write_text(default_bench_text() + CHAMBER.replace("27", "170"))
    assert main(["check", "bench.toml"]) == 4
    assert "chamber: 170 degC is beyond its limits of -60 and 150 degC" in capsys.readouterr().out
    assert run() == 4
    assert "170 degC is beyond its limits" in json.loads(capsys.readouterr().out)["reason"]
    with h5py.File("run.h5") as file:
        assert "table" not in [name for name in file if len(file[name])]
        assert "steps" not in file


def test_a_link_that_is_lost_before_the_script_is_opened_again(place: Path) -> None:
    fault = '\n[twin.chamber.fault]\nunplug = "6 s"\nreplug = "9 s"\n'
    (place / "bench.toml").write_text(default_bench_text() + CHAMBER + fault)
    run()
    series = read_recording("run.h5").series["chamber"]
    assert abs(series.columns["temperature_c"][-1] - 27) <= 2
    with h5py.File("run.h5") as file:
        events = list(file["events/text"].asstr()[()])
        assert file["device/chamber"].attrs["link_opened"] == 2
    reopened = [text for text in events if text.startswith("chamber: reopened after")]
    assert len(reopened) == 1
    assert events.index(reopened[0]) < events.index("script begins")


def test_a_lost_link_in_a_turn_ends_the_run_and_leaves_table_and_chamber_safe(
    place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place / "script.toml").write_text(LONG)
    fault = '\n[twin.chamber.fault]\nunplug = "60 s"\nreplug = "63 s"\n'
    (place / "bench.toml").write_text(default_bench_text() + CHAMBER + fault)
    assert run() == 4
    told = json.loads(capsys.readouterr().out)
    assert told["reason"].startswith("chamber:")
    with h5py.File("run.h5") as file:
        events = list(file["events/text"].asstr()[()])
    assert events.index("table at rest") < events.index("chamber: it goes to 25 degC")


def ask(link: str, line: str) -> str:
    """Return what a chamber answers, asked by another than the station."""
    host, _, port = link.removeprefix("tcp://").partition(":")
    with socket.create_connection((host, int(port)), timeout=5) as connection:
        connection.sendall(f"{line}\r\n".encode())
        return connection.makefile("r", newline="\n").readline().strip()


@contextmanager
def under_way(place: Path, twins: TwinProcess, name: str) -> Iterator[subprocess.Popen[bytes]]:
    """A run on twins in another process, in real time, whose script has begun: the chamber was sent to 27 degC."""
    links = twins.options("table", "array", "chamber")
    words = ["run", "--bench", "bench.toml", *links, "--script", "real-time.toml", "-o", f"{name}.h5"]
    said = place / name
    with said.open("wb") as output:
        process = subprocess.Popen(command(*words), stdout=output, stderr=output, cwd=place, start_new_session=True)
    try:
        waited(lambda: b"x at 20 deg/s" in said.read_bytes() or process.poll() is not None)
        assert process.poll() is None, said.read_text()
        assert set_point_of(twins) == "27.0"
        yield process
    finally:
        process.kill()
        process.wait()


def set_point_of(twins: TwinProcess) -> str:
    """Return the temperature in degC that the chamber was told to go to."""
    return ask(twins.links["chamber"], "TEMP?").split(", ")[1]


def waited(done: Callable[[], bool]) -> None:
    until = time.monotonic() + _WAIT_S
    while not done():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_after_ctrl_c_the_chamber_is_safe_and_after_kill_9_the_guard_makes_it_so_once_the_table_stands(
    place: Path,
) -> None:
    (place / "bench.toml").write_text(default_bench_text() + CHAMBER.replace("within = 2", "within = 5"))
    with TwinProcess("--bench", place / "bench.toml") as twins:
        with under_way(place, twins, "stopped") as process:
            process.send_signal(signal.SIGINT)
            assert process.wait(_WAIT_S) == 3
            assert set_point_of(twins) == "25.0"
            assert not guard_log_of(place / "stopped.h5").exists()
        with under_way(place, twins, "killed") as process:
            os.kill(process.pid, signal.SIGKILL)
            log = guard_log_of(place / "killed.h5")
            waited(lambda: log.exists() and "it goes to 25 degC" in log.read_text())
            lines = log.read_text().splitlines()
            assert "the table is at rest, its power off" in lines[1]
            assert "it goes to 25 degC" in lines[2]
            assert set_point_of(twins) == "25.0"


def test_the_guard_can_make_devices_of_a_file_that_the_script_brings_as_well(tmp_path: Path) -> None:
    (tmp_path / EXAMPLE.name).write_text(EXAMPLE.read_text())
    link = CHAMBER.replace('"espec"', '"espec"\nlink = "tcp://127.0.0.1:9"')
    (tmp_path / "bench.toml").write_text(f'plugins = ["{EXAMPLE.name}"]\n{default_bench_text()}{link}')
    (tmp_path / "script.toml").write_text(SCRIPT)
    bench = load_bench(tmp_path / "bench.toml")
    load_script(tmp_path / "script.toml", bench.plugin_files)  # the file of the bench once more

    async def packed() -> list[bytes]:
        async with open_bench(bench) as opened:
            assert opened.guarded is not None
            return list(opened.guarded.packed)

    new = "import sys; from drivers.recipe import unpacked_device as made; print(made(sys.stdin.buffer.read())[0].name)"
    for data in asyncio.run(packed()):
        made = subprocess.run([sys.executable, "-c", new], input=data, capture_output=True, check=True)
        assert made.stdout.decode().strip() == "chamber"


SUPPLY = """
    columns = {"supply_v": "V"}

    async def rows(self):
        loop = asyncio.get_running_loop()
        while True:
            yield round(loop.time() * 1e9), (5.0,)
            await asyncio.sleep(2.0)

    def flush("""


def test_a_device_under_test_may_append_a_series_as_well(tmp_path: Path) -> None:
    text = (EXAMPLE.parent / "counted_imu.py").read_text()
    (tmp_path / "mine.py").write_text(text.replace("    def flush(", SUPPLY.lstrip("\n")))
    head, _, tail = default_bench_text().partition("[[imu]]")
    imu = '[[imu]]\nname = "mine"\nprotocol = "counted"\narray = "triad"\nrate = "50 Hz"\n'
    sheet = '[imu.datasheet]\narw = "0.005 deg/s/rtHz"\n[undeclared]\neffects = "none"\n'
    (tmp_path / "bench.toml").write_text(f'plugins = ["mine.py"]\n{head}{imu}{sheet}')
    (tmp_path / "script.toml").write_text(SCRIPT)
    words = ["--bench", tmp_path / "bench.toml", "--script", tmp_path / "script.toml", "-o", tmp_path / "run.h5"]
    main(["run", *map(str, words)])
    series = read_recording(tmp_path / "run.h5").series["mine"]
    assert series.units == {"supply_v": "V"}
    assert len(series.t_ns) >= 8  # one every two seconds
    assert set(series.columns["supply_v"]) == {5.0}


def test_init_asks_for_the_devices_of_an_installed_kind(place: Path) -> None:
    proposals = [""] * 25  # the table and its axes, a device under test
    answers = ["Lab", *proposals, "no", "yes", "", "", "35 degC", "no"]
    asked = subprocess.run(
        command("init", "mine.toml"),
        input="\n".join([*answers, *[""] * 20]),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert asked.returncode == 0, asked.stdout + asked.stderr
    assert "Is the chamber on this bench?" in asked.stdout
    bench = load_bench(place / "mine.toml")
    (chamber,) = bench.others
    assert (chamber.kind.name, chamber.spec.name, chamber.link) == ("chamber", "espec", "twin:")
    assert chamber.settings["temperature"] == 35.0
    assert "# where a run is made" in bench.text
    assert main(["check", "mine.toml", "--json"]) == 0


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (CHAMBER, "'chamber' is already used as a name"),
        (CHAMBER + 'name = "array"\n', "'array' is already used as a name"),
        (CHAMBER + 'name = "a/b"\n', "begin with a letter"),
        (CHAMBER + 'name = "two"\nwithin = -1\n', "within: must be above zero"),
        (CHAMBER.replace("espec", "espek") + 'name = "two"\n', "'espek' is not one of espec"),
    ],
)
def test_a_section_that_cannot_be_is_refused(
    place: Path, capsys: pytest.CaptureFixture[str], more: str, told: str
) -> None:
    (place / "bench.toml").write_text(default_bench_text() + CHAMBER + more.replace("within = 2\n", ""))
    assert run() == 2
    assert told in json.loads(capsys.readouterr().out)["reason"]


def test_a_new_kind_is_one_file_of_150_lines_and_nothing_elsewhere() -> None:
    assert len(EXAMPLE.read_text().splitlines()) <= 150
    root = EXAMPLE.parents[2]
    modules = [path for package in ("station", "drivers", "sims") for path in (root / package).rglob("*.py")]
    assert len(modules) > 200
    assert [str(path) for path in modules if re.search("[^m]espec|climate|kind.*chamber", path.read_text())] == []
