"""station init: bench files that load, whatever is answered, and run as they are."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import product
from pathlib import Path

import pytest
from support import command, ctrl_c_of_children, forked

from drivers.imus.registry import IMUS
from drivers.tables.registry import TABLES
from station.bench.bench import load_bench
from station.cli import main


def init(*arguments: str | Path) -> int:
    return main(["init", *map(str, arguments)])


def answered(folder: Path, *answers: str, options: tuple[str, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Answer the questions through a pipe."""
    typed = "\n".join(answers) + "\n"
    arguments = forked("init", "bench.toml", *options)
    return subprocess.run(arguments, input=typed, capture_output=True, text=True, cwd=folder, timeout=60, check=False)


@pytest.mark.parametrize(("table", "imu"), product(TABLES, IMUS))
def test_every_table_with_every_imu_gives_a_file_that_loads(tmp_path: Path, table: str, imu: str) -> None:
    path = tmp_path / "new" / "my bench.toml"
    assert init(path, "--defaults", "--table", table, "--imu", imu) == 0
    bench = load_bench(path)
    assert bench.table.protocol == table
    assert [one.protocol for one in bench.imus] == [imu]
    assert "#" in bench.text
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    ("table", "imus"),
    [("modbus", ["can"]), ("galil", ["stim300", "xsens"]), ("acutrol", ["vectornav"]), ("aerosmith", ["j1939"])],
)
def test_what_it_writes_runs_on_twins_as_it_is(
    tmp_path: Path, table: str, imus: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bench.toml"
    assert init(path, "--defaults", "--table", table, *(word for imu in imus for word in ("--imu", imu))) == 0
    said = capsys.readouterr().out
    assert f"station check {path}" in said
    assert f"station run --bench {path}" in said
    assert main(["check", str(path), "--json"]) == 0
    devices = json.loads(capsys.readouterr().out)["devices"]
    assert len(devices) == 1 + len(imus)
    assert not any(device["wrong"] for device in devices)


def test_links_given_as_options_are_in_the_file_and_the_rest_are_twins(tmp_path: Path) -> None:
    path = tmp_path / "bench.toml"
    options = ("--table", "galil", "--table-link", "tcp://10.0.0.2", "--imu", "stim300", "--imu", "stim300")
    assert init(path, "--defaults", *options, "--imu-link", "serial:///dev/ttyUSB1?baud=921600") == 0
    bench = load_bench(path)
    assert bench.table.link == "tcp://10.0.0.2"
    links = {imu.name: imu.link for imu in bench.imus}
    assert links == {"stim300": "serial:///dev/ttyUSB1?baud=921600", "stim300_2": "twin:"}
    assert bench.site is None  # where the hardware stands nobody has said


def test_answers_are_checked_at_once_and_asked_again(tmp_path: Path) -> None:
    done = answered(
        tmp_path,
        "Lab 3", "galil", "serial:///dev/ttyUSB0?bud=1", "tcp://[::1", "tcp://10.0.0.2", "z z", "z y x",
        "Q", "A", "1.5", "1296000", "100", "60 deg/s", "20 deg/s2", "-90 deg, 90 deg",
        "", "", "", "", "", "", "", "", "", "-",
        "stim", "a/b", "unit", "", "600 Hz", "1000 Hz", "", "", "no",
        "95 deg", "48.1 deg", "", "", "", "", "", "", "", "[", "[A-Z]{2}", "",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    for reproach in (
        "has unknown options",
        "'tcp://[::1' is not a link",
        "named twice",
        "'Q' is not one of A",
        "whole number",
        "'100': a unit is missing",
        "letters, digits",
        "125, 250, 500, 1000, 2000 Hz",
        "beyond the poles",
        "regular expression",
    ):
        assert reproach in done.stdout, reproach
    bench = load_bench(tmp_path / "bench.toml")
    assert bench.name == "Lab 3"
    assert {name: axis.address for name, axis in bench.table.axes.items()} == {"z": "A", "y": "B", "x": "C"}
    assert [axis.counts_per_turn for axis in bench.table.axes.values()] == [1296000] * 3
    assert bench.table.axes["z"].limits.rate_rps == pytest.approx(1.0471975512)
    assert bench.table.axes["y"].limits.travel_rad == bench.table.axes["z"].limits.travel_rad
    assert bench.table.axes["x"].limits.travel_rad is None
    assert bench.imus[0].name == "unit"
    assert bench.imus[0].rate_hz == 1000
    assert bench.operator_pattern == "[A-Z]{2}"
    assert bench.site is not None
    assert "Traceback" not in done.stderr


def test_gyros_on_can_may_lie_anyhow_and_be_any_signals(tmp_path: Path) -> None:
    dbc = tmp_path / "five.dbc"
    lines = (
        "BO_ {} RATE{}: 8 NODE",
        ' SG_ Rate : 0|16@1- (0.01,0) [0|0] "deg/s" X',
        ' SG_ T : 16|8@1- (1,0) [0|0] "degC" X',
    )
    messages = "".join("\n".join(lines).format(100 + n, n) + "\n\n" for n in range(5))
    dbc.write_text(f'VERSION ""\n\nNS_ :\n\nBS_:\n\nBU_: NODE X\n\n{messages}')
    signals = [word for n in range(5) for word in (f"RATE{n}.Rate", f"RATE{n}.T" if n else "-")]
    start = ["", "modbus", "", "", "", *[""] * 15]
    done = answered(
        tmp_path,
        *start,
        "can", "", "", "cone", "2", "5", "54.7 deg", "", "none.dbc", "five.dbc", "RATE9.Rate", *signals,
        "", "", "", "no", *[""] * 12,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    for reproach in ("3 to 64", "has 4 gyros", "is not a valid DBC file", "not a signal of five.dbc"):
        assert reproach in done.stdout, reproach
    (imu,) = load_bench(tmp_path / "bench.toml").imus
    assert len(imu.array) == 5
    assert imu.can is not None
    assert [channel.temperature for channel in imu.can.channels] == [None, *(f"RATE{n}.T" for n in range(1, 5))]
    (tmp_path / "bench.toml").unlink()
    axes = ["axes", "3", "0 0 0", "1 1 0", "0 1 0", "0 0 2", ""]
    assert answered(tmp_path, *start, "can", "", "", *axes, "", "", "", "no", *[""] * 12).returncode == 0
    (imu,) = load_bench(tmp_path / "bench.toml").imus
    assert imu.array.p[0] == pytest.approx([0.5**0.5, 0.5**0.5, 0])


def test_what_a_data_sheet_does_not_state_is_left_out(tmp_path: Path) -> None:
    answers = ["", "modbus", *[""] * 18, "stim300", "", "", "", "-", "", "-", "no", *[""] * 12]
    done = answered(tmp_path, *answers)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "arw is missing" in done.stdout
    (imu,) = load_bench(tmp_path / "bench.toml").imus
    assert imu.noise.instability == 0.0
    assert main(["check", str(tmp_path / "bench.toml"), "--json"]) == 0


def test_a_file_that_is_there_is_not_written_over_unasked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bench.toml"
    path.write_text("mine")
    assert init(path, "--defaults") == 2
    assert "--force" in capsys.readouterr().err
    assert answered(tmp_path, "no").returncode == 2
    assert answered(tmp_path, "").returncode == 2
    assert path.read_text() == "mine"
    assert answered(tmp_path, "yes", *[""] * 60).returncode == 0
    assert load_bench(path).table.protocol == "modbus"
    assert init(path, "--defaults", "--table", "galil", "--force") == 0
    assert load_bench(path).table.protocol == "galil"


def test_answers_that_end_too_soon_leave_nothing(tmp_path: Path) -> None:
    done = answered(tmp_path, "", "galil", "")
    assert done.returncode == 3
    assert "nothing was written" in done.stderr
    assert not list(tmp_path.iterdir())


def test_without_a_stdin_it_ends_as_without_answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", None)  # as Python has it where it was closed
    assert init(tmp_path / "bench.toml") == 3
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")
def test_ctrl_c_in_a_terminal_leaves_nothing(tmp_path: Path) -> None:
    near, far = pty.openpty()
    with ctrl_c_of_children():
        started = subprocess.Popen(
            command("init", "bench.toml"), stdin=far, stdout=far, stderr=far, cwd=tmp_path, start_new_session=True
        )
    os.close(far)
    try:
        seen = b""
        while b"name of the bench" not in seen:
            seen += os.read(near, 4096)
        for _ in range(
            20
        ):  # a signal between prompt and reading is seen with the next one, as a person would press again
            started.send_signal(signal.SIGINT)
            with suppress(subprocess.TimeoutExpired):
                started.wait(2)
                break
        assert started.returncode == 3
    finally:
        started.kill()
        started.wait()
    rest = b""
    with suppress(OSError):  # the terminal is closed
        while chunk := os.read(near, 4096):
            rest += chunk
    os.close(near)
    assert b"nothing was written" in rest
    assert b"Traceback" not in rest
    assert not list(tmp_path.iterdir())


def test_bad_options_and_places_are_refused_before_anything_is_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_questions(prompt: str) -> str:
        raise AssertionError(prompt)

    monkeypatch.setattr("builtins.input", no_questions)
    (tmp_path / "file").write_text("")

    def refused(*arguments: str | Path) -> str:
        assert init(*arguments) == 2
        return capsys.readouterr().err

    assert "is a folder" in refused(tmp_path)
    assert "is not writable" in refused(tmp_path / "file" / "bench.toml")
    assert "modbus, galil" in refused(tmp_path / "b.toml", "--table", "kuka")
    assert "stim300" in refused(tmp_path / "b.toml", "--imu", "mpu6050")
    assert "--imu-link" in refused(tmp_path / "b.toml", "--imu-link", "twin:", "--imu-link", "twin:")
    bad = ("--defaults", "--imu", "stim300", "--imu-link", "serial:/x?bad=1")
    assert "has unknown options" in refused(tmp_path / "b.toml", *bad)
    assert not (tmp_path / "b.toml").exists()


@pytest.mark.skipif(sys.platform == "win32", reason="locales of POSIX")
def test_it_works_without_colours_and_in_another_locale(tmp_path: Path) -> None:
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "NO_COLOR": "1", "TERM": "dumb"}
    typed = b"Pr\xc3\xbcfstand \xff\nbench 1\n" + b"\n" * 60
    done = subprocess.run(
        command("init", "bench.toml"), input=typed, capture_output=True, cwd=tmp_path, env=environment, check=False
    )
    assert done.returncode == 0, done.stderr
    assert b"\x1b" not in done.stdout
    assert b"Traceback" not in done.stderr
    load_bench(tmp_path / "bench.toml")
