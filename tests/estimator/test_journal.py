"""A run that dies leaves a journal beside its recording: it is folded in when the recording is next opened."""

from __future__ import annotations

import logging
import os
import shutil
import struct
import subprocess
import sys
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import msgpack
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings, strategies as st

from estimator.errors import RecordingError
from estimator.geometry.array import triad
from estimator.geometry.model import Prior
from estimator.recordings.reading import read_recording
from estimator.recordings.writing import RecordingWriter

RNG = np.random.default_rng(3)
ROWS = 5  # of a block
T_NS = np.arange(1000, dtype=np.int64) * 10_000_000
RATE = RNG.normal(size=(1000, 3))


def begin(folder: Path) -> RecordingWriter:
    """Begin a run as a session does: the journal is begun with it."""
    folder.mkdir(exist_ok=True)
    writer = RecordingWriter(folder / "run.h5", {"outcome": "ABORTED", "clock_zero_utc_s": 1.7e9}, journal=True)
    writer.add_table(("z", "y", "x"))
    writer.add_source("imu", triad(), Prior(), {"rate_hz": 100.0})
    return writer


def take(writer: RecordingWriter, *numbers: int) -> None:
    """Take blocks of samples and of readings of the table, each of which reaches the journal."""
    for number in numbers:
        part = slice(number * ROWS, (number + 1) * ROWS)
        block = {"t_ns": T_NS[part], "arrival_ns": T_NS[part] + 2_000_000, "rate_rps": RATE[part]}
        writer.append_rows("imu/imu", block)
        writer.append_rows("table", {"t_ns": T_NS[part], "angle_rad": RATE[part], "rate_rps": RATE[part]})
        writer.write_journal()


def left_by(folder: Path, to: Path) -> Path:
    """Return the recording in a copy of what a kill -9 at this moment would leave."""
    return shutil.copytree(folder, to) / "run.h5"


def rows_of(path: Path) -> int:
    """Open a recording; return how many samples it holds, which are the first of all."""
    data = read_recording(path, trusted=False).sources["imu"]
    np.testing.assert_array_equal(data.rate_rps, RATE[: len(data.rate_rps)])
    np.testing.assert_array_equal(data.t_ns, T_NS[: len(data.t_ns)])
    return len(data.t_ns)


@pytest.mark.parametrize("flushed_after", [0, 3, 7])
def test_what_is_in_the_journal_is_in_the_recording_that_is_opened(
    tmp_path: Path, flushed_after: int, caplog: pytest.LogCaptureFixture
) -> None:
    writer = begin(tmp_path / "run")
    for number in range(8):
        take(writer, number)
        if number == flushed_after:
            writer.flush()
    writer.append_text("events", {"t_ns": 5}, "text", "table is home")
    writer.set_source("imu", {"lost": 3})
    writer.write_journal()
    path = left_by(tmp_path / "run", tmp_path / "left")
    with caplog.at_level(logging.WARNING):
        assert rows_of(path) == 40
    assert "40 samples recovered" in caplog.text
    assert "2023-11-14 22:13:20" in caplog.text  # when the last was taken
    assert os.listdir(path.parent) == ["run.h5"]
    found = read_recording(path)
    assert len(found.reference.t_ns) == 40
    assert found.sources["imu"].lost == 3
    assert found.attributes["outcome"] == "ABORTED"
    with h5py.File(path) as file:
        assert list(file["events/text"]) == [b"table is home"]
    writer.close()


def test_a_run_that_ends_leaves_no_journal(tmp_path: Path) -> None:
    writer = begin(tmp_path)
    take(writer, 0, 1)
    writer.close()
    writer.finish()
    assert os.listdir(tmp_path) == ["run.h5"]
    assert rows_of(tmp_path / "run.h5") == 10


def test_a_run_that_goes_on_is_not_taken_for_a_dead_one(tmp_path: Path) -> None:
    writer = begin(tmp_path)
    take(writer, 0)
    with pytest.raises(RecordingError, match="its run has not ended"):
        read_recording(tmp_path / "run.h5")
    take(writer, 1)
    writer.close()
    writer.finish()
    assert rows_of(tmp_path / "run.h5") == 10


def test_no_run_begins_beside_a_journal_that_another_left(tmp_path: Path) -> None:
    writer = begin(tmp_path / "run")
    take(writer, 0)
    path = left_by(tmp_path / "run", tmp_path / "left")
    path.unlink()
    with pytest.raises(RecordingError, match="journal of a run that did not end"):
        RecordingWriter(path, {}, journal=True)
    assert rows_of(path) == 5
    writer.close()


