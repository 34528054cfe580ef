"""Who calibrates which device, on the screen: nothing of yesterday is taken for today's."""

from __future__ import annotations

import asyncio
import functools
import re
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
from conftest import keys, until
from textual import events
from textual.pilot import Pilot
from textual.widgets import Button, Input

from station.screen.app import StationApp
from station.screen.choices import Choices
from station.screen.memory import Remembered, save_remembered

DAY_S = 86_400


def app_on(place: Path, **chosen: str) -> StationApp:
    """Return an app with a script of the place and the one device that tells a serial number."""
    words = {"script": "short.toml", "device_options": ("--device", "stim300"), **chosen}
    return StationApp(Choices(folder=place / "recordings", **words))  # type: ignore[arg-type]


def shown(app: StationApp, name: str) -> str:
    """Return what a part of the screen shows."""
    return " ".join(str(app.screen.query_one(f"#{name}").render()).split())


def value(app: StationApp, name: str) -> str:
    """Return what stands in a field."""
    return app.screen.query_one(f"#{name}", Input).value


def driven(test: Callable[[Path], Coroutine[Any, Any, None]]) -> Callable[[Path], None]:
    """Make a test of a coroutine."""

    @functools.wraps(test)
    def run(place: Path) -> None:
        asyncio.run(test(place))

    return run


async def asked(pilot: Pilot[None], app: StationApp) -> None:
    """Wait until the devices have been asked and the plan is there."""
    await until(pilot, lambda: "OK stim300" in shown(app, "check") and "WAIT" not in shown(app, "ready"))


@driven
async def test_the_serial_number_is_what_the_device_says_and_another_needs_a_reason(place: Path) -> None:
    bench = place / "free.toml"
    bench.write_text((place / "bench.toml").read_text().replace('serial_pattern = "SN-[0-9]{4}"', ""))
    app = app_on(place, bench=str(bench))
    async with app.run_test(size=(120, 40)) as pilot:
        await asked(pilot, app)
        told = value(app, "serial")
        assert told
        assert told in shown(app, "check")
        await pilot.press(*keys("A. Operator"), "tab", *keys("x"))
        assert value(app, "serial") == "x"  # in place of what was filled in
        assert f"the device reports serial no. {told}" in shown(app, "ready")
        assert app.screen.query_one("#start", Button).disabled
        await pilot.press("f8", *keys("label of the customer"), "enter")
        await until(pilot, lambda: "nothing is missing" in shown(app, "ready"))
        run = app.choices.run_arguments(Path("r.h5"), None)
        assert run[run.index("--serial-reason") + 1] == "label of the customer"
        await pilot.press(*keys("y"))  # another number: what was confirmed was not this one
        assert "the device reports serial no." in shown(app, "ready")


@pytest.mark.full
@driven
async def test_the_number_of_the_last_device_is_not_taken_for_that_of_the_next(place: Path) -> None:
    state = place / "state/turntable-station/screen.json"
    state.parent.mkdir(parents=True)
    state.write_text('{"operator": "A. Operator", "bench": "", "script": "", "serials": {"built-in bench": "SN-0001"}}')
    app = StationApp(Choices(script="short.toml"))  # two devices under test, of which neither is the whole
    async with app.run_test(size=(120, 40)) as pilot:
        await until(pilot, lambda: "OK array" in shown(app, "check"))
        assert value(app, "serial") == ""


@driven
async def test_who_operates_is_confirmed_each_shift(place: Path) -> None:
    save_remembered(Remembered("A. Operator", operator_utc_s=time.time() - DAY_S))
    app = app_on(place)
    async with app.run_test(size=(120, 40)) as pilot:
        await asked(pilot, app)
        assert "is the operator still A. Operator?" in shown(app, "ready")
        await pilot.press("shift+tab", "enter")
        assert value(app, "operator") == "A. Operator"
        assert "is the operator still" not in shown(app, "ready")


@driven
async def test_a_real_bench_of_the_last_run_is_named_and_not_opened_by_itself(place: Path) -> None:
    real = place / "lab.toml"
    text = (place / "bench.toml").read_text()
    line = next(line for line in text.splitlines() if line.startswith("link = "))
    text = text.replace(line, 'link = "tcp://127.0.0.1:1"', 1)
    real.write_text(re.sub(r"^name = .*$", 'name = "lab 3"', text, count=1, flags=re.MULTILINE))
    save_remembered(Remembered("A. Operator", str(real), "", time.time()))
    app = app_on(place)
    async with app.run_test(size=(120, 40)) as pilot:
        await until(pilot, lambda: "F6 opens it" in shown(app, "ready"))
        assert "bench lab 3 was used in the last run" in shown(app, "check")
        assert value(app, "bench") == str(real)
        await pilot.press("f6")
        await until(pilot, lambda: "nothing answers" in shown(app, "ready"))


@driven
async def test_what_follows_tab_goes_into_the_next_field(place: Path) -> None:
    app = app_on(place)
    async with app.run_test(size=(120, 40)) as pilot:
        app.screen.query_one("#operator", Input).focus()
        await pilot.pause()
        for key in (*keys("someone"), "tab", *keys("SN7")):  # as a scanner types: nothing is waited for
            app.simulate_key(key)
        await until(pilot, lambda: value(app, "serial"))
        await pilot.pause()
        assert (value(app, "operator"), value(app, "serial")) == ("someone", "SN7")


@pytest.mark.full
@driven
async def test_a_script_that_is_set_while_the_last_is_looked_at_is_read(place: Path) -> None:
    app = app_on(place)
    async with app.run_test(size=(120, 40)) as pilot:
        await asked(pilot, app)
        (place / "next.toml").write_text((place / "short.toml").read_text().replace('"short"', '"next"'))
        app.prepare(str(place / "next.toml"))
        await until(pilot, lambda: "next" in shown(app, "plan") and "WAIT" not in shown(app, "ready"), 30)


@driven
async def test_a_scanned_serial_number_goes_to_its_field_wherever_the_focus_is(place: Path) -> None:
    app = app_on(place, bench="bench.toml", operator="A. Turing")
    async with app.run_test() as pilot:
        await asked(pilot, app)
        before = {name: value(app, name) for name in ("bench", "script", "operator")}
        for number, at in enumerate(["bench", "script", "operator", "start", None], 43):
            app.screen.query_one("#start", Button).disabled = False
            app.screen.set_focus(app.screen.query_one(f"#{at}") if at else None)
            for key in (*keys(f"SN-00{number}"), "enter"):  # all at once, as a scanner
                app.post_message(events.Key(key, {"minus": "-"}.get(key, key) if key != "enter" else "\r"))
            await until(pilot, lambda: value(app, "serial") == f"SN-00{number}")  # noqa: B023  awaited here
            assert {name: value(app, name) for name in before} == before, at
            assert app.shown is None, at  # no run has begun by the Enter of a scan
