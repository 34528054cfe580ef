"""A run that dies at any time of its script: its recording is made whole from the journal beside it."""

from __future__ import annotations

import asyncio
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from estimator.recordings.journal import journal_of
from estimator.recordings.reading import read_recording
from station.bench.bench import Bench, default_bench_text, load_bench
from station.cli import main
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Session
from station.scripts.script import Rest, Rotate, Script

RATE, ACCELERATION = math.radians(40), math.radians(40)
SCRIPT = Script(
    "short", (Rest(4, "rest"), *(Rotate(axis, RATE, 11.0, ACCELERATION, f"{axis}") for axis in "xyz"), Rest(4, "rest"))
)
DEATHS_S = (3.0, 15.0, 24.0, 33.0, 40.5)


def bench_in(folder: Path, seed: int = 0) -> Bench:
    (folder / "bench.toml").write_text(default_bench_text().replace("seed = 0", f"seed = {seed}"))
    return load_bench(folder / "bench.toml")


@pytest.fixture(scope="module")
def deaths(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the whole run, and with what it would have left had it died at some moments of its script."""
    folder = tmp_path_factory.mktemp("deaths")
    (folder / "run").mkdir()
    due_s = list(DEATHS_S)

    def look(snapshot: Callable[[], Any]) -> None:
        if due_s and snapshot().elapsed_s >= due_s[0]:
            shutil.copytree(folder / "run", folder / f"at-{due_s.pop(0):g}")

    async def run() -> None:
        async with open_bench(bench_in(folder)) as opened:
            await Session(opened, SCRIPT, folder / "run" / "run.h5", on_progress=look).run()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())
    assert not due_s
    return folder


@pytest.mark.parametrize("death_s", DEATHS_S)
@pytest.mark.parametrize("torn", [False, True], ids=["recording as it was", "recording torn"])
def test_a_run_that_dies_leaves_all_but_its_last_seconds(
    deaths: Path, tmp_path: Path, death_s: float, torn: bool
) -> None:
    path = shutil.copytree(deaths / f"at-{death_s:g}", tmp_path / "left") / "run.h5"
    if torn:
        path.write_bytes(path.read_bytes()[:3000])
    left, whole = read_recording(path), read_recording(deaths / "run" / "run.h5")
    for name, source in whole.sources.items():
        found = left.sources[name]
        assert found.t_ns[-1] * 1e-9 > death_s - 2.1  # in virtual time the journal is written every 2 s
        np.testing.assert_array_equal(found.t_ns, source.t_ns[: len(found.t_ns)])
        np.testing.assert_array_equal(found.rate_rps, source.rate_rps[: len(found.t_ns)])
    with h5py.File(path) as file, h5py.File(deaths / "run" / "run.h5") as all_of_it:
        for group in ("innovation", "estimate") if death_s > 20 else ():
            for name, source in all_of_it[group].items():
                t_ns = file[group][name]["t_ns"][()]
                assert t_ns[-1] * 1e-9 > death_s - 15  # 50 blocks are written together
                np.testing.assert_array_equal(t_ns, source["t_ns"][: len(t_ns)])
    assert not path.with_name("run.h5.journal").exists()


def test_a_run_that_died_near_its_end_is_calibrated(
    deaths: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = shutil.copytree(deaths / "at-40.5", tmp_path / "left") / "run.h5"
    path.write_bytes(path.read_bytes()[:3000])
    main(["calibrate", str(path), "--json"])
    assert len(json.loads(capsys.readouterr().out)["gyros"]) == 4


def test_a_journal_beside_the_recording_of_another_run_of_the_same_script_is_left_alone(
    deaths: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "good.h5"
    shutil.copy(deaths / "run" / "run.h5", path)
    before = path.read_bytes()

    async def run() -> None:
        def keep(snapshot: Callable[[], Any]) -> None:
            if snapshot().elapsed_s > 6 and not journal_of(path).exists():
                shutil.copy(journal_of(other), journal_of(path))
                session.stop()

        other = tmp_path / "other.h5"
        async with open_bench(bench_in(tmp_path, seed=1)) as opened:
            session = Session(opened, SCRIPT, other, on_progress=keep)
            await session.run()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())
    journal = journal_of(path).read_bytes()
    assert read_recording(path).attributes["outcome"] != "ABORTED"
    assert "it belongs to another run than good.h5" in caplog.text
    assert path.read_bytes() == before
    assert journal_of(path).read_bytes() == journal
    assert sorted(file.name for file in tmp_path.iterdir()) == ["bench.toml", "good.h5", "good.h5.journal", "other.h5"]
