"""The label of a step is a text for people: the run's phase, its pause and its end do not go by it."""

from __future__ import annotations

import asyncio
from pathlib import Path

import h5py
import pytest
from test_run import bench_file

from station.bench.bench import load_bench
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.session import Result, Session
from station.run.snapshot import EventKind, Phase, Snapshot
from station.scripts.script import load_script

LABELS = ("finishing", "estimating", "coming to rest", "homing")


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("labels") / "script.toml"
    path.write_text("".join(f'[[step]]\nkind = "rest"\nduration = "2 s"\nlabel = "{label}"\n' for label in LABELS))
    return path


def test_steps_of_any_label_run_are_paused_and_end_as_others(tmp_path: Path, script: Path) -> None:
    seen: list[Snapshot] = []
    kinds: list[EventKind] = []

    async def look(session: Session) -> None:
        while True:
            seen.append(session.snapshot())
            if seen[-1].label == "finishing" and not seen[-1].paused:
                session.pause()
            if seen[-1].paused == "paused":
                session.resume()
            await asyncio.sleep(0.5)

    async def run() -> Result:
        async with open_bench(load_bench(bench_file(tmp_path))) as opened:
            told = lambda t_s, kind, text: kinds.append(kind)  # noqa: E731
            session = Session(opened, load_script(script), tmp_path / "r.h5", on_event=told)
            looking = asyncio.create_task(look(session))
            result = await session.run()
            looking.cancel()
            return result

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        result = runner.run(run())
    assert {s.label for s in seen if s.phase is Phase.RUNNING} == {*LABELS, "pause"}
    assert all((s.phase is Phase.RUNNING) == (s.elapsed_s > 0) for s in seen)
    assert any(s.paused == "paused" for s in seen)
    assert kinds == [EventKind.SCRIPT] * 4 + [EventKind.AT_REST]
    with h5py.File(result.recording) as file:
        assert [label.decode() for label in file["steps/label"]] == [LABELS[0], "pause", *LABELS[1:]]
        assert [kind.decode() for kind in file["events/kind"]] == kinds
