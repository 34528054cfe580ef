"""Campaigns: the same results wherever they run, and nothing lost but the item that cannot be done."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import distributed
import h5py
import pytest
from chores import die_at_three, own_threads, square, square_but_three, unwelcome
from support import command, ctrl_c_of_children, direct_recording, station

from estimator.recordings.writing import write_recording
from station.campaigns import ONE_BLAS_THREAD
from station.campaigns.campaigns import Failure, run_all
from station.campaigns.cluster import run_on_cluster
from station.cli import main
from station.commands.calibrate import Estimated, estimate
from station.errors import UsageError
from station.render.printing import result_object
from station.scripts.loop_scripts import between_rests, there_and_back


def estimate_or_be_the_victim(victim: Path, name: str) -> Estimated:
    """Estimate; whoever comes first leaves its process id and waits to be killed."""
    with suppress(FileExistsError):
        half = victim.with_suffix(f".{os.getpid()}")
        half.write_text(str(os.getpid()))
        os.link(half, victim)
        threading.Event().wait()
    return estimate(name, limits=None, write=False)


def printed(names: list[str], results: list[Estimated | None]) -> list[str]:
    """Return results as --json prints them: every digit."""
    ends = zip(names, results, strict=True)
    return [json.dumps(result_object(end.verdict, name, end.calibration)) for name, end in ends if end is not None]


def until(holds: Callable[[], bool], limit_s: float = 30) -> None:
    """Wait for other processes: there is nothing to await."""
    deadline = time.monotonic() + limit_s
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.02)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("archive")
    (folder / "older").mkdir()
    for seed in range(4):
        name = f"older/run-{seed}.h5" if seed < 1 else f"run-{seed}.h5"
        write_recording(folder / name, direct_recording(seed, rate_hz=50.0))
    return folder


@pytest.fixture(scope="module")
def recordings(archive: Path) -> list[str]:
    return sorted(map(str, archive.rglob("*.h5")))


@pytest.fixture(scope="module")
def alone(recordings: list[str]) -> list[str]:
    """What the command prints of the recordings, one after the other in its own process."""
    return of_each(station("calibrate", *recordings, "--jobs", "1", "--json").stdout)


def of_each(output: str) -> list[str]:
    """Return the lines of --json without what the last run of a device carries of the others."""
    objects = [json.loads(line) for line in output.splitlines()]
    return [json.dumps({key: value for key, value in each.items() if key != "repeatability"}) for each in objects]


def assert_alike(value: Any, expected: Any) -> None:
    """Compare JSON values; figures may differ by rounding, which depends on the number of BLAS threads."""
    if isinstance(expected, dict):
        assert value.keys() == expected.keys()
        for key in expected:
            assert_alike(value[key], expected[key])
    elif isinstance(expected, list):
        for item, of_item in zip(value, expected, strict=True):
            assert_alike(item, of_item)
    elif isinstance(expected, float):
        assert value == pytest.approx(expected, rel=1e-6, abs=0, nan_ok=True)
    else:
        assert value == expected


@contextmanager
def cluster(folder: Path, workers: int, *options: str) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers on loopback, in processes of their own."""
    here = Path(__file__).parent
    environment = {
        **os.environ,
        **ONE_BLAS_THREAD,
        "PYTHONPATH": os.pathsep.join([str(here), str(here.parent / "bench")]),
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    }
    told = folder / "scheduler.json"
    started: list[subprocess.Popen[bytes]] = []

    def start(module: str, *arguments: str) -> None:
        words = [sys.executable, "-m", f"distributed.cli.{module}", *arguments, "--host", "127.0.0.1", "--no-dashboard"]
        started.append(subprocess.Popen(words, env=environment, cwd=folder, stderr=subprocess.DEVNULL))

    try:
        start("dask_scheduler", "--port", "0", "--scheduler-file", str(told))
        until(lambda: told.exists() and told.read_text().endswith("}"))
        address = json.loads(told.read_text())["address"]
        for _ in range(workers):
            start("dask_worker", address, "--nthreads", "1", *options)
        if workers:
            with distributed.Client(address, set_as_default=False) as client:
                client.wait_for_workers(workers, timeout=30)
        yield address, started[1:]
    finally:
        for process in reversed(started):  # a nanny that cannot tell its scheduler that it goes does not go
            process.terminate()
            process.wait(20)


def kill_the_victim(victim: Path, crew: list[subprocess.Popen[bytes]]) -> None:
    until(victim.exists)
    next(process for process in crew if process.pid == int(victim.read_text())).kill()


def test_results_keep_the_order_and_what_fails_costs_only_itself(capfd: pytest.CaptureFixture[str]) -> None:
    for workers in (1, 2):
        results, failures = run_all(square_but_three, range(8), label="squares", workers=workers)
        assert results == [0, 1, 4, None, 16, 25, 36, 49]
        assert failures == [Failure("3", "ValueError: three is not wanted")]
    said = capfd.readouterr()
    assert "squares: 8 of 8  1 failed" in said.err
    assert not said.out
    assert run_all(square, [], label="none") == ([], [])


