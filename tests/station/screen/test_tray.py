"""A tray of devices on the screen: filled by a scanner, run one after another, kept when anything comes between."""

from __future__ import annotations

import re
import resource
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from conftest import keys, until
from streams import RECORDING, TINY, Replay
from test_facts import entered, form_of, keep
from test_who_and_which import driven, shown
from textual import events
from textual.app import App
from textual.command import CommandList, CommandPalette
from textual.pilot import Pilot
from textual.widgets import DataTable, OptionList

from station.report.dcc import validate
from station.screen.app import StationApp
from station.screen.choices import Choices
from station.screen.memory import Remembered, save_remembered
from station.screen.sessions.tray import Tray, TrayItem

FIRST, SECOND = "N25582405002002", "N25582405002003"
"""What the device says that stands on the bench, and the other one of its kind that may be put there."""


class TrayFirst(StationApp):
    """An app that does not begin by asking devices."""

    DEFAULT_MODE = "tray"


def column(app: App[None], name: str) -> list[str]:
    """Return one column of the tray."""
    at = ("number", "serial", "script", "state", "recording").index(name)
    lines = [str(option.prompt) for option in app.screen.query_one(OptionList).options]
    return [re.split("  +| (?=SN|N2|short|next|tiny)", line.strip() + "  ")[at] for line in lines]


def scan(app: App[None], *numbers: str, end: str = "enter") -> None:
    """Type as a scanner does: nothing is waited for."""
    for number in numbers:
        for letter in number:
            app.post_message(events.Key(*keys(letter), letter))
        app.post_message(events.Key(end, None))


