"""Manual mode: a person drives the table by words; what holds in a run holds here, and nobody judges it."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path

import h5py
import pytest

from estimator.recordings.reading import read_recording
from station.bench.bench import Bench, default_bench_text, load_bench
from station.cli import main
from station.errors import UsageError
from station.opening import OpenBench, open_bench
from station.run.event_loop.loops import VirtualLoop
from station.run.outcome import Outcome
from station.run.session import Result, RunOptions, Session
from station.run.snapshot import AxisSnapshot, Phase
from station.scripts.script import Script

BENCHES = Path(__file__).parents[1] / "data" / "benches"
DEG = math.pi / 180
TEXTUAL = ("galil_xsens", "acutrol_vectornav")
Operator = Callable[["Hand"], Awaitable[None]]


class Hand:
    """An operator at a session, in virtual time."""

    def __init__(self, session: Session, opened: OpenBench) -> None:
        self.session, self.opened = session, opened

    def say(self, action: str, **given: object) -> None:
        self.session.drive(action, given)

    @property
    def holds(self) -> bool:
        return self.session.snapshot().label == "holding"

    def axis(self, name: str) -> AxisSnapshot:
        return next(axis for axis in self.session.snapshot().axes if axis.name == name)

    async def until(self, holds: Callable[[], bool], limit_s: float = 60.0) -> float:
        """Wait; return how long it took."""
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        async with asyncio.timeout(limit_s):
            while not holds():
                await asyncio.sleep(0.1)
        return loop.time() - began_s

    async def at_rest(self, name: str) -> float:
        return await self.until(lambda: self.axis(name).rate_rps == 0.0 and self.holds)

    async def hold_key(self, name: str, rate_rps: float, time_s: float, every_s: float = 0.1) -> None:
        for _ in range(round(time_s / every_s)):
            self.say("jog", axis=name, rate_rps=rate_rps)
            await asyncio.sleep(every_s)


def by_hand(folder: Path, bench: Bench, operate: Operator) -> Result:
    """Run a manual session in virtual time, operated once it is ready."""

    async def main() -> Result:
        async with open_bench(bench) as opened:
            session = Session(opened, Script("manual", ()), folder / "m.h5", RunOptions(manual=True))
            hand = Hand(session, opened)

            async def operator() -> None:
                await hand.until(lambda: session.snapshot().phase is Phase.RUNNING)
                await operate(hand)

            operating = asyncio.create_task(operator())
            result = await session.run()
            await operating
            await asyncio.sleep(0.01)
            assert opened.at_rest()
            return result

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(main())


def bench_of(folder: Path, name: str = "", more: str = "", travel: str = "") -> Bench:
    text = (BENCHES / f"{name}.toml").read_text() if name else default_bench_text()
    if travel:
        text = text.replace("[table.x]\n", f"[table.x]\ntravel = {travel}\n")
    (folder / "bench.toml").write_text(f"{text}\n{more}")
    return load_bench(folder / "bench.toml")


def ended(file: Path) -> tuple[str, list[str]]:
    with h5py.File(file) as found:
        return str(found.attrs["outcome"]), [
            label.decode() for label in found["steps/label"]
        ] if "steps" in found else []


@pytest.mark.parametrize("name", ["", *(pytest.param(n, marks=pytest.mark.full) for n in TEXTUAL)])
def test_a_jog_ends_soon_after_the_last_word_and_is_recorded_and_not_judged(tmp_path: Path, name: str) -> None:
    async def operate(hand: Hand) -> None:
        await hand.hold_key("y", 10 * DEG, 2.0)
        assert math.isclose(hand.axis("y").rate_rps, 10 * DEG, rel_tol=0.02)
        assert await hand.at_rest("y") < 1.5
        there = hand.axis("y").angle_rad
        await asyncio.sleep(2.0)
        assert abs(hand.axis("y").angle_rad - there) < 0.05 * DEG
        hand.say("go", axis="y", angle_rad=-5 * DEG, rate_rps=20 * DEG)
        await hand.until(lambda: hand.session.snapshot().label.startswith("y to -5"))
        await hand.at_rest("y")
        assert abs(hand.axis("y").angle_rad + 5 * DEG) < 0.05 * DEG
        hand.say("home", axis="y", rate_rps=20 * DEG)
        await asyncio.sleep(0.2)
        await hand.at_rest("y")
        assert abs(hand.axis("y").angle_rad) < 0.05 * DEG
        hand.say("end")

    result = by_hand(tmp_path, bench_of(tmp_path, name), operate)
    assert (result.verdict.outcome, result.calibration) == (Outcome.MANUAL, None)
    assert all(len(data.t_ns) > 500 for data in read_recording(result.recording).sources.values())
    outcome, steps = ended(result.recording)
    assert outcome == "MANUAL"
    assert [step.split(" ")[0] for step in steps] == ["jog", "y", "y"]


@pytest.mark.full
def test_what_is_made_of_a_manual_recording_later_never_is_a_pass_nor_a_certificate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def operate(hand: Hand) -> None:
        await hand.hold_key("y", 20 * DEG, 4.0)
        hand.say("end")

    result = by_hand(tmp_path, bench_of(tmp_path), operate)
    assert main(["calibrate", "--write", "--json", str(result.recording)]) == 0
    assert json.loads(capsys.readouterr().out)["outcome"] == "MANUAL"
    assert main(["report", str(result.recording)]) == 0
    text = " ".join(result.recording.with_suffix(".html").read_text().split())
    assert "This is not a calibration certificate: the table was driven by hand" in text


def test_stop_in_a_jog_brings_the_table_to_rest_as_in_a_run(tmp_path: Path) -> None:
    told_s: list[float] = []

    async def operate(hand: Hand) -> None:
        await hand.hold_key("z", -40 * DEG, 1.5)
        told_s.append(asyncio.get_running_loop().time())
        hand.session.stop()

    result = by_hand(tmp_path, bench_of(tmp_path), operate)
    assert result.verdict.outcome is Outcome.ABORTED
    with h5py.File(result.recording) as file:
        assert file["events/text"][-1] == b"table at rest"
        assert file["events/t_ns"][-1] * 1e-9 - told_s[0] < 1.5


def test_hold_stays_where_it_comes_to_rest_and_another_word_takes_the_place_of_the_last(tmp_path: Path) -> None:
    async def operate(hand: Hand) -> None:
        hand.say("go", axis="x", angle_rad=90 * DEG, rate_rps=20 * DEG)
        await asyncio.sleep(1.0)
        hand.say("hold")
        await hand.at_rest("x")
        there = hand.axis("x").angle_rad
        assert 10 * DEG < there < 60 * DEG
        await asyncio.sleep(2.0)
        assert abs(hand.axis("x").angle_rad - there) < 0.05 * DEG
        hand.say("go", axis="x", angle_rad=90 * DEG, rate_rps=20 * DEG)
        await asyncio.sleep(1.0)
        await hand.hold_key("y", 10 * DEG, 2.0)
        assert hand.axis("x").rate_rps == 0.0
        assert hand.axis("y").rate_rps > 5 * DEG
        hand.say("home", rate_rps=40 * DEG)  # all axes, one after another
        await asyncio.sleep(0.2)
        await hand.until(lambda: hand.holds)
        assert all(abs(hand.axis(name).angle_rad) < 0.05 * DEG for name in "xyz")
        hand.say("end")

    assert by_hand(tmp_path, bench_of(tmp_path), operate).verdict.outcome is Outcome.MANUAL


def test_what_is_beyond_the_limits_of_the_bench_is_refused_in_words_and_a_jog_ends_at_the_end_of_the_travel(
    tmp_path: Path,
) -> None:
    async def operate(hand: Hand) -> None:
        for words, action, given in (
            ("outside its travel of -20 to 30 deg", "go", {"axis": "x", "angle_rad": 31 * DEG, "rate_rps": 1.0}),
            ("exceeds the limit of axis x, ", "go", {"axis": "x", "angle_rad": 0.1, "rate_rps": 9999.0}),
            ("exceeds the limit of axis y, ", "jog", {"axis": "y", "rate_rps": -9999.0}),
            ("exceeds the limit of axis y, ", "jog", {"axis": "y", "rate_rps": 0.1, "acceleration_rps2": 9999.0}),
            ("must not be zero", "jog", {"axis": "y", "rate_rps": 0}),
            ("no axis q", "jog", {"axis": "q", "rate_rps": 0.1}),
            ("unknown request", "jog", {"axis": "x"}),
            ("unknown request", "jog", {"axis": "x", "rate_rps": math.nan}),
            ("unknown request", "go", {"axis": "y", "angle_rad": math.inf, "rate_rps": 0.1}),
            ("unknown request", "jog", {"axis": "y", "rate_rps": 10**401}),
            ("unknown request", "jog", {"axis": "y", "rate_rps": 5e-324}),
            ("unknown request", "jog", {"axis": "y", "rate_rps": True}),
            ("unknown request", "dance", {}),
        ):
            with pytest.raises(UsageError, match=words):
                hand.say(action, **given)
        with pytest.raises(UsageError, match="manual"):
            hand.session.pause()
        assert hand.holds
        seen = []
        for _ in range(15):
            with suppress(UsageError):
                await hand.hold_key("x", 20 * DEG, 0.2)
            seen.append(hand.axis("x").angle_rad)
        assert 29.9 * DEG < max(seen) < 30.05 * DEG
        with pytest.raises(UsageError, match="end of its travel"):
            hand.say("jog", axis="x", rate_rps=0.1)
        hand.say("hold", who="whatever else is said")
        hand.say("end")
        hand.say("hold")
        with pytest.raises(UsageError, match="unknown request"):
            hand.say("jog", axis="y", rate_rps=0.1)

    bench = bench_of(tmp_path, travel='["-20 deg", "30 deg"]')
    assert by_hand(tmp_path, bench, operate).verdict.outcome is Outcome.MANUAL


@pytest.mark.full
def test_an_axis_that_turns_by_itself_in_manual_mode_is_a_fault(tmp_path: Path) -> None:
    async def operate(hand: Hand) -> None:
        with suppress(UsageError):  # the script has ended
            while True:
                await hand.hold_key("y", 5 * DEG, 0.2)

    fault = '[twin.fault]\naxis = "x"\nat = "9 s"\nkind = "runaway"'
    result = by_hand(tmp_path, bench_of(tmp_path, more=fault), operate)
    assert result.verdict.outcome is Outcome.FAULT
    assert "axis x turns at" in result.verdict.reason


def test_an_interlock_that_opens_is_named_and_check_says_so_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    async def operate(hand: Hand) -> None:
        with suppress(UsageError):  # the session has ended
            while True:
                await hand.hold_key("y", 5 * DEG, 0.2)

    fault = '[twin.fault]\naxis = "x"\nat = "{at} s"\nkind = "interlock"'
    result = by_hand(tmp_path, bench_of(tmp_path, "acutrol_vectornav", fault.format(at=6)), operate)
    assert result.verdict.outcome is Outcome.FAULT
    assert "interlock open, or emergency stop pressed" in result.verdict.reason
    bench_of(tmp_path, "acutrol_vectornav", fault.format(at=0))
    assert main(["check", str(tmp_path / "bench.toml"), "--json"]) == 4
    assert "interlock open, or emergency stop pressed" in capsys.readouterr().out
