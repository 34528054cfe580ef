"""Recordings as the screen opens, accepts and compares them."""

from __future__ import annotations

import asyncio
import os
import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest
from conftest import HistoryFirst, until
from textual.pilot import Pilot
from textual.widgets import OptionList

from estimator.tracing.investigation import Errors, Finding, GyroErrors, Investigation
from station.exports.investigation_file import write_investigation
from station.screen.archive import reading
from station.screen.archive.archive import Archive
from station.screen.choices import Choices
from station.views.investigation import investigation_object, investigation_view

ACCEPTED = {"accepted_by": "A. Operator", "accepted_utc": "2026-11-21T12:00:00+00:00"}


async def accept(path: Path) -> str:
    archive = Archive()
    try:
        return await archive.accept(path, ACCEPTED)
    finally:
        await archive.close()


@pytest.fixture
def small_files(recordings: Path) -> Iterator[Path]:
    """Return the folder of recordings, where no file can grow any more: as a full disk, but for everybody."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((recordings / "first.h5").stat().st_size, hard))
    yield recordings
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.skipif(sys.platform == "darwin", reason="its limit of file sizes kills")
def test_a_recording_is_as_it_was_where_acceptance_cannot_be_written(small_files: Path) -> None:
    path = small_files / "first.h5"
    before = path.read_bytes()
    assert "it cannot be written and is unchanged" in asyncio.run(accept(path))
    assert path.read_bytes() == before
    assert not list(small_files.glob(".*.part"))


def test_acceptance_is_not_written_through_a_link_that_another_user_made(recordings: Path, tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("calibrations of a year")
    path = recordings / "first.h5"
    path.with_name(f".first.h5.{os.getpid()}.part").symlink_to(precious)
    before = path.read_bytes()
    assert "File exists" in reading.accept(path, ACCEPTED)
    assert precious.read_text() == "calibrations of a year"
    assert path.read_bytes() == before


def test_acceptance_is_written_into_the_recording(recordings: Path) -> None:
    path = recordings / "first.h5"
    assert asyncio.run(accept(path)) == ""
    with h5py.File(path) as file:
        assert {key: file.attrs[key] for key in ACCEPTED} == ACCEPTED
        assert "calibration" in file


def test_other_runs_of_the_device_are_offered_to_judge_an_investigation(recordings: Path) -> None:
    app = HistoryFirst(Choices(folder=Path("recordings"), operator="A. Operator"))

    async def drive() -> None:
        async with app.run_test(size=(80, 24)) as pilot:
            app.open_recording(Path("recordings/second.h5"))
            await offered(pilot)
            await pilot.press("escape")

    async def offered(pilot: Pilot[None]) -> None:
        await until(pilot, lambda: app.current_mode == "result")
        await until(pilot, lambda: "first.h5" in str(app.screen.query_one("#change").render()))
        await pilot.press("i")
        await until(pilot, lambda: app.screen.query(OptionList))
        lines = [str(option.prompt) for option in app.screen.query_one(OptionList).options]
        assert len(lines) == 2
        assert "cross-validation" in lines[0]
        assert "PASS" in lines[1]
        assert "first.h5" in lines[1]

    asyncio.run(drive())


def test_an_investigation_that_is_kept_beside_a_recording_is_shown_as_the_command_prints_it(recordings: Path) -> None:
    errors = Errors(1e-5, 6e-5, 0.95)
    gyro = GyroErrors(
        name="gyro1",
        before=errors,
        after=errors,
        phases=(),
        states_before=np.zeros(4),
        states_after=np.zeros(4),
        moved=np.array([0.1, -0.2, 0.3, 0.0]),
    )
    found = Investigation(
        finding=Finding.NOTHING,
        reason="it is noise",
        added=(),
        rivals=(),
        unexplained=None,
        before=errors,
        after=errors,
        improvement=None,
        in_sample=True,
        gyros=(gyro,),
        models=(),
        suspects=(),
        left_out={},
        notes=("a note",),
    )
    write_investigation(
        recordings / "second-investigation.h5", found, investigation_object(investigation_view(found, None))
    )
    app = HistoryFirst(Choices(folder=Path("recordings"), operator="A. Operator"))

    def shown() -> str:
        strips = app.screen._compositor.render_strips()
        return "\n".join("".join(segment.text for segment in strip) for strip in strips)

    async def drive() -> None:
        async with app.run_test(size=(100, 60)) as pilot:
            app.open_recording(Path("recordings/second.h5"))
            await until(pilot, lambda: "NOTHING TO ADD  it is noise" in shown())
            await until(pilot, lambda: "+0.1 / -0.2 / +0.3 / +0.0" in shown())
            assert "note: a note" in shown()

    asyncio.run(drive())
