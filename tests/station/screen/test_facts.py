"""The form for what a certificate states, from the Result screen: filled in, checked, kept beside the recording."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest
from certified import certified
from conftest import HistoryFirst, driven, until
from textual.pilot import Pilot
from textual.widgets import Input, OptionList

from station.report.formal import read_formal
from station.report.recorded import read_recorded
from station.screen.app import StationApp
from station.screen.choices import Choices
from station.screen.dialogs import AskTextDialog
from station.screen.tabs.facts import FactsDialog

NOON_UTC_S = 1777636800.0  # 2026-05-01
BENCH = """
[laboratory]
name = "Gyro laboratory"
[[equipment]]
name = "rate table"
due = 2026-12-31
"""


@pytest.fixture
def jobs(place: Path) -> Path:
    """Return a folder of two recordings of one bench that passed: a.h5 of TG-0042, b.h5 of TG-0043."""
    for name, serial in (("a", "TG-0042"), ("b", "TG-0043")):
        run = certified(place, device_serial=serial, station="lab 3", clock_zero_utc_s=NOON_UTC_S)
        with h5py.File(run, "r+") as file:
            file.attrs["bench"] += BENCH
        (place / "recordings").mkdir(exist_ok=True)
        run.rename(place / f"recordings/{name}.h5")
    return place / "recordings"


def app_of(folder: Path) -> StationApp:
    return HistoryFirst(Choices(folder=folder, operator="A. Turing"))


async def opened(pilot: Pilot[None], recording: Path) -> None:
    """Open the form of a recording by keys."""
    app = pilot.app
    assert isinstance(app, StationApp)
    await app.switch_mode("history")
    app.open_recording(recording)
    await until(pilot, lambda: "PASS all" in (told := shown(app, "verdict")) and recording.name in told)
    await pilot.press("f")
    await form_of(pilot)


async def form_of(pilot: Pilot[None], *told: str) -> None:
    """Wait until the form is there, and tells some things above its lines."""
    await until(pilot, lambda: isinstance(pilot.app.screen, FactsDialog) and pilot.app.screen.query(OptionList))
    await until(pilot, lambda: all(words in shown(pilot.app, "question") for words in told))


def shown(app: object, name: str) -> str:
    """Return what a part of the screen shows."""
    found = app.screen.query(f"#{name}")  # type: ignore[attr-defined]
    return " ".join(str(found.first().render()).split()) if found else ""


def line(pilot: Pilot[None], field: str) -> str:
    """Return the line of a fact."""
    return " ".join(str(pilot.app.screen.query_one(OptionList).get_option(field).prompt).split())


async def entered(pilot: Pilot[None], field: str, text: str) -> None:
    """Go to the line of a fact, and enter a text in the place of what is there."""
    lines = pilot.app.screen.query_one(OptionList)
    lines.highlighted = lines.get_option_index(field)
    await pilot.press("enter")
    await until(pilot, lambda: isinstance(pilot.app.screen, AskTextDialog))
    pilot.app.screen.query_one(Input).value = text
    await pilot.press("enter")
    await form_of(pilot)


async def keep(pilot: Pilot[None]) -> None:
    """Press the last line."""
    await pilot.press("end", "enter")
    await pilot.pause()


def test_what_the_form_keeps_is_what_a_report_states(jobs: Path) -> None:
    run = jobs / "a.h5"

    async def drive(pilot: Pilot[None]) -> None:
        await opened(pilot, run)
        assert line(pilot, "laboratory.name") == "laboratory name Gyro laboratory bench file"
        assert line(pilot, "equipment.0.name") == "equipment.0 name rate table bench file"
        assert line(pilot, "item.serial_number").endswith("TG-0042 recording")
        assert line(pilot, "performed.date").endswith("2026-05-01 recording")
        assert "needed for a DCC" in line(pilot, "customer.name")
        await entered(pilot, "customer.name", "Aerial surveys")
        await entered(pilot, "customer.address", "Langstrasse 1 | Bern")
        assert line(pilot, "customer.name") == "customer name Aerial surveys entered"
        await entered(pilot, "certificate.issued", "1.5.2026")
        assert "WRONG: '1.5.2026' is not a date. Write it as 2026-11-23" in line(pilot, "certificate.issued")
        await keep(pilot)  # is refused, and leads to what is wrong
        await form_of(pilot, "WRONG certificate.issued")
        assert not list(jobs.glob("*.toml"))
        await entered(pilot, "certificate.issued", "2026-05-02")
        await pilot.press("escape")  # asks, and goes back to the form
        await until(pilot, lambda: "not saved yet" in shown(pilot.app, "question"))
        await pilot.press("escape")
        await form_of(pilot)
        await keep(pilot)
        await until(pilot, lambda: (jobs / "a-certificate.toml").exists() and pilot.app.current_mode == "result")

    driven(app_of(jobs), drive)
    formal = read_formal(read_recorded(run))
    assert (formal.customer_name, formal.customer_address) == ("Aerial surveys", ("Langstrasse 1", "Bern"))
    assert (formal.laboratory_name, formal.equipment[0].name) == ("Gyro laboratory", "rate table")
    assert str(formal.certificate_issued) == "2026-05-02"


@pytest.mark.full
def test_the_customer_of_the_last_form_is_shown_as_that_and_the_job_is_not_taken_over(jobs: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        await opened(pilot, jobs / "a.h5")
        await entered(pilot, "customer.name", "Aerial surveys")
        await entered(pilot, "equipment.1.name", "level")
        await entered(pilot, "equipment.1.no_due", "granite")
        await entered(pilot, "certificate.number", "C-1")
        assert line(pilot, "equipment.2.name").startswith("equipment.2")  # there is always one more
        await keep(pilot)
        await until(pilot, lambda: (jobs / "a-certificate.toml").exists() and pilot.app.screen.query("#verdict"))
        await opened(pilot, jobs / "b.h5")
        assert line(pilot, "customer.name").endswith("Aerial surveys LAST FORM, this bench")
        assert line(pilot, "equipment.0.name").endswith("rate table bench file")
        assert line(pilot, "certificate.number") == "certificate number"
        await entered(pilot, "customer.name", "")
        await entered(pilot, "item.condition", "new")
        await keep(pilot)
        await until(pilot, lambda: (jobs / "b-certificate.toml").exists() and pilot.app.screen.query("#verdict"))
        await opened(pilot, jobs / "b.h5")
        assert line(pilot, "item.condition") == "condition new kept"
        await entered(pilot, "item.condition", "used")
        await pilot.press("ctrl+q")  # does not leave the station with what is not kept
        await until(pilot, lambda: "not saved yet" in shown(pilot.app, "question"))
        await pilot.press("escape")
        await form_of(pilot)
        await entered(pilot, "item.condition", "new")
        await pilot.press("escape")  # nothing was changed, nothing is asked
        await until(pilot, lambda: pilot.app.screen.query("#verdict"))

    driven(app_of(jobs), drive)
    first, second = (read_formal(read_recorded(jobs / f"{name}.h5")) for name in "ab")
    assert [one.name for one in first.equipment] == ["rate table", "level"]
    assert (second.customer_name, second.item_condition) == (None, "new")
