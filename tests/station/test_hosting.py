"""A run and its socket: who looks on, tells it to stop, pause or note, hangs up, dies, floods or never reads."""

from __future__ import annotations

import asyncio
import json
import math
import os
import pty
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import forks
import h5py
import numpy as np
import pytest
from support import command, forked
from test_run import bench_file, events, run_json

from station.errors import UsageError
from station.remote.attaching import RemoteSession, running_sessions
from station.run.snapshot import AxisSnapshot, GyroSnapshot, Phase, Snapshot, SourceSnapshot, snapshot_of
from station.views.json_values import json_object

pytestmark = pytest.mark.skipif(os.name != "posix", reason="Unix sockets")

SCRIPT = """
name = "turns"
[[step]]
kind = "rest"
duration = "3 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "40 deg/s"
acceleration = "20 deg/s2"
duration = "8 s"
label = "first turn"
[[step]]
kind = "rotate"
axis = "y"
rate = "-40 deg/s"
acceleration = "20 deg/s2"
duration = "8 s"
label = "second turn"
[[step]]
kind = "rest"
duration = "8 s"
label = "last rest"
"""
BRIEF = """
name = "brief"
[[step]]
kind = "rest"
duration = "2 s"
[[step]]
kind = "rotate"
axis = "x"
rate = "40 deg/s"
acceleration = "40 deg/s2"
duration = "4 s"
label = "first turn"
[[step]]
kind = "rest"
duration = "2 s"
"""
FLOOD = b'{"do":"dance"}\n' * 20_000
CLIENT = """
import asyncio, sys
from pathlib import Path
from station.remote.attaching import RemoteSession
async def look():
    session = await RemoteSession.connect(Path(sys.argv[1]))
    async for message in session.messages():
        print(message["kind"], flush=True)
asyncio.run(look())
"""
WITH_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A runtime folder of our own, for this process and those that it starts."""
    folder = tmp_path_factory.mktemp("run")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        yield folder


class Run:
    """`station run --host` on twins in memory, three times as fast as real time.

    ``line`` is ``command`` for what asks for the number of its process, or ends it by SIGKILL.
    """

    def __init__(self, folder: Path, *options: str | Path, line: Callable[..., list[str]] = forked, **how: Any) -> None:
        script = folder / "script.toml"
        script.write_text(SCRIPT)
        self.path = folder / "r.h5"
        words = line("run", "--host", "--scale", "3", "--bench", bench_file(folder))
        words += [] if "--manual" in options else ["--script", str(script)]
        words += [*map(str, options), "--json", "-o", str(self.path)]
        self._others = {*running_sessions()}
        environment = os.environ | forks.HOSTS_TOO
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        self.process = subprocess.Popen(words, **{"env": environment, **pipes, **how})

    @property
    def socket(self) -> Path | None:
        return next((path for path in running_sessions() if path not in self._others), None)

    async def connect(self) -> RemoteSession:
        while (path := self.socket) is None:
            assert self.process.poll() is None
            await asyncio.sleep(0.02)  # another process: there is nothing to await
        return await RemoteSession.connect(path)

    def end(self) -> tuple[int, dict[str, Any], str]:
        try:
            out, err = self.process.communicate(timeout=60)
        finally:
            self.process.kill()
        return self.process.returncode, json.loads(out), err.decode()


@dataclass
class Watched:
    """What was seen of one run with every kind of client, and what it left."""

    hello: dict[str, Any] = field(default_factory=dict)
    first: list[dict[str, Any]] = field(default_factory=list)
    second: list[dict[str, Any]] = field(default_factory=list)
    paused: list[Snapshot] = field(default_factory=list)
    killed_after: bytes = b""
    code: int = -1
    result: dict[str, Any] = field(default_factory=dict)
    errors: str = ""
    path: Path = Path()
    socket_left: bool = True

    def snapshots(self) -> list[Snapshot]:
        return [snapshot_of(m) for m in self.first if m["kind"] == "snapshot"]

    def texts(self) -> list[str]:
        return [m["text"] for m in self.first if m["kind"] == "event"]

    def refusals(self) -> list[str]:
        return [m["reason"] for m in self.first if m["kind"] == "refused"]


@pytest.fixture(scope="module")
def watched(place: Path, tmp_path_factory: pytest.TempPathFactory) -> Watched:
    """One run: two clients, one of them killed with -9, one that never reads, one that floods; pause, notes."""
    folder = tmp_path_factory.mktemp("watched")
    run = Run(folder, "--operator", "A. Müller", "--serial-number", "SN-17")
    seen = Watched(path=run.path)

    async def look_on(session: RemoteSession, kept: list[dict[str, Any]]) -> None:
        async for message in session.messages():
            kept.append(message)

    async def steer(session: RemoteSession, path: Path) -> None:
        deaf, flooding = (socket.socket(socket.AF_UNIX) for _ in range(2))
        for far in (deaf, flooding):
            far.connect(str(path))
            far.setblocking(False)
        victim = subprocess.Popen([sys.executable, "-c", CLIENT, str(path)], stdout=subprocess.PIPE)
        asked = False
        async for message in session.messages():
            seen.first.append(message)
            if message["kind"] != "snapshot":
                continue
            with suppress(BlockingIOError):
                flooding.send(FLOOD)
            snapshot = snapshot_of(message)
            if snapshot.label == "first turn" and not asked:
                asked = True
                session.resume()
                session.pause()
                session.note("wind\x07 from\nthe  door \x1b[31m")
                session.note("x" * 500)
            if snapshot.paused == "paused":
                seen.paused.append(snapshot)
                if len(seen.paused) == 8:
                    assert victim.stdout is not None
                    seen.killed_after = victim.stdout.readline()
                    victim.kill()
                    session.resume()
            if snapshot.label == "last rest" and len(seen.refusals()) < 3:
                session.pause()
                session.ask_course()
        for far in (deaf, flooding):
            far.close()
        victim.wait()
        victim.stdout and victim.stdout.close()

    async def follow() -> None:
        first = await run.connect()
        path = run.socket
        assert path is not None
        seen.hello = first.hello
        second = await RemoteSession.connect(path)
        async with asyncio.timeout(90):
            await asyncio.gather(steer(first, path), look_on(second, seen.second))
        first.close()
        second.close()
        seen.code, seen.result, seen.errors = await asyncio.to_thread(run.end)
        seen.socket_left = path.exists()

    try:
        asyncio.run(follow())
    finally:
        run.process.kill()
        run.process.communicate()
    return seen


def test_a_session_says_what_it_is_first(watched: Watched) -> None:
    hello = watched.hello
    assert (hello["kind"], hello["version"]) == ("hello", 2)
    assert hello["script"]["name"] == "turns"
    assert hello["script"]["duration_s"] == 27
    turned_rad = pytest.approx(math.radians(240.0))
    assert hello["script"]["steps"][1] == {
        "label": "first turn",
        "start_s": 3,
        "end_s": 11,
        "axis": "x",
        "to_rad": turned_rad,
    }
    assert hello["recording"] == str(watched.path)
    assert hello["gyros"] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    assert hello["axes"] == ["z", "y", "x"]
    assert hello["limits"]["k"] == pytest.approx(0.01)
    assert hello["limits"]["sd_k"] is None
    assert (hello["operator"], hello["device_serial"], hello["time_scale"]) == ("A. Müller", "SN-17", 3)


def test_two_clients_see_the_same_events_and_the_result_that_the_command_prints(watched: Watched) -> None:
    second = [m["text"] for m in watched.second if m["kind"] == "event"]
    assert watched.texts() == second
    assert "script begins" in second
    for messages in (watched.first, watched.second):
        assert messages[-1] == {"kind": "result", **watched.result}
    assert watched.result["outcome"] in ("PASS", "FAIL"), watched.result["reason"]
    assert not watched.socket_left


def test_no_client_disturbs_the_run_deaf_flooding_or_killed(watched: Watched) -> None:
    assert watched.killed_after.strip() in (b"event", b"snapshot")
    assert watched.result["lost"] < 0.01 * watched.result["samples"]  # a clock of arrivals, and a busy machine
    assert watched.code in (0, 1)
    assert "Traceback" not in watched.errors
    # Ten a second of the wall's clock, a busy machine allowed for.
    assert len(watched.snapshots()) > 3 * watched.snapshots()[-1].elapsed_s / 3


def test_snapshots_show_axes_sources_and_gyros(watched: Watched) -> None:
    turning = next(s for s in watched.snapshots() if s.label == "second turn" and 3 < s.remaining_s - 8 < 5)
    outer, middle, inner = turning.axes
    assert (outer.name, middle.name, inner.name) == ("z", "y", "x")
    assert middle.state == "turning"
    assert middle.rate_rps == pytest.approx(math.radians(-40), rel=0.5)
    assert middle.setpoint_rps == pytest.approx(math.radians(-40))
    assert (inner.state, inner.setpoint_rps) == ("at rest", 0)
    last = watched.snapshots()[-1]
    assert last.remaining_s == 0
    assert [source.device for source in last.sources] == ["array"] * 4
    for source in last.sources:
        assert source.rate_hz == pytest.approx(100, rel=0.1)
        assert abs(source.latency_s) < 1
        assert source.temperature_c == pytest.approx(25, abs=5)
    assert [gyro.name for gyro in last.gyros] == watched.hello["gyros"]
    with h5py.File(watched.path) as file:
        assert file["calibration"].attrs["live_batch_difference_sigma"] < 1e-6
        kept = {name: (group["states"][-1, 0], group["sd"][-1, 0]) for name, group in file["estimate"].items()}
    for gyro in last.gyros:
        # What is kept and what is shown are some blocks apart on a busy host: they differ by what an update changes.
        states, sds = kept[gyro.source]
        assert np.all(np.abs(states - gyro.values) < 3 * np.maximum(sds, gyro.sds))
        assert gyro.sds[1] < turning.gyros[0].sds[1]
        assert gyro.nis < 3
    assert last.nis_recent < 2
    assert abs(last.whiteness) < 1


def test_who_comes_late_is_told_how_the_estimates_went(watched: Watched) -> None:
    points = [m for m in watched.first if m["kind"] == "course"][-1]["points"]
    times_s = [point["t_s"] for point in points]
    assert times_s == sorted(times_s)
    assert times_s[0] < 5
    assert 5 < len(points) <= 300
    first = watched.snapshots()[-1].gyros[0]
    assert points[-1]["sensors"].keys() == {gyro.full_name for gyro in watched.snapshots()[-1].gyros}
    values, sds = points[-1]["sensors"][first.full_name]
    assert len(values) == len(sds) == 4
    assert sds[1] < points[0]["sensors"][first.full_name][1][1]


def test_a_pause_holds_the_table_and_the_time_while_samples_go_on(watched: Watched) -> None:
    first, last = watched.paused[0], watched.paused[-1]
    assert {s.remaining_s for s in watched.paused} == {16.0}
    assert {axis.state for axis in last.axes} == {"at rest"}
    assert last.samples > first.samples
    texts = watched.texts()
    assert texts.index("will pause after step 'first turn'") < texts.index("paused after step 'first turn'")
    assert texts.index("paused after step 'first turn'") < texts.index("resumed")
    with h5py.File(watched.path) as file:
        labels = [text.decode() for text in file["steps/label"][()]]
        assert labels == ["rest", "first turn", "pause", "second turn", "last rest"]
        start_ns, end_ns = (int(file[f"steps/{key}"][2]) for key in ("t_start_ns", "t_end_ns"))
        t_ns, table_ns = file["imu/gyro1/t_ns"][()], file["table/t_ns"][()]
    inside = (t_ns > start_ns) & (t_ns < end_ns)
    assert np.count_nonzero(inside) == pytest.approx((end_ns - start_ns) * 1e-9 * 100, abs=3)
    assert np.count_nonzero((table_ns > start_ns) & (table_ns < end_ns)) > 5


def test_notes_operator_and_serial_number_are_in_the_record(watched: Watched) -> None:
    assert "note: wind from the door [31m" in events(watched.path)
    assert not any("xxx" in text for text in events(watched.path))
    assert any("this one has 500" in reason for reason in watched.refusals())
    with h5py.File(watched.path) as file:
        assert file.attrs["operator"] == "A. Müller"
        assert file.attrs["device_serial"] == "SN-17"


def test_what_cannot_be_done_now_is_refused_with_its_reason(watched: Watched) -> None:
    refusals = watched.refusals()
    assert refusals[0] == "the run is not paused"
    assert any("the last step is running" in reason for reason in refusals)


@pytest.mark.parametrize("phase", ["connecting", "first turn", "pause"])
def test_stop_ends_the_run_at_once_in_every_phase(place: Path, tmp_path: Path, phase: str) -> None:
    run = Run(tmp_path)

    async def stop_in_phase() -> list[dict[str, Any]]:
        session = await run.connect()
        assert run.socket is not None
        messages = []
        if phase == "connecting":  # and by one who hangs up at once
            with socket.socket(socket.AF_UNIX) as hasty:
                hasty.connect(str(run.socket))
                hasty.sendall(b'{"do":"stop"}\n')
        async for message in session.messages():
            messages.append(message)
            if phase == "pause" and message.get("label") == "rest" and not message["paused"]:
                session.pause()
            if phase == "pause" == message.get("label"):
                await asyncio.to_thread(say_nonsense, run.socket)
            if message.get("label") == phase != "connecting":
                assert session.stop()
        assert not session.stop()  # there is nobody any more
        session.close()
        return messages

    try:
        messages = asyncio.run(asyncio.wait_for(stop_in_phase(), 60))
        code, result, errors = run.end()
    finally:
        run.process.kill()
    assert code == 3
    assert result["outcome"] == "ABORTED"
    assert result["reason"].startswith("stopped by the operator")
    assert messages[-1] == {"kind": "result", **result}
    assert "Traceback" not in errors
    with h5py.File(run.path) as file:
        assert file.attrs["outcome"] == "ABORTED"
        assert phase == "connecting" or file["events/text"][-1] == b"table at rest"


def say_nonsense(path: Path) -> None:
    """Say lines that are not understood: they are refused, and harm nothing."""
    wrong = [b"", b"nonsense", b"\xff\xfe", b"[" * 4000, b"null", b"7", b'"stop"', b'["do"]', b'{"do":null}',
             b'{"do":"dance"}', b'{"do":["stop"]}', b'{"do":"note"}', b'{"do":"note","text":7}',
             b'{"do":"note","text":"\\ud800"}', b'{"stop":1}']  # fmt: skip
    with socket.socket(socket.AF_UNIX) as near:
        near.connect(str(path))
        near.settimeout(30)
        with near.makefile("rb") as file:
            for line in wrong:
                near.sendall(line + b"\n")
                assert _next(file, "refused")["reason"], line
            near.sendall(b"x" * 10_000)
            assert "4096" in _next(file, "refused")["reason"]
            assert all(json.loads(line)["kind"] != "result" for line in file)  # it hangs up


@pytest.mark.full
def test_each_run_has_its_socket_and_that_of_a_dead_one_is_cleared_away(place: Path, tmp_path: Path) -> None:
    runs: list[Run] = []
    hellos = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        runs.append(Run(tmp_path / name, line=command))
        hellos.append(asyncio.run(_connected(runs[-1])))
    first, second = runs
    try:
        assert [hello["pid"] for hello in hellos] == [run.process.pid for run in runs]
        assert {first.socket, second.socket} <= set(running_sessions())
        left = second.socket
        assert left is not None
        second.process.kill()
        second.process.communicate()
        assert left.exists()
        assert left not in running_sessions()
        assert not left.exists()
        with pytest.raises(UsageError, match="it has ended"):
            asyncio.run(RemoteSession.connect(left))
        assert first.socket is not None
        first.process.send_signal(signal.SIGTERM)
        assert first.end()[0] == 3
    finally:
        for run in runs:
            run.process.kill()
            run.process.communicate()


def test_a_run_outlives_its_terminal(place: Path, tmp_path: Path) -> None:
    near, far = pty.openpty()
    script = tmp_path / "script.toml"
    script.write_text(BRIEF)
    path = tmp_path / "r.h5"
    words = command(
        "run", "--host", "--scale", "3", "--bench", bench_file(tmp_path), "--script", script, "-o", path
    )  # fmt: skip
    run = subprocess.Popen(
        [sys.executable, "-c", WITH_TERMINAL, *words], stdin=far, stdout=far, stderr=far, start_new_session=True
    )
    os.close(far)
    try:
        shown = b""
        while b"first turn" not in shown:
            shown += os.read(near, 4096)
        os.close(near)  # the terminal is gone: SIGHUP, and EIO for whoever writes to it
        code = run.wait(60)
    finally:
        run.kill()
    assert code in (0, 1)
    with h5py.File(path) as file:
        assert file.attrs["outcome"] in ("PASS", "FAIL")
        assert len(file["steps/label"]) == 3
        assert "calibration" in file
    assert [text for text in events(path) if "terminal" in text] == ["the terminal is gone (SIGHUP): the run continues"]
    assert events(path)[-1] == "table at rest"


@pytest.mark.parametrize("printed", [(), ("--json",)], ids=["bar", "json"])
def test_a_run_whose_terminal_is_closed_is_aborted_and_says_so_by_its_exit_code(
    printed: tuple[str, ...], tmp_path: Path
) -> None:
    near, far = pty.openpty()
    path = tmp_path / "r.h5"
    line = forked if printed else command  # a bar that is drawn meanwhile asks for a terminal of its own
    words = line("run", *printed, "--scale", "3", "--bench", bench_file(tmp_path), "-o", path)
    run = subprocess.Popen(
        [sys.executable, "-c", WITH_TERMINAL, *words], stdin=far, stdout=far, stderr=far, start_new_session=True
    )
    os.close(far)
    try:
        _wait_until(lambda: path.exists() and path.stat().st_size > 50_000)
        os.close(near)
        code = run.wait(60)
    finally:
        run.kill()
    assert code == 3
    with h5py.File(path) as file:
        assert file.attrs["outcome"] == "ABORTED"
        assert "SIGHUP (the terminal is gone)" in file.attrs["reason"]


def test_without_a_host_the_run_ends_with_its_terminal(tmp_path: Path) -> None:
    path = tmp_path / "r.h5"
    run = subprocess.Popen(forked("run", "--json", "-o", path), stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        _wait_until(lambda: path.exists() and path.stat().st_size > 300_000)
        run.send_signal(signal.SIGHUP)
        out, _ = run.communicate(timeout=30)
    finally:
        run.kill()
    assert run.returncode == 3
    assert "SIGHUP (the terminal is gone)" in json.loads(out)["reason"]


def test_a_place_where_no_socket_can_be_is_refused_before_anything_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / f"station-{os.getuid()}").write_text("in the way")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    path = tmp_path / "r.h5"
    before = signal.getsignal(signal.SIGHUP)
    try:
        code, result = run_json(capsys, "--host", "-o", path)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert code == 2
    assert result["outcome"] is None
    assert "is no folder" in result["reason"]
    assert "XDG_RUNTIME_DIR" in result["reason"]
    assert not path.exists()


def test_a_folder_that_others_can_reach_is_not_used_for_sockets(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / f"station-{os.getuid()}"
    folder.mkdir(mode=0o755)
    folder.chmod(0o755)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (folder / "1.sock").write_text("not asked, not removed")
    assert not [path for path in running_sessions() if path.parent == folder]
    assert (folder / "1.sock").exists()


def test_operator_and_serial_number_must_match_the_patterns_of_the_bench(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench = bench_file(tmp_path, end='\n[station]\noperator_pattern = "[A-Z]{2,3}"\nserial_pattern = "SN-\\\\d{4}"\n')
    path = tmp_path / "r.h5"
    for option, value, says in (
        ("--serial-number", "SN-12", "SN-\\d{4} (serial_pattern in [station])"),
        ("--operator", "ab", "[A-Z]{2,3} (operator_pattern in [station])"),
        ("--operator", "\x1b[31m", "printable"),
        ("--serial-number", " ", "printable"),
    ):
        code, result = run_json(capsys, "--bench", bench, "-o", path, option, value)
        assert (code, result["outcome"]) == (2, None)
        assert says in result["reason"]
        assert not path.exists()


def test_a_pattern_that_is_none_is_told_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench = bench_file(tmp_path, end='\n[station]\nname = "lab 3"\nserial_pattern = "SN-("\n')
    code, result = run_json(capsys, "--bench", bench, "-o", tmp_path / "r.h5")
    assert code == 2
    assert f"line {len(bench.read_text().splitlines())}" in result["reason"]
    assert "regular expression" in result["reason"]


def test_the_one_device_that_tells_its_serial_number_is_recorded_by_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "rest.toml"
    script.write_text('[[step]]\nkind = "rest"\nduration = "3 s"\n')
    bench = bench_file(tmp_path, end='\n[station]\nname = "lab 3"\n')
    run_json(capsys, "--bench", bench, "--script", script, "--device", "stim300", "-o", tmp_path / "one.h5")
    two = ("--device", "stim300", "--device", "array")
    run_json(capsys, "--bench", bench, "--script", script, *two, "-o", tmp_path / "two.h5")
    with h5py.File(tmp_path / "one.h5") as file:
        assert file.attrs["device_serial"] == file["imu/stim300"].attrs["serial"]
        assert file.attrs["station"] == "lab 3"
    with h5py.File(tmp_path / "two.h5") as file:
        assert "device_serial" not in file.attrs


def test_a_snapshot_comes_through_json_as_it_was() -> None:
    snapshot = Snapshot(
        Phase.HOMING, "", 1.5, 2.5, 10, 1, float("nan"), 0.9, -0.1, "after this step",
        (AxisSnapshot(name="x", angle_rad=0.1, rate_rps=-0.2, setpoint_rps=0.3, state="turning"),),
        (SourceSnapshot("s", "d", 99.5, 10, 1, 2, 3, 4, 0.001, float("nan"), 25.0, "ok"),),
        (GyroSnapshot("g", "s", (1.0, 2.0, 3.0, 4.0), (0.1, 0.2, 0.3, float("nan")), 1.1),),
    )  # fmt: skip
    text = json.dumps(json_object(snapshot), allow_nan=False)
    assert '"nis_mean": null' in text
    assert repr(snapshot_of(json.loads(text))) == repr(snapshot)
    with pytest.raises((KeyError, TypeError)):
        snapshot_of({"phase": "homing"})


async def _connected(run: Run) -> dict[str, Any]:
    session = await run.connect()
    session.close()
    return session.hello


def _next(file: Any, kind: str) -> dict[str, Any]:
    """Return the next message of a kind; the others are passed over."""
    for line in file:
        message: dict[str, Any] = json.loads(line)
        if message["kind"] == kind:
            return message
    raise AssertionError(f"no {kind}")


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)  # another process: there is nothing to await


@pytest.mark.full
def test_a_jog_ends_when_the_link_of_who_said_it_is_cut_and_no_flood_of_words_prolongs_it(
    place: Path, tmp_path: Path
) -> None:
    run = Run(tmp_path, "--manual")

    async def rate(session: RemoteSession, holds: Callable[[float], bool]) -> float:
        """Return when the rate of x first holds, by the session's clock."""
        async for message in session.messages():
            if message["kind"] == "snapshot" and message["phase"] == "running":
                shown = snapshot_of(message)
                if holds(next(axis.rate_rps for axis in shown.axes if axis.name == "x")):
                    return shown.elapsed_s
        raise AssertionError("the session is gone")

    async def main() -> None:
        hand, other = await run.connect(), await run.connect()
        assert hand.hello["table"]["x"]["rate_rps"] > 1.0
        await rate(hand, lambda rps: rps == 0.0)
        hand.drive("jog", axis="x", rate_rps=0.5)
        turned_s = await rate(other, lambda rps: rps > 0.4)
        hand.drive("jog", axis="x", rate_rps=0.5)
        hand.close()
        assert await rate(other, lambda rps: rps == 0.0) - turned_s < 3 * 2.0  # at three times as fast as the wall
        flooding = await run.connect()  # and by the words of who says too many and then no more
        for _ in range(8000):
            flooding.drive("jog", axis="x", rate_rps=0.5)
        turned_s = await rate(other, lambda rps: rps > 0.4)
        assert await rate(other, lambda rps: rps == 0.0) - turned_s < 3 * 2.0
        flooding.close()
        other.drive("dance")
        other.drive("end")
        async for message in other.messages():
            if message["kind"] == "refused":
                refused.append(message["reason"])
        other.close()

    refused: list[str] = []
    asyncio.run(main())
    code, said, _ = run.end()
    assert (code, said["outcome"], said["gyros"]) == (0, "MANUAL", [])
    assert refused == ["unknown request: 'dance'"]