@contextmanager
def full_disk() -> Iterator[None]:
    """Let no file grow meanwhile, for root neither."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@driven
async def test_the_name_of_a_field_is_marked_while_the_field_has_the_focus(place: Path) -> None:
    app = TrayFirst(Choices())

    def marked() -> list[str]:
        return [str(label.render()) for label in app.screen.query(".field Label") if label.rich_style.reverse]

    async with app.run_test(size=(80, 24)) as pilot:
        for key, names in (("home", ["Scan"]), ("shift+tab", ["Scripts"]), ("tab", ["Scan"]), ("tab", [])):
            await pilot.press(key)
            await pilot.pause()
            assert marked() == names


@driven
async def test_what_is_scanned_makes_a_tray_that_can_be_put_in_order_and_is_kept(place: Path) -> None:
    (place / "next.toml").write_text(TINY)
    chosen = Choices(bench="bench.toml", script="short.toml", operator="A. Operator")
    app = TrayFirst(chosen)
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: app.focused is not None and app.focused.id == "scan")
        scan(app, "SN-0001", "SN-0002")
        scan(app, "SN-0003", end="tab")
        scan(app, "SN-0002")  # a second time
        await until(pilot, lambda: app.screen.query("Toast"))
        await until(pilot, lambda: column(app, "serial") == ["SN-0001", "SN-0002", "SN-0003"])
        assert column(app, "script") == ["short"] * 3
        await pilot.press("shift+tab", "end", "comma", *keys(" next.toml"), "tab")
        scan(app, "SN-0004")  # with two scripts
        await until(pilot, lambda: column(app, "script")[3:] == ["short", "next"])
        await pilot.press("tab", "down", "minus", "down", "s", "down", "down", "delete")
        await until(pilot, lambda: column(app, "serial") == ["SN-0002", "SN-0001", "SN-0003", "SN-0004"])
        assert column(app, "state") == ["waiting", "skipped", "waiting", "waiting"]
    app = TrayFirst(chosen)
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: len(column(app, "serial")) == 4)
        await pilot.press("tab", "down", "s")
        await until(pilot, lambda: column(app, "state") == ["waiting"] * 4)
    app = TrayFirst(Choices(script="short.toml"))  # another bench has another tray
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.focused is not None)
        assert not column(app, "serial")


@pytest.mark.skipif(sys.platform == "darwin", reason="its limit of file sizes kills")
@driven
async def test_a_change_of_the_tray_that_cannot_be_stored_is_reported(place: Path) -> None:
    Tray(str(place / "bench.toml")).keep([TrayItem("SN-0001"), TrayItem("SN-0002"), TrayItem("SN-0003", state="PASS")])
    app = TrayFirst(Choices(bench="bench.toml", operator="A. Operator"))
    async with app.run_test(size=(80, 24), notifications=True) as pilot:
        await until(pilot, lambda: len(column(app, "serial")) == 3)
        await until(pilot, lambda: app.focused is not None and app.focused.id == "scan")
        await pilot.press("tab")
        with full_disk():
            for key in ("plus", "s", "delete", "c"):
                await pilot.press(key)
                await until(pilot, lambda: "NOT kept" in " ".join(str(t.render()) for t in app.screen.query("Toast")))
                app.clear_notifications()
                await until(pilot, lambda: not app.screen.query("Toast"))
                assert column(app, "serial") == ["SN-0001", "SN-0002", "SN-0003"], key


@pytest.mark.parametrize(
    ("stream", "outcome"), [("fault", "FAULT"), pytest.param("stopped", "ABORTED", marks=pytest.mark.full)]
)
def test_a_tray_that_is_interrupted_does_not_go_on_by_itself(place: Path, stream: str, outcome: str) -> None:
    bench, recording = str(place / "bench.toml"), str(place / RECORDING)
    spots = [TrayItem("SN-0042", state="running", recording=recording), TrayItem("SN-0042", str(place / "short.toml"))]
    Tray(bench).keep(spots)

    @driven
    async def follow(place: Path) -> None:
        app = StationApp(Choices(bench="bench.toml", operator="A. Operator"), attach=True)
        async with app.run_test(size=(80, 24)) as pilot:
            await until(pilot, lambda: app.shown and app.shown.outcome)
            session.vanish()
            assert app.current_mode == "run"
            await pilot.press("f10")
            await until(pilot, lambda: column(app, "state") == [outcome, "waiting"])
            assert len(app.screen_stack) == 1  # and nothing is asked
            await pilot.press("f7")
            await until(pilot, lambda: "SN-0042" in shown(app, "question"))

    with Replay(stream, 1e9) as session:
        follow(place)


def test_a_run_that_is_gone_without_an_outcome_is_told_when_the_tray_is_seen_again(place: Path) -> None:
    Tray(str(place / "bench.toml")).keep([TrayItem("SN-0042", state="running", recording=str(place / "gone.h5"))])

    @driven
    async def look(place: Path) -> None:
        app = TrayFirst(Choices(bench="bench.toml", operator="A. Operator"))
        async with app.run_test(size=(80, 24)) as pilot:
            await until(pilot, lambda: column(app, "state") == ["no result"])

    look(place)


class Day:
    """An operator with a tray on the bench of the device that tells a serial number, and what stands on its table."""

    def __init__(self, place: Path, limits: str = "", scale: float = 5.0) -> None:
        """``limits`` are lines of the bench file; how well a busy host keeps time is not to be judged."""
        text = (place / "bench.toml").read_text().replace('serial_pattern = "SN-[0-9]{4}"', "")
        text = re.sub(r'(name = "array"(?s:.*?)\[imu.datasheet\])', r"used = false\n\1", text)
        text = text.replace("used = false         ", "used = true         ").replace('"500 Hz"', '"125 Hz"')
        text = re.sub(r"(?s)(\[limits\])(.*?)\n\n", rf"\1\n{limits}\n\n", text)
        self.bench, self._text = place / "bench.toml", text
        (place / "tiny.toml").write_text(TINY)
        self.mount(FIRST)
        save_remembered(Remembered())
        self.app = StationApp(Choices("bench.toml", "tiny.toml", place / "recordings", "A. Operator", scale=scale))

    def mount(self, number: str, scale_factor_error_ppm: int = 300, more: str = "") -> None:
        """Put a device onto the table; ``more`` are further tables of the bench file."""
        another = "" if number == FIRST else '\n[twin.stim300.fault]\nanother = "0 s"\n'
        self.bench.write_text(self._text.replace('"300 ppm"', f'"{scale_factor_error_ppm} ppm"') + another + more)

    async def seen(self, pilot: Pilot[None], holds: Callable[[], Any]) -> None:
        """Wait until something is shown."""
        await until(pilot, lambda: self.app.is_running and holds(), 100)

    async def begin(self, pilot: Pilot[None], *numbers: str) -> None:
        """Make a tray and begin with it."""
        await pilot.press("f10")
        await self.seen(pilot, lambda: self.app.current_mode == "tray" and self.app.focused is not None)
        scan(self.app, *numbers)
        await self.seen(pilot, lambda: column(self.app, "serial") == list(numbers))
        await pilot.press("f7")
        await self.asked_for(pilot, numbers[0])

    async def asked_for(self, pilot: Pilot[None], number: str) -> None:
        """Wait until a device is to be mounted."""
        await self.seen(pilot, lambda: f"Mount {number}" in shown(self.app, "question"))


@driven
async def test_a_device_of_a_tray_is_calibrated_when_its_number_is_scanned(place: Path) -> None:
    day = Day(place)
    app = day.app
    async with app.run_test(size=(80, 24)) as pilot:
        await day.begin(pilot, FIRST, "SN-9")
        scan(app, "SN-9")
        app.post_message(events.Key("enter", None))  # the last of a scanner that ends with two of them
        await day.seen(pilot, lambda: "SN-9 is not" in shown(app, "question"))
        await pilot.press("enter", "enter")
        assert app.current_mode == "tray"
        assert "SN-9 is not" in shown(app, "question")
        scan(app, FIRST)
        await day.asked_for(pilot, "SN-9")  # after the run, over its result
        assert app.current_mode == "result"
        await pilot.press("escape", "f10")
        await day.seen(pilot, lambda: app.current_mode == "tray")
        assert app.shown is not None
        assert column(app, "state") == [app.shown.outcome, "waiting"]


LABORATORY = '[laboratory]\nname = "Test laboratory"\naddress = ["1 Main Street"]\ncountry = "DE"\n'


@pytest.mark.full
@pytest.mark.timeout(400)
@driven
async def test_a_day_with_a_wrong_a_failing_and_a_passing_device_ends_with_their_papers(place: Path) -> None:
    day = Day(place, limits='scale_factor_error = "10000 ppm"', scale=1.0)
    day.mount(FIRST, scale_factor_error_ppm=20_000, more=LABORATORY)
    app, recordings = day.app, place / "recordings"

    async def made(words: str, suffix: str) -> None:
        await pilot.press("ctrl+p")
        await day.seen(pilot, lambda: isinstance(app.screen, CommandPalette))
        await pilot.press(*keys(words))
        await day.seen(pilot, lambda: words in str(app.screen.query_one(CommandList).get_option_at_index(0).prompt))
        await pilot.press("enter")
        await day.seen(pilot, lambda: list(recordings.glob(f"*.{suffix}")))

    async with app.run_test(size=(80, 24)) as pilot:
        await day.begin(pilot, "SN-9", FIRST, SECOND)
        await pilot.press("f8")  # but the device says another number
        await day.seen(pilot, lambda: app.current_mode == "prepare" and FIRST in shown(app, "summary"))
        assert app.shown is None
        await pilot.press("f10", "tab", "s")
        await day.seen(pilot, lambda: column(app, "state") == ["skipped", "waiting", "waiting"])
        await pilot.press("f7")
        await day.asked_for(pilot, FIRST)
        scan(app, FIRST)
        await day.asked_for(pilot, SECOND)
        await pilot.press("escape")
        await day.seen(pilot, lambda: "FAIL" in shown(app, "verdict"))
        await made("Report, written", "html")
        (report,) = recordings.glob("*.html")
        assert "Calibration report: not within limits" in report.read_text()

        day.mount(SECOND, more=LABORATORY)
        await pilot.press("f10", "f7")
        await day.asked_for(pilot, SECOND)
        scan(app, SECOND)
        await day.seen(pilot, lambda: app.current_mode == "result" and "PASS" in shown(app, "verdict"))
        await pilot.press("f")
        await form_of(pilot)
        await entered(pilot, "customer.name", "A customer")
        await entered(pilot, "customer.address", "2 Side Street")
        await keep(pilot)
        await day.seen(pilot, lambda: list(recordings.glob("*-certificate.toml")) and app.screen.query("#verdict"))
        await pilot.press("a")
        await day.seen(pilot, lambda: f"Accept the calibration of {SECOND}" in shown(app, "question"))
        await pilot.press("tab", "enter")
        await day.seen(pilot, lambda: "certificate:" in shown(app, "verdict"))
        await made("Digital certificate", "xml")
        await made("Export as C header", "h")
        await made("Export as JSON", "json")
        await pilot.press("f10")
        await day.seen(pilot, lambda: column(app, "state") == ["skipped", "FAIL", "PASS"])
        await pilot.press("f5")
        await day.seen(pilot, lambda: app.current_mode == "history" and "2 recordings" in shown(app, "folder"))
        listed = app.screen.query_one(DataTable)
        told = {str(cell) for row in range(listed.row_count) for cell in listed.get_row_at(row)}
        assert told >= {FIRST, SECOND, "FAIL", "PASS"}

    for certificate in {*recordings.glob("*.html")} - {report}:  # of accepting, and of the digital one
        assert "Specimen of a calibration certificate" in certificate.read_text()
        assert "A customer" in certificate.read_text()
    (dcc,) = recordings.glob("*.xml")
    validate(dcc.read_bytes())
    assert dcc.with_suffix(".pdf").read_bytes().startswith(b"%PDF-")
