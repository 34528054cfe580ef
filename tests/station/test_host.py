"""A computer that does not keep up: the clock of twins waits for it, and a run that fails by it names it."""

from __future__ import annotations

import asyncio
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py
import pytest
from support import TwinProcess, command, forked

from station.bench.bench import default_bench_text
from station.run.event_loop.loops import PacedLoop, ScaledLoop, VirtualLoop
from station.screen.choices import twin_scale

SCRIPT = """
[[step]]
kind = "rest"
duration = "{rest_s:g} s"
[[step]]
kind = "rotate"
axis = "z"
rate = "20 deg/s"
duration = "{turn_s:g} s"
"""


def written(folder: Path, rest_s: float, turn_s: float) -> list[str]:
    """Write a bench without limits and a script; return the options of `station run`."""
    bench = re.sub(r"^\[limits\].*?(?=^\[|\Z)", "", default_bench_text(), flags=re.DOTALL | re.MULTILINE)
    (folder / "bench.toml").write_text(bench)
    (folder / "script.toml").write_text(SCRIPT.format(rest_s=rest_s, turn_s=turn_s))
    options = {"--bench": "bench.toml", "--script": "script.toml", "-o": "run.h5"}
    return [word for option, name in options.items() for word in (option, str(folder / name))]


def texts(path: Path) -> list[str]:
    with h5py.File(path) as file:
        return [text.decode() for text in file["events/text"][:]]


@pytest.mark.parametrize("scale", [pytest.param(400, marks=pytest.mark.full), 3000])
def test_a_scale_that_no_computer_keeps_up_with_is_not_kept_and_that_is_told(tmp_path: Path, scale: int) -> None:
    options = written(tmp_path, 20.0, 40.0)
    done = subprocess.run(
        forked("run", "--json", "--scale", str(scale), *options), capture_output=True, text=True, check=False
    )
    said: dict[str, Any] = json.loads(done.stdout)
    assert said["outcome"] == "ESTIMATED", said["reason"]
    told = [text for text in texts(tmp_path / "run.h5") if f"--scale {scale}" in text]
    assert len(told) == 1, texts(tmp_path / "run.h5")
    assert "cannot keep up" in told[0]


def test_a_run_at_a_scale_that_is_kept_says_nothing_of_it(tmp_path: Path) -> None:
    options = written(tmp_path, 4.0, 6.0)
    began_s = time.monotonic()
    done = subprocess.run(
        forked("run", "--json", "--scale", "4", *options), capture_output=True, text=True, check=False
    )
    assert json.loads(done.stdout)["outcome"] == "ESTIMATED"
    assert time.monotonic() - began_s > 10.0 / 4  # it is no virtual time
    assert not [text for text in texts(tmp_path / "run.h5") if "keep up" in text]


def test_the_clock_of_twins_passes_by_no_timer_and_never_goes_back() -> None:
    async def main() -> list[float]:
        loop = asyncio.get_running_loop()
        seen, due_s = [], loop.time()
        for turn in range(40):
            due_s += 1.0
            await asyncio.sleep(due_s - loop.time())
            seen.append(loop.time() - due_s)
            if turn == 10:
                time.sleep(0.3)  # the computer is away for 30 s of the loop's clock
            assert loop.time() >= due_s
        return seen

    with asyncio.Runner(loop_factory=lambda: PacedLoop(100.0)) as runner:
        began_s = time.monotonic()
        late_s = runner.run(main())
        took_s = time.monotonic() - began_s
    assert max(late_s) < 1e-6
    assert took_s > 0.3 + 29 * 0.01 * 0.8
    assert all(later >= earlier for earlier, later in pairwise(range(len(late_s))))


@pytest.mark.parametrize(
    "make", [ScaledLoop, lambda: PacedLoop(100.0), VirtualLoop], ids=["scaled", "paced", "virtual"]
)
def test_an_error_of_a_job_comes_when_the_job_is_awaited(make: Callable[[], asyncio.AbstractEventLoop]) -> None:
    async def main() -> None:
        job = asyncio.get_running_loop().run_in_executor(None, int, "no number")
        with pytest.raises(ValueError, match="no number"):
            await job

    with asyncio.Runner(loop_factory=make) as runner:
        runner.run(main())


def test_a_program_that_was_stopped_and_goes_on_blames_no_device(tmp_path: Path) -> None:
    options = written(tmp_path, 3.0, 12.0)
    with TwinProcess("--bench", tmp_path / "bench.toml") as twin:
        station = subprocess.Popen(
            command("run", "--json", *options, *twin.options("table", "array")), stdout=subprocess.PIPE, text=True
        )
        while not turning(tmp_path / "run.h5.journal"):  # on a busy computer that takes a minute
            assert station.poll() is None
            time.sleep(0.1)  # looks at a file that another process writes
        os.kill(station.pid, signal.SIGSTOP)
        time.sleep(1.55)  # what is tried; the lag counts from the first sleep that was to end, up to 0.15 s later
        os.kill(station.pid, signal.SIGCONT)
        said: dict[str, Any] = json.loads(station.communicate(timeout=60)[0])
    if said["outcome"] == "FAULT":
        assert re.match(r"host: this computer fell behind by 1[45]\d\d ms", said["reason"]), said["reason"]
    else:
        assert said["outcome"] in ("ESTIMATED", "FAIL"), said["reason"]
    assert "fell silent" not in said["reason"].partition("host:")[0]


def turning(journal: Path) -> bool:
    return journal.exists() and b"script begins" in journal.read_bytes()


@pytest.mark.parametrize(("load", "scale"), [(0.0, 5.0), (0.5, 5.0), (1.0, 5.0), (2.0, 2.5), (5.0, 1.0), (50.0, 1.0)])
def test_twins_on_the_screen_begin_at_a_scale_that_the_load_allows(load: float, scale: float) -> None:
    """``load`` is that of the computer by processor."""
    assert twin_scale(load) == pytest.approx(scale)


if __name__ == "__main__":
    sys.exit(pytest.main([__file__]))