def test_samples_that_have_no_time_yet_are_recovered_with_what_their_arrival_tells(tmp_path: Path) -> None:
    writer = begin(tmp_path / "run")
    for number in range(4):
        part = slice(number * ROWS, (number + 1) * ROWS)
        writer.arrived("imu/imu", T_NS[part] + 2_000_000, RATE[part])
        if number:  # what has arrived is timed a block later
            take(writer, number - 1)
    writer.write_journal()
    data = read_recording(left_by(tmp_path / "run", tmp_path / "left")).sources["imu"]
    np.testing.assert_array_equal(data.rate_rps, RATE[:20])
    np.testing.assert_allclose(data.t_ns, T_NS[:20], atol=1)
    writer.close()


def test_columns_that_a_device_adds_in_a_group_of_its_own_are_recovered(tmp_path: Path) -> None:
    writer = begin(tmp_path / "run")
    take(writer, 0)
    writer.set_attributes({"model": "oven", "limits_c": [-40.0, 85.0]}, "chamber/air")
    air = {"t_ns": T_NS[:3], "temperature_c": np.array([20.0, 21.0, 22.0]), "door open": np.array([False, True, False])}
    writer.append_rows("chamber/air", air)
    writer.write_journal()
    path = left_by(tmp_path / "run", tmp_path / "left")
    assert rows_of(path) == 5
    with h5py.File(path) as file:
        group = file["chamber/air"]
        assert group.attrs["model"] == "oven"
        np.testing.assert_array_equal(group.attrs["limits_c"], [-40.0, 85.0])
        for name, values in air.items():
            np.testing.assert_array_equal(group[name], values)
    writer.close()


@pytest.mark.parametrize(
    ("group", "columns"),
    [
        ("chamber/../../x", {"t_ns": T_NS[:1]}),
        ("a/b/c/d/e", {"t_ns": T_NS[:1]}),
        ("chamber", {"a/b": np.zeros(1)}),
        ("chamber", {"": np.zeros(1)}),
        ("chamber", {"text": np.array(["no bytes"])}),
        ("chamber", {"object": np.array([None])}),
        ("chamber", {"t_ns": np.zeros((1, 2))}),
        ("chamber", {"list": [1.0]}),
    ],
)
def test_what_could_not_be_recovered_is_refused_when_it_is_written(
    tmp_path: Path, group: str, columns: dict[str, Any]
) -> None:
    writer = begin(tmp_path / "run")
    take(writer, 0)
    with pytest.raises(RecordingError, match="a recording cannot hold"):
        writer.append_rows(group, columns)
    take(writer, 1)
    assert rows_of(left_by(tmp_path / "run", tmp_path / "left")) == 10
    writer.close()


