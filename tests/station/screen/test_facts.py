"""The form for what a certificate states, from the Result screen: filled in, checked, kept beside the recording."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from pathlib import Path

import h5py
import pytest
from certified import certified
from conftest import HistoryFirst, driven, keys, until
from textual.pilot import Pilot
from textual.widgets import Input, TextArea

from station.report.formal import read_formal
from station.report.recorded import read_recorded
from station.screen.app import StationApp
from station.screen.choices import Choices
from station.screen.tabs.facts import FactsForm

NOON_UTC_S = 1777636800.0  # 2026-05-01
BENCH = """
[laboratory]
name = "Gyro laboratory"
[[equipment]]
name = "rate table"
due = 2026-12-31
"""
Drive = Callable[[Pilot[None]], Awaitable[None]]


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


async def opened(pilot: Pilot[None], recording: Path) -> FactsForm:
    """Open the form of a recording by keys, and wait until it has been checked."""
    app = pilot.app
    assert isinstance(app, StationApp)
    app.open_recording(recording)
    await until(pilot, lambda: app.current_mode == "result" and recording.name in shown(app, "verdict"))
    await pilot.press("f")
    await until(pilot, lambda: isinstance(app.screen, FactsForm) and "Digital" in shown(app, "missing"))
    form = app.screen
    assert isinstance(form, FactsForm)
    return form


def shown(app: object, name: str) -> str:
    """Return what a part of the screen shows."""
    found = app.screen.query(f"#{name}")  # type: ignore[attr-defined]
    return " ".join(str(found.first().render()).split()) if found else ""


def row(form: FactsForm, name: str) -> str:
    """Return what is beside and below a field: where its text comes from, and what is wrong with it."""
    parts = form.query(f"#{name.replace('.', '-')} .said")
    return " ".join(" ".join(str(part.render()) for part in parts).split())


async def entered(pilot: Pilot[None], form: FactsForm, name: str, text: str) -> None:
    """Type a text in a field, and wait until it is there."""
    field = form.query_one(f"#{name.replace('.', '-')} .entry")
    assert isinstance(field, Input | TextArea)
    field.focus()
    await pilot.pause()
    await pilot.press("end", *keys(text))


def test_what_the_form_keeps_is_what_a_report_states(jobs: Path) -> None:
    run = jobs / "a.h5"

    async def drive(pilot: Pilot[None]) -> None:
        form = await opened(pilot, run)
        assert row(form, "laboratory.name") == "bench file"
        assert row(form, "equipment.0.name") == "bench file"
        assert row(form, "item.serial_number") == "recording"
        assert row(form, "performed.date") == "recording"
        assert "customer.name" in shown(pilot.app, "missing")
        await entered(pilot, form, "customer.name", "Aerial surveys")
        await entered(pilot, form, "customer.address", "Langstrasse 1")
        await pilot.press("enter", *keys("Bern"))
        await entered(pilot, form, "certificate.issued", "1.5.2026")
        await until(pilot, lambda: "write it as 2026-11-23" in row(form, "certificate.issued"))
        await pilot.press("ctrl+s")  # is not kept so, and leads to what is wrong
        await until(pilot, lambda: form.focused is form.query_one("#certificate-issued .entry"))
        assert not list(jobs.glob("*.toml"))
        await pilot.press(*["backspace"] * 8, *keys("2026-05-02"))
        await until(pilot, lambda: "write it" not in row(form, "certificate.issued"))
        assert row(form, "customer.name") == "entered"
        await pilot.press("escape")  # asks, and goes back to the form
        await until(pilot, lambda: pilot.app.screen is not form)
        await pilot.press("escape", "ctrl+s")
        await until(pilot, lambda: pilot.app.screen is not form and (jobs / "a-certificate.toml").exists())
        again = await opened(pilot, run)
        assert row(again, "customer.name") == "kept"

    driven(app_of(jobs), drive)
    formal = read_formal(read_recorded(run))
    assert (formal.customer_name, formal.customer_address) == ("Aerial surveys", ("Langstrasse 1", "Bern"))
    assert (formal.laboratory_name, formal.equipment[0].name) == ("Gyro laboratory", "rate table")
    assert str(formal.certificate_issued) == "2026-05-02"
    assert "Gyro laboratory" not in (jobs / "a-certificate.toml").read_text()  # the bench file states it


def test_the_customer_of_another_device_is_shown_as_that_and_confirmed(jobs: Path) -> None:
    async def drive(pilot: Pilot[None]) -> None:
        form = await opened(pilot, jobs / "a.h5")
        await entered(pilot, form, "customer.name", "Aerial surveys")
        await entered(pilot, form, "certificate.number", "C-1")
        await pilot.press("ctrl+s")
        await until(pilot, lambda: (jobs / "a-certificate.toml").exists() and pilot.app.screen is not form)
        form = await opened(pilot, jobs / "b.h5")
        assert row(form, "customer.name") == "last form, TG-0042"
        assert row(form, "certificate.number") == ""
        await pilot.press("ctrl+s")
        await until(pilot, lambda: "Aerial surveys" in shown(pilot.app, "question"))
        assert not (jobs / "b-certificate.toml").exists()
        await pilot.press("escape")
        await entered(pilot, form, "customer.name", " Ltd")
        await pilot.press("ctrl+s")
        await until(pilot, lambda: (jobs / "b-certificate.toml").exists())

    driven(app_of(jobs), drive)
    assert read_formal(read_recorded(jobs / "b.h5")).customer_name == "Aerial surveys Ltd"
