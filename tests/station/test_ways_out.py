"""Whatever ends a run, wherever: every axis at rest by a controlled stop, the recording closed, the truth told."""

from __future__ import annotations

import asyncio
import os
import random
import signal
import subprocess
import sys
from collections.abc import Coroutine, Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import h5py
import pytest
from faults import BENCHES
from guard import fill
from support import command
from test_run import bench_file, events

import station
from estimator.recordings.reading import read_recording
from station.bench.bench import load_bench
from station.cli import main
from station.opening import open_bench
from station.run.event_loop.loops import VirtualLoop, run_to_end
from station.run.outcome import Outcome
from station.run.session import Result, Session
from station.scripts.script import load_script

SCRIPT = '[[step]]\nkind = "rest"\nduration = "1 s"\n' + "".join(
    f'[[step]]\nkind = "rotate"\naxis = "{axis}"\nrate = "40 deg/s"\nacceleration = "40 deg/s2"\nduration = "3 s"\n'
    for axis in "xz"
)
ERRORS = (KeyboardInterrupt, MemoryError, OSError, ValueError, SystemExit, asyncio.CancelledError)
TOP = Path(station.__file__).parents[1]
OURS = tuple(str(TOP / package) + os.sep for package in ("station", "drivers", "estimator"))
_CALLBACKS = 5700  # of such a run, about


class Injector:
    """Raises when so many callbacks of the loop have run: in one more, or ``lines`` later in our own code.

    With ``inside`` it raises at the await that the next task goes on from; ``again`` is how many callbacks later it
    raises once more, 0 for never.
    """

    def __init__(
        self, at: int, error: type[BaseException], lines: int = 0, *, inside: bool = False, again: int = 0
    ) -> None:
        self.at, self.error, self.lines, self.inside, self.again = at, error, lines, inside, again
        self.callbacks = 0
        self.armed = False

    def count(self, handle: asyncio.Handle) -> None:
        self.callbacks += 1
        if self.again and self.callbacks == self.at + self.again:
            asyncio.get_running_loop().call_soon(self.strike)
        if self.callbacks == self.at:
            if self.inside:
                self.armed = True
            elif self.lines:
                sys.settrace(self.trace)
            else:
                asyncio.get_running_loop().call_soon(self.strike)

    def task(self, loop: asyncio.AbstractEventLoop, work: Any, **more: Any) -> asyncio.Task[Any]:
        """Make a task that it can raise in."""
        return asyncio.Task(Driven(work, self), loop=loop, **more)

    def strike(self) -> None:
        sys.settrace(None)
        raise self.error("injected")

    def trace(self, frame: FrameType, event: str, _argument: Any) -> Any:
        if not frame.f_code.co_filename.startswith(OURS):
            return None
        if event == "line":
            self.lines -= 1
            if self.lines == 0:
                self.strike()
        return self.trace


class Driven(Coroutine[Any, Any, Any]):
    """A coroutine into which an error is thrown where it awaits, when the injector is armed."""

    def __init__(self, work: Coroutine[Any, Any, Any], injector: Injector) -> None:
        self.work, self.injector = work, injector

    def send(self, value: Any) -> Any:
        if self.injector.armed:
            self.injector.armed = False
            return self.work.throw(self.injector.error("injected"))
        return self.work.send(value)

    def throw(self, *error: Any) -> Any:
        return self.work.throw(*error)

    def close(self) -> None:
        self.work.close()

    def __await__(self) -> Generator[Any, Any, Any]:
        return self.work.__await__()


@contextmanager
def injected(injector: Injector) -> Iterator[None]:
    """Count the callbacks of every loop."""
    run = asyncio.Handle._run  # type: ignore[attr-defined]

    def counted(handle: asyncio.Handle) -> None:
        injector.count(handle)
        run(handle)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asyncio.Handle, "_run", counted)
        try:
            yield
        finally:
            sys.settrace(None)


def bench_without_watchdog(folder: Path) -> Path:
    """Drives that go on turning when nobody stops them."""
    return bench_file(folder)


def ended(folder: Path, injector: Injector) -> tuple[Result, bool]:
    """Run with an injection; return how it ended and whether the table is at rest."""
    (folder / "script.toml").write_text(SCRIPT)
    bench, script = load_bench(bench_without_watchdog(folder)), load_script(folder / "script.toml")

    async def run() -> tuple[Result, bool]:
        async with open_bench(bench) as opened:
            session = Session(opened, script, folder / "run.h5")
            if injector.inside:
                asyncio.get_running_loop().set_task_factory(injector.task)
            with injected(injector):
                result = await session.run()
            await asyncio.sleep(0.01)  # rates that a drive calls zero end within that
            return result, opened.at_rest()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return run_to_end(runner, run())