@pytest.fixture(scope="module")
def dead(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run left that died after 12 blocks, with 6 of them flushed."""
    folder = tmp_path_factory.mktemp("dead")
    writer = begin(folder / "run")
    take(writer, *range(2))
    writer.note_source("imu", {"lost": 2})  # in the journal alone, as counts of a run are until it ends
    take(writer, *range(2, 6))
    writer.flush()
    take(writer, *range(6, 12))
    left_by(folder / "run", folder / "left")
    writer.close()
    return folder / "left"


def boundaries(journal: bytes) -> list[int]:
    """Return where the records of a journal end."""
    ends, at = [], 0
    while at < len(journal):
        at += 12 + struct.unpack_from("<I", journal, at + 4)[0]
        ends.append(at)
    return ends


@settings(max_examples=25, suppress_health_check=list(HealthCheck), deadline=None)
@given(cut=st.floats(0, 1), torn=st.binary(max_size=40), recording_cut=st.floats(0, 1))
@example(cut=0.0, torn=b"", recording_cut=1.0)
@example(cut=1.0, torn=b"", recording_cut=0.0)
@example(cut=0.5, torn=b"", recording_cut=1.0)
def test_a_power_cut_at_any_byte_leaves_every_whole_record(
    dead: Path, tmp_path_factory: pytest.TempPathFactory, cut: float, torn: bytes, recording_cut: float
) -> None:
    path = shutil.copytree(dead, tmp_path_factory.mktemp("cut") / "x") / "run.h5"
    journal = path.with_name("run.h5.journal")
    whole = journal.read_bytes()
    at = round(cut * len(whole))
    journal.write_bytes(whole[:at] + torn)
    os.truncate(path, round(recording_cut * path.stat().st_size))
    ends = boundaries(whole)
    assert len(ends) == 13  # what was declared, and the first block, are in the second
    records = sum(end <= at for end in ends)
    flushed = 30 if path.stat().st_size == (dead / "run.h5").stat().st_size else 0
    if records >= 2:
        assert rows_of(path) == max(5 * (records - 1), flushed)
        assert read_recording(path).sources["imu"].lost == (2 if records >= 4 else 0)
        assert not journal.exists()
    else:  # nothing of it can be used: the recording is what it is, or is said not to be one
        with suppress(RecordingError):
            read_recording(path)


@pytest.mark.parametrize("dataset", ["rate_rps", "t_ns"])
def test_rows_that_a_power_cut_kept_from_the_disk_are_not_preferred_to_a_journal(
    dead: Path, tmp_path: Path, dataset: str
) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    journal = path.with_name("run.h5.journal")
    raw = journal.read_bytes()
    journal.write_bytes(raw[: boundaries(raw)[5]])  # 25 samples; the recording has 30
    with h5py.File(path, "r+") as file:
        file["imu/imu"][dataset][28:] = 0
    before = path.read_bytes()
    assert rows_of(path) == 25
    assert path.with_name("run.h5.before").read_bytes() == before


@pytest.mark.parametrize("stuck", [False, True], ids=["coarse", "stuck at zero"])
def test_the_zeros_of_a_coarse_sensor_are_no_rows_that_were_not_written(tmp_path: Path, stuck: bool) -> None:
    writer = begin(tmp_path / "run")
    writer.note_source("imu", {"lost": 2})
    rate_rps = np.random.default_rng(4).integers(-1, 2, (1000, 3)) * (0.0 if stuck else 0.1)
    assert np.count_nonzero(~rate_rps.any(axis=1)) > 10
    for at in range(0, 1000, 100):
        part = slice(at, at + 100)
        writer.append_rows("imu/imu", {"t_ns": T_NS[part], "arrival_ns": T_NS[part], "rate_rps": rate_rps[part]})
        writer.append_rows("table", {"t_ns": T_NS[part], "angle_rad": RATE[part], "rate_rps": RATE[part]})
        writer.write_journal()
    writer.flush()
    path = left_by(tmp_path / "run", tmp_path / "left")
    journal = path.with_name("run.h5.journal")
    os.truncate(journal, journal.stat().st_size // 2)
    np.testing.assert_array_equal(read_recording(path).sources["imu"].rate_rps, rate_rps)
    writer.close()


def test_a_damaged_journal_costs_what_is_damaged_and_the_recording_is_kept(
    dead: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    before, journal = path.read_bytes(), path.with_name("run.h5.journal")
    raw = bytearray(journal.read_bytes())
    raw[boundaries(raw)[4] + 30] ^= 0xFF
    journal.write_bytes(raw)
    data = read_recording(path).sources["imu"]
    there = np.delete(np.arange(60), np.s_[20:25])
    np.testing.assert_array_equal(data.rate_rps, RATE[there])
    assert "damaged" in caplog.text
    assert path.with_name("run.h5.before").read_bytes() == before


def record(payload: bytes) -> bytes:
    return struct.pack("<4sII", b"\x93TTJ", len(payload), zlib.crc32(payload)) + payload


def array(dtype: str, shape: list[int], data: bytes) -> msgpack.ExtType:
    return msgpack.ExtType(1, msgpack.packb([dtype, shape, data]))


HOSTILE = {
    "empty": b"",
    "text": b"not a journal at all\n" * 50,
    "claims 4 GB": struct.pack("<4sII", b"\x93TTJ", 2**32 - 1, 0) + bytes(1000),
    "claims much many times": struct.pack("<4sII", b"\x93TTJ", 60_000_000, 0) * 30_000,
    "not msgpack": record(b"\xc1" * 50),
    "nested": record(b"\x91" * 100_000),
    "no list": record(msgpack.packb({"a": 1})),
    "short entries": record(msgpack.packb([[], [0], [1, "imu/a"], 7])),
    "leads outside": record(
        msgpack.packb([[0, "../../etc", {"a": 1}], [1, "imu/../../x", {"t_ns": array("<i8", [1], bytes(8))}]])
    ),
    "objects": record(msgpack.packb([[1, "imu/a", {"t_ns": array("O", [1], bytes(8))}]])),
    "shape without bytes": record(msgpack.packb([[1, "imu/a", {"t_ns": array("<i8", [2**40, 0], b"")}]])),
    "shape of more": record(msgpack.packb([[1, "imu/a", {"t_ns": array("<i8", [2**40], bytes(8))}]])),
    "strange columns": record(msgpack.packb([[1, "imu/a", {"a/../../b": array("<i8", [1], bytes(8))}]])),
    "attribute of a list of lists": record(msgpack.packb([[0, "/", {"a": [[1], ["x", {}]]}]])),
    "attribute too large": record(msgpack.packb([[0, "/", {"a": "x" * 100_000}]])),
    "another extension": record(msgpack.packb([[0, "/", {"a": msgpack.ExtType(5, b"abc")}]])),
    "shapes that differ": record(
        msgpack.packb([[1, "imu/a", {"t_ns": array("<i8", [1, n], bytes(8 * n))}] for n in (1, 2, 3)])
    ),
}  # fmt: skip


ENTRIES: dict[str, Any] = {
    "a column is a text": [1, "imu/imu", {"t_ns": "now", "rate_rps": "fast"}],
    "a column is a number": [1, "imu/imu", {"t_ns": 1, "rate_rps": 2.0}],
    "a column is a list": [1, "imu/imu", {"t_ns": [1], "rate_rps": [[1.0, 2.0, 3.0]]}],
    "a column is nothing": [1, "imu/imu", {"t_ns": None}],
    "a column without dimensions": [1, "imu/imu", {"t_ns": array("<i8", [], bytes(8))}],
    "a column of no rows": [1, "imu/imu", {"t_ns": array("<i8", [0], b""), "rate_rps": array("<f8", [0, 3], b"")}],
    "arrivals are texts": [2, "imu/imu", {"arrival_ns": "now", "rate_rps": "fast"}],
    "arrivals without rates": [2, "imu/imu", {"arrival_ns": array("<i8", [1], bytes(8))}],
    "arrivals in floating point": [
        2,
        "imu/imu",
        {"arrival_ns": array("<f8", [1], bytes(8)), "rate_rps": array("<f8", [1, 3], bytes(24))},
    ],
    "a group that is not known": [1, "!/*/?/~/#", {"x": array("<i8", [1], bytes(8))}],
    "a kind that is not known": [9, "imu/imu", {"x": 1}],
    "a group where a dataset is": [1, "imu/imu/t_ns", {"x": array("<i8", [1], bytes(8))}],
    "attributes of a dataset": [0, "imu/imu/t_ns", {"x": 1}],
    "a source that nobody declared": [1, "imu/ghost", {"t_ns": array("<i8", [1], bytes(8))}],
    "an attribute of maps": [0, "imu/imu", {"prior": {"k": 1}}],
    "an attribute of nothing": [0, "imu/imu", {"lost": None}],
    "an attribute with a zero in it": [0, "imu/imu", {"device": "a\0b"}],
    "a key that is no text": [0, "imu/imu", {5: 6}],
    "a year that no calendar has": [0, "/", {"clock_zero_utc_s": 1e300}],
    "a beginning that is a text": [0, "/", {"time_scale": "slow"}],
    "no entry": 5,
}  # fmt: skip


@pytest.mark.parametrize("entry", ENTRIES.values(), ids=ENTRIES)
@pytest.mark.parametrize("torn", [False, True], ids=["recording as it was", "recording torn"])
def test_a_record_with_what_no_recording_holds_costs_itself_alone(
    dead: Path, tmp_path: Path, entry: Any, torn: bool
) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    journal = path.with_name("run.h5.journal")
    raw = journal.read_bytes()
    at = boundaries(raw)[7]
    journal.write_bytes(raw[:at] + record(msgpack.packb([entry])) + raw[at:])
    if torn:
        os.truncate(path, 1000)
    assert rows_of(path) == 60


BYTES = st.binary(max_size=40)
ARRAYS = st.builds(
    array,
    st.sampled_from(["<i8", "<f8", "|b1", "|S4", "<f4", "|u1", "O", "<U3", "?"]),
    st.lists(st.integers(-1, 3), max_size=3),
    st.one_of(BYTES, st.sampled_from([bytes(8), bytes(16), bytes(24)])),
)
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(-(2**63), 2**64 - 1), st.floats(), st.text(max_size=8), BYTES, ARRAYS,
    st.builds(msgpack.ExtType, st.integers(0, 9), BYTES),
)  # fmt: skip
NAMES = st.one_of(
    st.sampled_from(["t_ns", "rate_rps", "arrival_ns", "angle_rad", "recording_id", "p", "names", "outcome", "prior"]),
    st.text(max_size=5),
)
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=3), max_leaves=6
)
GROUPS = st.one_of(
    st.sampled_from(["/", "imu/imu", "imu", "table", "imu/imu/t_ns", "a/b", "../x", "", "imu/x"]), st.text(max_size=5)
)
PLAUSIBLE = st.lists(st.tuples(st.integers(-1, 4), GROUPS, st.dictionaries(NAMES, VALUES, max_size=4)), max_size=3)
MUTATED = given(payload=st.one_of(PLAUSIBLE, VALUES), at=st.integers(0, 13), only=st.booleans(), replaced=st.booleans())


def check_made(folder: Path, payload: Any, *, at: int, only: bool, replaced: bool) -> None:
    """Put a record that anybody may have made into a journal, at a place or alone; nothing but RecordingError, and
    nothing that the recording held is lost.
    """
    path = folder / "run.h5"
    before, journal = path.read_bytes(), path.with_name("run.h5.journal")
    raw = journal.read_bytes()
    ends = [0, *boundaries(raw)]
    made = record(msgpack.packb(payload, unicode_errors="surrogatepass"))
    after = ends[min(at + replaced, len(ends) - 1)]
    journal.write_bytes(made if only else raw[: ends[at]] + made + raw[after:])
    with suppress(RecordingError):
        read_recording(path)
    kept = [file.read_bytes() for file in folder.iterdir() if ".before" in file.name or file == path]
    with h5py.File(path) as file:
        held = file["imu/imu/rate_rps"][()] if "imu/imu/rate_rps" in file else RATE[:0]
    assert before in kept or np.array_equal(held[:30], RATE[:30])
    assert not list(folder.glob(".*.part"))


@settings(max_examples=60, suppress_health_check=list(HealthCheck), deadline=None)
@MUTATED
@example(payload=[[1, "imu/imu", {"t_ns": "now", "rate_rps": "fast"}]], at=5, only=False, replaced=True)
def test_no_journal_that_anybody_makes_ends_the_reader_or_destroys_a_recording(
    dead: Path, tmp_path_factory: pytest.TempPathFactory, payload: Any, at: int, only: bool, replaced: bool
) -> None:
    folder = shutil.copytree(dead, tmp_path_factory.mktemp("made") / "x")
    check_made(folder, payload, at=at, only=only, replaced=replaced)


@pytest.mark.full
@settings(max_examples=5000, suppress_health_check=list(HealthCheck), deadline=None)
@MUTATED
def test_nor_do_thousands_of_them(
    dead: Path, tmp_path_factory: pytest.TempPathFactory, payload: Any, at: int, only: bool, replaced: bool
) -> None:
    folder = shutil.copytree(dead, tmp_path_factory.mktemp("made") / "x")
    check_made(folder, payload, at=at, only=only, replaced=replaced)
    shutil.rmtree(folder)


def relabelled(path: Path, identity: str | None) -> None:
    """Give the recording at a path another number, or none as before there were any."""
    with h5py.File(path, "r+") as file:
        del file.attrs["recording_id"]
        if identity is not None:
            file.attrs["recording_id"] = identity


def without_identity(journal: Path) -> None:
    """Take the number out of a journal, as it was before there were any."""
    raw = journal.read_bytes()
    first = boundaries(raw)[0]
    entries = msgpack.unpackb(raw[12:first])
    del entries[0][2]["recording_id"]
    journal.write_bytes(record(msgpack.packb(entries)) + raw[first:])


def test_a_journal_of_another_run_is_named_and_nothing_is_touched(
    dead: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    relabelled(path, "0" * 32)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert rows_of(path) == 30
    assert "it belongs to another run than run.h5" in caplog.text
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


@pytest.mark.skipif(os.name != "posix" or os.geteuid() != 0, reason="only root can give a file away")
def test_a_journal_that_another_user_made_with_the_number_of_a_recording_is_not_used(
    dead: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    os.chown(path.with_name("run.h5.journal"), 54321, 54321)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    assert rows_of(path) == 30
    assert "it belongs to another user than run.h5" in caplog.text
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


@pytest.mark.parametrize("which", ["both", "the journal", "the recording"])
def test_files_from_before_there_were_numbers_are_recovered(dead: Path, tmp_path: Path, which: str) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    if which != "the journal":
        relabelled(path, None)
    if which != "the recording":
        without_identity(path.with_name("run.h5.journal"))
    assert rows_of(path) == 60


def test_files_without_numbers_are_of_two_runs_if_these_began_otherwise(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    relabelled(path, None)
    without_identity(path.with_name("run.h5.journal"))
    with h5py.File(path, "r+") as file:
        file.attrs["clock_zero_utc_s"] = 1.8e9
    assert rows_of(path) == 30
    assert path.with_name("run.h5.journal").exists()


def test_results_that_are_in_the_recording_alone_are_kept(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    with h5py.File(path, "r+") as file:
        file["calibration/states"] = np.arange(4.0)
    before = path.read_bytes()
    assert rows_of(path) == 60
    assert path.with_name("run.h5.before").read_bytes() == before


def test_a_whole_recording_beside_a_damaged_journal_of_its_run_stays(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    journal = path.with_name("run.h5.journal")
    raw = bytearray(journal.read_bytes())
    assert rows_of(path) == 60  # whole from now on
    raw[boundaries(raw)[4] + 30] ^= 0xFF
    journal.write_bytes(raw)
    before = path.read_bytes()
    assert rows_of(path) == 60
    assert path.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked")
def test_a_stranger_who_locks_the_folder_does_not_keep_the_reader_waiting_for_ever(
    dead: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import fcntl

    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    monkeypatch.setattr("estimator.recordings.recovery._PATIENCE_S", 0.05)
    folder = os.open(path.parent, os.O_RDONLY)
    fcntl.flock(folder, fcntl.LOCK_EX)
    with pytest.raises(RecordingError, match="another program has locked the folder"):
        read_recording(path)
    os.close(folder)
    assert rows_of(path) == 60


@pytest.mark.parametrize("raw", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_journal_is_refused_and_the_recording_is_as_it_was(dead: Path, tmp_path: Path, raw: bytes) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    path.with_name("run.h5.journal").write_bytes(raw)
    assert rows_of(path) == 30
    assert sorted(os.listdir(tmp_path)) == ["x"]
    assert not [name for name in os.listdir(path.parent) if name.endswith(".part")]


def test_a_journal_with_what_is_no_run_beside_a_good_recording_destroys_nothing(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    before = path.read_bytes()
    rows = [1, "imu/imu", {"t_ns": array("<i8", [1], bytes(8)), "rate_rps": array("<f8", [1, 3], bytes(24))}]
    path.with_name("run.h5.journal").write_bytes(record(msgpack.packb([rows])))
    assert rows_of(path) == 30 or path.with_name("run.h5.before").read_bytes() == before


def test_two_that_open_at_once_both_have_it(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(rows_of, [path] * 4)) == [60] * 4
    assert os.listdir(path.parent) == ["run.h5"]


def test_a_recovery_that_was_killed_itself_is_made_again(dead: Path, tmp_path: Path) -> None:
    path = shutil.copytree(dead, tmp_path / "x") / "run.h5"
    path.with_name(".run.h5.1.part").write_bytes(path.read_bytes()[:1000])
    assert rows_of(path) == 60


READ_IN_A_FOLDER_THAT_CANNOT_BE_WRITTEN = """
import sys
from pathlib import Path
from estimator.recordings.reading import read_recording
try:
    read_recording(Path(sys.argv[1]))
except Exception as error:
    print(type(error).__name__, error)
"""


def test_in_a_folder_that_cannot_be_written_it_is_said_what_to_do(dead: Path) -> None:
    made = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    mount = f"mount --bind '{dead}' '{dead}' && mount -o remount,bind,ro '{dead}'"
    if os.name != "posix" or subprocess.run([*made, mount], capture_output=True, check=False).returncode:
        pytest.skip("no folder can be mounted here")
    read = [sys.executable, "-c", READ_IN_A_FOLDER_THAT_CANNOT_BE_WRITTEN, dead / "run.h5"]
    done = subprocess.run(
        [*made, f'{mount} && exec "$@"', "sh", *read], capture_output=True, text=True, check=False
    )  # fmt: skip
    assert "RecordingError" in done.stdout
    assert "60 samples" in done.stdout
    assert "copy both" in done.stdout
