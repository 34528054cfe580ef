"""The index of a folder of recordings is quick, and never the truth itself."""

from __future__ import annotations

import asyncio
import os
import random
import sqlite3
from contextlib import aclosing, closing
from pathlib import Path

import h5py
import pytest

from station.screen.archive.archive import Archive
from station.screen.archive.entries import Entry
from station.screen.archive.index import index_file
from station.screen.archive.reading import read


async def listed(folder: Path, most: int = 10_000) -> list[Entry]:
    """Return the recordings as a program that has just begun lists them, or the first of them."""
    archive, found = Archive(), []
    try:
        async with aclosing(archive.entries(folder)) as entries:
            async for entry in entries:
                found.append(entry)
                if len(found) == most:
                    break
    finally:
        await archive.close()
    return found


def told(folder: Path) -> list[str]:
    """Return all that the list says of each recording."""
    return sorted(map(repr, asyncio.run(listed(folder))))


def spoil(path: Path) -> None:
    """Have a file be no HDF5 file any more, of the same size and date."""
    status = path.stat()
    path.write_bytes(bytes(status.st_size))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


@pytest.fixture
def whole(recordings: Path) -> Path:
    """Return the folder without what cannot be read, so that a list does not wait for it."""
    for name in ("later", "torn"):
        (recordings / f"{name}.h5").unlink()
    return recordings


def test_what_did_not_change_is_not_read_again_and_what_did_is(whole: Path) -> None:
    before = told(whole)
    spoil(whole / "first.h5")
    assert told(whole) == before
    os.utime(whole / "first.h5")
    (found,) = [entry for entry in asyncio.run(listed(whole)) if entry.path.name == "first.h5"]
    assert "damaged" in found.wrong


def test_the_index_is_this_users_and_not_in_the_folder(whole: Path, place: Path) -> None:
    names = set(whole.iterdir())
    told(whole)
    assert set(whole.iterdir()) == names
    assert index_file(whole).is_relative_to(place / "state")
    assert index_file(whole).parent.stat().st_mode & 0o077 == 0


def test_no_index_is_kept_where_others_could_plant_one(whole: Path, tmp_path: Path) -> None:
    before, index = told(whole), index_file(whole)
    precious = tmp_path / "precious"
    precious.touch()
    index.unlink()
    index.symlink_to(precious)
    index.parent.chmod(0o777)
    assert told(whole) == before
    assert precious.read_bytes() == b""
    index.parent.chmod(0o700)


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(2, 100), marks=pytest.mark.full)], ids=["few", "many"])
def test_an_index_that_is_harmed_anywhere_changes_no_figure(whole: Path, seeds: range) -> None:
    before, index = told(whole), index_file(whole)
    made = index.read_bytes()
    for seed in seeds:
        chance, content = random.Random(seed), bytearray(made)
        for _ in range((20, 2000, 1)[seed % 3]):
            content[chance.randrange(len(content))] ^= chance.randrange(1, 256)
        index.write_bytes(content[: chance.randrange(len(content)) if seed % 4 == 3 else None])
        assert told(whole) == before, seed


def test_without_its_index_a_folder_is_read_again(
    whole: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    before, index = told(whole), index_file(whole)
    index.write_bytes(b"not a database at all" * 1000)
    assert told(whole) == before
    assert told(whole) == before
    index.unlink()
    index.mkdir()
    assert told(whole) == before
    monkeypatch.setenv("XDG_STATE_HOME", str(whole / "first.h5"))
    assert told(whole) == before
    assert "Traceback" not in "".join(capfd.readouterr())


def test_several_stations_use_an_index_at_once(whole: Path) -> None:
    async def together() -> list[list[Entry]]:
        return await asyncio.gather(*(listed(whole) for _ in range(2)))

    found = asyncio.run(together())
    assert len({tuple(sorted(map(repr, each))) for each in found}) == 1
    assert len(found[0]) == 2


def test_an_index_that_another_program_locks_costs_no_recording_and_stays(whole: Path) -> None:
    before = told(whole)
    with closing(sqlite3.connect(index_file(whole))) as other:
        other.execute("BEGIN EXCLUSIVE")
        assert told(whole) == before
    spoil(whole / "first.h5")
    assert told(whole) == before


@pytest.mark.full
def test_many_recordings_are_read_by_several_processes_and_a_hostile_one_costs_only_itself(whole: Path) -> None:
    for number in range(220):
        os.link(whole / "first.h5", whole / f"copy-{number:03d}.h5")
    with h5py.File(whole / "second.h5", "r+") as file:
        del file["calibration/states"]
        file["calibration/states"] = h5py.ExternalLink("first.h5", "calibration/states")
    found = asyncio.run(listed(whole))
    assert len(found) == 222
    (wrong,) = [entry for entry in found if entry.wrong]
    assert wrong.path.name == "second.h5"
    assert "another file" in wrong.wrong


@pytest.mark.parametrize("leads", ["softly", "under another name"])
def test_a_list_does_not_hold_what_claims_more_than_there_is_wherever_it_stands(leads: str, whole: Path) -> None:
    with h5py.File(whole / "first.h5", "r+") as file:
        del file["calibration/states"]
        where = "big" if leads == "softly" else "calibration/states"
        file.create_dataset(where, (400_000_000, 4), "f8", chunks=(1_000_000, 4))
        if leads == "softly":
            file["calibration/states"] = h5py.SoftLink("/big")
        else:
            file["a"] = file["calibration"]
    assert "far more" in read(whole / "first.h5", 0.0, False).entry.wrong


def test_a_first_listing_that_is_cut_short_loses_nothing(whole: Path) -> None:
    (read,) = asyncio.run(listed(whole, most=1))
    spoil(read.path)
    assert repr(read) in told(whole)


@pytest.mark.parametrize("began_utc_s", [float("nan"), 1e300, 253402300799.0])
def test_a_recording_of_no_date_is_damaged_and_harms_no_list(began_utc_s: float, whole: Path) -> None:
    with h5py.File(whole / "first.h5", "r+") as file:
        file.attrs["clock_zero_utc_s"] = began_utc_s
    found = {entry.path.name: entry for entry in asyncio.run(listed(whole))}
    assert "damaged" in found["first.h5"].wrong
    assert all(entry.when for entry in found.values())


def test_a_recording_that_is_deleted_during_the_listing_is_none_and_not_damaged(whole: Path) -> None:
    async def listed_while_one_goes() -> list[str]:
        archive, found = Archive(), []
        try:
            async for entry in archive.entries(whole):
                found.append(entry.wrong)
                for other in {"first.h5", "second.h5"} - {entry.path.name}:
                    (whole / other).unlink(missing_ok=True)
        finally:
            await archive.close()
        return found

    assert asyncio.run(listed_while_one_goes()) == [""]
