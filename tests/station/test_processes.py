"""Twins in one process, the station in another, real sockets and pseudo-terminals between them."""

from __future__ import annotations

import json
import os
import random
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import kill
import numpy as np
import pytest
from support import TABLE_1, TwinProcess, station
from test_run import BRIEF_SCRIPT, KEYS, SHORT_SCRIPT, bench_file

from station.cli import main

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pseudo-terminals are POSIX only")


@pytest.fixture
def short(tmp_path: Path) -> Path:
    path = tmp_path / "short.toml"
    path.write_text(SHORT_SCRIPT)
    return path


def run_between_processes(tmp_path: Path, scale: str, device: str, *options: str | Path) -> dict[str, Any]:
    with TwinProcess("--scale", scale) as twin:
        links = twin.options("table", device)
        done = station(
            "run", "--scale", scale, "--device", device, "--json", "-o", tmp_path / "r.h5", *links, *options
        )  # fmt: skip
    result: dict[str, Any] = json.loads(done.stdout)
    assert result["outcome"] in ("PASS", "FAIL"), result["reason"]
    return result


def worst_error(result: dict[str, Any]) -> float:
    errors = [(g[key] - t) / g["sd"][key] for g in result["gyros"] for key, t in zip(KEYS, TABLE_1, strict=True)]
    return float(np.abs(errors).max())


def test_a_run_against_twins_in_another_process_finds_the_truth(tmp_path: Path) -> None:
    script = tmp_path / "brief.toml"
    script.write_text(BRIEF_SCRIPT)
    # In real time: three seconds without a sample end a run, and a busy machine may take one of them at once.
    result = run_between_processes(tmp_path, "1", "array", "--bench", bench_file(tmp_path), "--script", script)
    assert len(result["gyros"]) == 4
    assert worst_error(result) < 4


@pytest.mark.full
def test_the_paper_script_at_ten_times_real_time_gives_the_same_verdict(tmp_path: Path) -> None:
    result = run_between_processes(tmp_path, "10", "array")
    assert result["outcome"] == "PASS", result["reason"]
    assert worst_error(result) < 4


@pytest.mark.full
def test_a_stim300_on_a_pseudo_terminal_is_calibrated(tmp_path: Path, short: Path) -> None:
    result = run_between_processes(tmp_path, "3", "stim300", "--bench", bench_file(tmp_path), "--script", short)
    assert [g["name"] for g in result["gyros"]] == ["x", "y", "z"]
    assert abs(result["gyros"][1]["k"] + 200e-6) < 4 * result["gyros"][1]["sd"]["k"]


def test_a_killed_station_leaves_its_samples_and_a_table_that_stops_by_itself(tmp_path: Path) -> None:
    script = tmp_path / "script.toml"
    script.write_text(kill.SCRIPT)
    with TwinProcess("--bench", kill.watched_bench(tmp_path)) as twin:
        left = kill.kill_once(twin, tmp_path / "r.h5", script, after_s=2.5, reach_s=0.25)  # of a machine that is busy
    assert left.turning
    assert left.sent > 1000
    assert left.lost == 0, left.gaps_s
    assert left.at_rest
    assert left.outcome == "ABORTED"


@contextmanager
def babbling_server(seed: int) -> Iterator[int]:
    """Serve random bytes to whoever connects; yield the port."""
    chance = random.Random(seed)
    server = socket.create_server(("127.0.0.1", 0))
    ended = threading.Event()

    def babble() -> None:
        try:
            connection, _ = server.accept()
            with connection:
                while not ended.wait(0.01):
                    connection.sendall(chance.randbytes(500))
        except OSError:
            return

    thread = threading.Thread(target=babble, daemon=True)
    thread.start()
    try:
        yield server.getsockname()[1]
    finally:
        ended.set()
        server.close()
        thread.join(2)


@pytest.mark.parametrize(
    ("device", "options"), [("table", []), pytest.param("stim300", ["--device", "stim300"], marks=pytest.mark.full)]
)
def test_garbage_on_a_link_ends_with_the_device_named_and_no_traceback(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], device: str, options: list[str]
) -> None:
    with babbling_server(1) as port:
        link = ["--link", f"{device}=tcp://127.0.0.1:{port}", *options]
        code = main(["run", *link, "--json", "-o", str(tmp_path / "r.h5")])
    said = capsys.readouterr()
    result = json.loads(said.out)
    assert code == 4
    assert result["outcome"] == "FAULT"
    assert f"{device}: " in result["reason"]  # on a host that does not keep up, behind that reason
    assert "Traceback" not in said.err


def test_two_twins_cannot_share_a_port_and_the_second_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with TwinProcess() as twin:
        assert main(["twin", "--port", twin.links["table"].rsplit(":", 1)[1]]) == 4
    assert "Is the port free?" in capsys.readouterr().err


def test_help_needs_no_library(tmp_path: Path) -> None:
    done = station("--help")
    assert done.returncode == 0
    assert "exit codes" in done.stdout
