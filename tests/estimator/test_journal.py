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


@pytest.fixture(scope="module")
def dead(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a run left that died after 12 blocks, with 6 of them flushed."""
    folder = tmp_path_factory.mktemp("dead")
    writer = begin(folder / "run")
    take(writer, *range(6))
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
    else:  # nothing of it can be used: the recording is what it is, or is said not to be one
        with suppress(RecordingError):
            read_recording(path)


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