def test_a_process_that_dies_costs_only_its_item() -> None:
    results, failures = run_all(die_at_three, range(8), label="", workers=2, quiet=True, name_of=lambda n: f"item {n}")
    assert results == [0, 1, 4, None, 16, 25, 36, 49]
    assert [f.item for f in failures] == ["item 3"]
    assert "signal 9" in failures[0].reason


def test_a_result_that_cannot_come_back_and_work_that_cannot_go_are_told() -> None:
    results, failures = run_all(unwelcome, range(5), label="", workers=2, quiet=True)
    assert results == [0, 1, 2, None, 4]
    assert "pickle" in failures[0].reason


def test_each_process_has_one_blas_thread_and_this_one_keeps_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "7")
    assert run_all(own_threads, range(2), label="", workers=2, quiet=True)[0] == ["1", "1"]
    assert os.environ["OPENBLAS_NUM_THREADS"] == "7"


@pytest.mark.full
def test_the_number_of_blas_threads_changes_no_bit(recordings: list[str], alone: list[str]) -> None:
    again = subprocess.run(
        command("calibrate", *recordings[:2], "--jobs", "1", "--json"),
        env={**os.environ, "OPENBLAS_NUM_THREADS": "4"},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert of_each(again.stdout) == alone[:2]


@pytest.mark.full
def test_a_pool_gives_the_same_bits_even_if_a_process_is_killed(
    tmp_path: Path, recordings: list[str], alone: list[str]
) -> None:
    victim = tmp_path / "victim"

    def kill() -> None:
        until(victim.exists)
        os.kill(int(victim.read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    work = partial(estimate_or_be_the_victim, victim)
    results, failures = run_all(work, recordings, label="", workers=2, quiet=True)
    killer.join()
    assert not failures
    assert printed(recordings, results) == alone


@pytest.mark.full
def test_a_cluster_gives_the_same_bits_even_if_a_worker_is_killed(
    tmp_path: Path, recordings: list[str], alone: list[str]
) -> None:
    victim = tmp_path / "victim"
    with cluster(tmp_path, 2, "--no-nanny") as (address, crew):
        killer = threading.Thread(target=kill_the_victim, args=(victim, crew))
        killer.start()
        work = partial(estimate_or_be_the_victim, victim)
        results, failures = run_all(work, recordings, label="", scheduler=address, quiet=True)
        killer.join()
        assert [process.poll() is None for process in crew].count(False) == 1
    assert not failures
    assert printed(recordings, results) == alone


def test_on_a_cluster_an_item_that_fails_or_kills_its_worker_costs_only_itself(tmp_path: Path) -> None:
    with cluster(tmp_path, 1, "--nanny") as (address, _):
        results, failures = run_all(square_but_three, range(8), label="", scheduler=address, quiet=True)
        assert results == [0, 1, 4, None, 16, 25, 36, 49]
        assert failures == [Failure("3", "ValueError: three is not wanted")]
        results, failures = run_all(die_at_three, range(8), label="", scheduler=address, quiet=True)
        assert results == [0, 1, 4, None, 16, 25, 36, 49]
        assert failures == [Failure("3", "every worker that tried it died")]


@pytest.mark.full
def test_a_worker_with_several_blas_threads_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ONE_BLAS_THREAD, "OPENBLAS_NUM_THREADS", "4")
    with cluster(tmp_path, 1, "--no-nanny") as (address, _):
        failures = run_all(square, [1], label="", scheduler=address, quiet=True)[1]
    assert "start it with OMP_NUM_THREADS=1" in failures[0].reason


def test_a_cluster_without_workers_is_given_up(tmp_path: Path) -> None:
    with cluster(tmp_path, 0) as (address, _):
        ends = list(run_on_cluster(square, range(3), address, patience_s=1))
        assert [e.index for e in ends] == [0, 1, 2]
        assert all(e.reason == f"the cluster at {address} has had no worker for 1 s" for e in ends)


@pytest.mark.full
def test_a_cluster_whose_last_worker_dies_keeps_what_was_done(tmp_path: Path, recordings: list[str]) -> None:
    victim = tmp_path / "victim"
    with cluster(tmp_path, 1, "--no-nanny") as (address, crew):
        done = list(run_on_cluster(square, range(3), address))
        assert [e.value for e in sorted(done, key=lambda e: e.index)] == [0, 1, 4]
        killer = threading.Thread(target=kill_the_victim, args=(victim, crew))
        killer.start()
        work = partial(estimate_or_be_the_victim, victim)
        ends = list(run_on_cluster(work, recordings, address, patience_s=1))
        killer.join()
        assert len(ends) == len(recordings)
        assert all("has had no worker for 1 s" in str(e.reason) for e in ends)


def test_no_scheduler_at_the_address_is_told_within_seconds(
    recordings: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("station.campaigns.cluster.ANSWER_S", 1.0)
    began = time.monotonic()
    assert main(["calibrate", recordings[0], "--scheduler", "tcp://127.0.0.1:1"]) == 2
    assert "no Dask scheduler answers" in capsys.readouterr().err
    with socket.create_server(("127.0.0.1", 0)) as silent:  # a foreign service that waits to be spoken to
        port = silent.getsockname()[1]
        assert main(["calibrate", recordings[0], "--scheduler", f"tcp://127.0.0.1:{port}"]) == 2
    assert time.monotonic() - began < 15
    assert "no Dask scheduler answers" in capsys.readouterr().err


@pytest.mark.parametrize("address", ["127.0.0.1:8786", "tcp://127.0.0.1", "http://127.0.0.1:8786", "tcp://a:b", ""])
def test_a_malformed_address_is_refused(address: str) -> None:
    with pytest.raises(UsageError, match="write tcp://HOST:PORT"):
        run_all(square, [1], label="", scheduler=address)


def test_without_distributed_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"pip install 'turntable-station\[cluster\]'"):
        run_all(square, [1], label="", scheduler="tcp://127.0.0.1:8786")


def test_ctrl_c_stops_the_processes_and_what_they_started(tmp_path: Path) -> None:
    script = tmp_path / "wait.py"
    script.write_text(
        "import os, subprocess, sys\n"
        "from pathlib import Path\n"
        "from station.campaigns.campaigns import run_all\n"
        "def work(number):\n"
        "    with subprocess.Popen(['sleep', '1000']) as child:\n"
        "        try:\n"
        "            Path(f'{number}.half').write_text(f'{os.getpid()} {child.pid}')\n"
        "            Path(f'{number}.half').rename(f'{number}.ids')\n"
        "            child.wait()\n"
        "        finally:\n"
        "            child.kill()\n"
        "if __name__ == '__main__':\n"
        "    try:\n"
        "        run_all(work, range(9), label='wait', workers=2)\n"
        "    except KeyboardInterrupt:\n"
        "        sys.exit(3)\n"
    )
    told = [tmp_path / "0.ids", tmp_path / "1.ids"]
    words = [sys.executable, str(script)]
    with ctrl_c_of_children():
        run = subprocess.Popen(words, cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True)
    assert run.stderr is not None
    try:
        until(lambda: all(path.exists() for path in told))
        os.killpg(run.pid, signal.SIGINT)  # as a terminal does
        _, err = run.communicate(timeout=20)
    finally:
        run.kill()
        run.wait()
        run.stderr.close()
    assert run.returncode == 3
    assert "Traceback" not in err
    for process in (int(word) for path in told for word in path.read_text().split()):
        with pytest.raises(ProcessLookupError):
            os.kill(process, 0)


def test_a_folder_is_calibrated_alike_by_any_number_of_processes_and_the_damaged_file_is_listed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "archive"
    (folder / "older").mkdir(parents=True)
    turns = [turn for axis in "xyz" for turn in there_and_back(axis, 40.0, 3.0)]
    for seed, name in enumerate(("older/run-0.h5", "run-1.h5", "run-2.h5", "run-3.h5")):
        recording = direct_recording(seed, script=between_rests("short", turns, 3.0), rate_hz=50.0)
        write_recording(folder / name, recording)
    damaged = folder / "run-2.h5"
    damaged.write_bytes(damaged.read_bytes()[:50_000])
    words = ["calibrate", str(folder), "--json"]
    outputs: list[list[Any]] = []
    for jobs in ("1", "2"):
        assert main([*words, "--jobs", jobs]) == 2
        said = capsys.readouterr()
        assert "run-2.h5 cannot be read" in said.err
        outputs.append([json.loads(line) for line in said.out.splitlines()])
    assert_alike(outputs[1], outputs[0])
    objects = outputs[0]
    assert [Path(o["recording"]).name for o in objects] == [f"run-{seed}.h5" for seed in range(4)]
    assert [o["outcome"] for o in objects] == ["ESTIMATED", "ESTIMATED", None, "ESTIMATED"]


@pytest.mark.full
def test_many_recordings_are_printed_a_line_each_and_few_in_full(
    tmp_path: Path, archive: Path, recordings: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "archive"
    shutil.copytree(archive, folder)
    for number in (7, 8):
        shutil.copy(folder / "run-1.h5", folder / f"run-{number}.h5")
    (folder / "run-9.h5").write_bytes(b"nothing")
    assert main(["calibrate", str(folder), str(folder / "run-3.h5"), "--write"]) == 2
    said = capsys.readouterr()
    assert "7 recordings: 6 PASS, 1 not estimated" in said.out
    assert "States and their" not in said.out
    assert "│ older/run-0.h5 │ array" in said.out
    assert said.err.splitlines()[-1].startswith(f"station: {folder / 'run-9.h5'} cannot be read")
    with h5py.File(folder / "older/run-0.h5") as file:
        assert file["calibration/states"].shape == (4, 4)
    assert main(["calibrate", *recordings[:2]]) == 0
    assert capsys.readouterr().out.count("States and their") == 2


def test_a_folder_without_recordings_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(tmp_path)]) == 2
    assert "holds no recording" in capsys.readouterr().err