def check(folder: Path, injector: Injector) -> None:
    result, at_rest = ended(folder, injector)
    assert at_rest
    assert injector.callbacks < injector.at or result.verdict.outcome is not Outcome.PASS
    if injector.error in (MemoryError, OSError):
        assert "defect of the station" not in result.verdict.reason
    with h5py.File(result.recording) as file:
        assert file.attrs["outcome"] == str(result.verdict.outcome)
        assert file.attrs["reason"] == result.verdict.reason
        rows = len(file["table/t_ns"]) if "t_ns" in file["table"] else 0
    if rows:
        assert [text for text in events(result.recording) if "rest" in text] == ["table at rest"]
    if rows > 1:
        read_recording(result.recording)


def points(count: int) -> list[Injector]:
    """Return injections spread over a run: of every kind of exception, in callbacks, in lines of our own, at awaits."""
    dice = random.Random(count)
    spread = [round((i + dice.random()) / count * _CALLBACKS) + 1 for i in range(count)]
    ways: tuple[dict[str, Any], ...] = ({}, {"lines": 30}, {"inside": True})
    return [
        Injector(
            at, error := ERRORS[i % len(ERRORS)], **ways[i // len(ERRORS) % len(ways)], again=again_after(error, dice)
        )
        for i, at in enumerate(spread)
    ]


def again_after(error: type[BaseException], dice: random.Random) -> int:
    """Return how much later it is raised again: people press Ctrl-C twice, and memory does not come back by itself."""
    return dice.randrange(1, 400) if error in (KeyboardInterrupt, MemoryError) else 0


def name_of(one: Injector) -> str:
    way = "inside" if one.inside else f"line {one.lines}"
    return f"{one.error.__name__} at {one.at} {way}" + f" and {one.again} later" * bool(one.again)


@pytest.mark.parametrize("injector", points(18), ids=name_of)
def test_whatever_is_raised_wherever_the_table_comes_to_rest_and_the_file_is_closed(
    tmp_path: Path, injector: Injector
) -> None:
    check(tmp_path, injector)


class WithinFunction(Injector):
    """Raises before the line of that number that is gone through in one function, counted over its calls."""

    def __init__(self, name: str, error: type[BaseException], lines: int) -> None:
        super().__init__(0, error, lines)
        self.name = name

    def count(self, handle: asyncio.Handle) -> None:
        self.callbacks += 1
        if self.lines > 0:
            sys.settrace(self.trace)

    def trace(self, frame: FrameType, event: str, argument: Any) -> Any:
        return super().trace(frame, event, argument) if frame.f_code.co_name == self.name else None


@pytest.mark.parametrize("line", range(40, 56, 5))
def test_ctrl_c_while_rows_are_taken_in_is_no_fault_of_a_device(tmp_path: Path, line: int) -> None:
    result, at_rest = ended(tmp_path, WithinFunction("_add_rows", KeyboardInterrupt, line))
    assert at_rest
    assert result.verdict.outcome is Outcome.ABORTED, result.verdict.reason
    assert "Ctrl-C" in result.verdict.reason


@pytest.mark.full
@pytest.mark.parametrize("injector", points(300), ids=name_of)
def test_the_same_at_300_points(tmp_path: Path, injector: Injector) -> None:
    check(tmp_path, injector)


@pytest.mark.parametrize("error", [KeyboardInterrupt, MemoryError])
def test_the_command_says_what_was_seen_and_not_that_nothing_moved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], error: type[BaseException]
) -> None:
    (tmp_path / "script.toml").write_text(SCRIPT)
    path = tmp_path / "run.h5"
    files = ["--bench", bench_without_watchdog(tmp_path), "--script", tmp_path / "script.toml", "-o", path]
    with injected(Injector(_CALLBACKS // 2, error)):
        assert main(["run", *map(str, files)]) == Outcome.ABORTED.exit_code
    said = capsys.readouterr()
    assert ("stopped by Ctrl-C in step" if error is KeyboardInterrupt else "MemoryError") in said.out
    assert "Traceback" not in said.err
    assert "before anything moved" not in said.err + said.out
    assert events(path)[-1] == "table at rest"


def test_a_device_that_is_not_there_is_known_before_the_table_is_touched(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = ["--bench", BENCHES / "rtu_stim300.toml", "-o", tmp_path / "run.h5"]
    assert main(["run", *map(str, files), "--link", "stim300=serial:///dev/none"]) == Outcome.FAULT.exit_code
    assert "stim300: " in capsys.readouterr().out
    with h5py.File(tmp_path / "run.h5") as file:
        assert "table_model" not in file.attrs
        assert "text" not in file.get("events", {})


@pytest.mark.skipif(os.name != "posix", reason="signals of a POSIX terminal")
@pytest.mark.parametrize(("number", "name"), [("SIGQUIT", "Ctrl-\\"), ("SIGTSTP", "Ctrl-Z"), ("SIGTERM", "SIGTERM")])
def test_no_key_of_a_terminal_leaves_the_table_turning(tmp_path: Path, number: str, name: str) -> None:
    (tmp_path / "script.toml").write_text(SCRIPT)
    bench, script = load_bench(bench_without_watchdog(tmp_path)), load_script(tmp_path / "script.toml")
    before = signal.signal(getattr(signal, number), signal.SIG_IGN)

    async def run() -> tuple[Result, bool]:
        async with open_bench(bench) as opened:
            session = Session(opened, script, tmp_path / "run.h5")
            asyncio.get_running_loop().call_later(4.0, signal.raise_signal, getattr(signal, number))
            result = await session.run()
            await asyncio.sleep(0.01)
            return result, opened.at_rest()

    try:
        with asyncio.Runner(loop_factory=VirtualLoop) as runner:
            result, at_rest = run_to_end(runner, run())
        assert signal.getsignal(getattr(signal, number)) is signal.SIG_IGN
    finally:
        signal.signal(getattr(signal, number), before)
    assert at_rest
    assert result.verdict.reason.startswith(f"stopped by {name} in step")
    assert events(result.recording)[-1] == "table at rest"


@pytest.mark.skipif(os.name != "posix", reason="pipes and terminals of POSIX")
def test_a_run_does_not_wait_for_a_terminal_that_is_held_or_a_pipe_that_nobody_reads(tmp_path: Path) -> None:
    (tmp_path / "script.toml").write_text(SCRIPT)
    unread, stderr = os.pipe()
    fill(stderr)
    words = command("run", "--script", tmp_path / "script.toml", "-o", tmp_path / "run.h5")
    ended = subprocess.run(words, stdout=subprocess.DEVNULL, stderr=stderr, timeout=60, check=False)
    os.close(unread)
    os.close(stderr)
    assert ended.returncode in (Outcome.PASS.exit_code, Outcome.FAIL.exit_code)
    assert events(tmp_path / "run.h5")[-1] == "table at rest"


def test_a_table_that_brakes_for_half_a_minute_is_stopped_and_not_cut_off(tmp_path: Path) -> None:
    turn = 'kind = "rotate"\naxis = "x"\nrate = "60 deg/s"\nacceleration = "2 deg/s2"\nduration = "60 s"\n'
    (tmp_path / "script.toml").write_text(f"[[step]]\n{turn}")
    slow = bench_file(tmp_path, ('"50 deg/s2"', '"2 deg/s2"'), end='\n[twin.array.fault]\nsilent_from = "35 s"\n')
    bench, script = load_bench(slow), load_script(tmp_path / "script.toml")

    async def run() -> tuple[Result, bool]:
        async with open_bench(bench) as opened:
            result = await Session(opened, script, tmp_path / "run.h5").run()
            await asyncio.sleep(0.01)  # rates that a drive calls zero end within that
            return result, opened.at_rest()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        result, at_rest = run_to_end(runner, run())
    assert at_rest
    assert result.verdict.reason == "array: gyro1, gyro2, gyro3, gyro4 fell silent for 1 s"
    assert events(result.recording)[-1] == "table at rest"
    with h5py.File(result.recording) as file:
        assert file["events/t_ns"][-1] > 55e9


@pytest.mark.parametrize("busy_s", [0.0, 1.2])
def test_silence_while_the_computer_did_not_keep_up_names_the_computer(tmp_path: Path, busy_s: float) -> None:
    (tmp_path / "script.toml").write_text(SCRIPT)
    silent = bench_file(tmp_path, end='\n[twin.array.fault]\nsilent_from = "4 s"\n')
    bench, script = load_bench(silent), load_script(tmp_path / "script.toml")

    async def run() -> Result:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualLoop)

        def be_busy(so_long_s: float) -> None:
            loop._now += so_long_s

        loop.call_later(1.0, be_busy, 0.1)  # long before, and no cause of anything
        loop.call_later(4.1, be_busy, busy_s)
        async with open_bench(bench) as opened:
            return await Session(opened, script, tmp_path / "run.h5").run()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        reason = run_to_end(runner, run()).verdict.reason
    assert "fell silent for 1 s" in reason
    assert reason.startswith("host: this computer fell behind by 1200 ms: close other programs") == bool(busy_s), reason
