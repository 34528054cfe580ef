"""A disk that another program fills: the recording is closed whole, with all that was taken, and can be read."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.errors import RecordingError
from estimator.geometry.array import triad
from estimator.recordings.journal import journal_of
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import RecordingWriter, write_attributes, write_recording, write_results

IN_A_SMALL_DISK = ["unshare", "--map-root-user", "--mount", "sh", "-c"]


def fill_and_write(folder: Path) -> None:
    """Write a recording, have the disk filled in the midst of it, go on: what a session does."""
    path, rows = folder / "run.h5", np.arange(500)
    writer = RecordingWriter(path, {"outcome": "ABORTED"})

    def take_a_block() -> None:
        writer.append_rows("imu/a", {"t_ns": rows})
        writer.append_rows("imu/a", {"rate_rps": np.zeros((500, 4))})
        writer.flush()

    for _ in range(10):
        take_a_block()
    with open(folder / "other", "wb", buffering=0) as other, suppress(OSError):
        while True:
            other.write(bytes(1 << 14))
    assert shutil.disk_usage(folder).free == 0
    with pytest.raises(RecordingError, match="the disk of .* is full"):
        take_a_block()
    writer.append_text("events", {"t_ns": 5}, "text", "table at rest")
    writer.close()
    with pytest.raises(RecordingError, match="the file is unchanged"):
        write_results(path, "estimate/a", {"states": np.zeros((40_000, 4, 4))}, {})
    write_attributes(path, {"outcome": "FAULT"})
    probe(path)
    with h5py.File(path) as file:
        assert len(file["imu/a/t_ns"]) == len(file["imu/a/rate_rps"]) == 5500
        assert list(file["events/text"]) == [b"table at rest"]
        assert file.attrs["outcome"] == "FAULT"
        assert "estimate" not in file
    with pytest.raises(
        RecordingError, match=r"2 MB are reserved for closing the file\). Free some " r"space, or choose another disk"
    ):
        RecordingWriter(folder / "next.h5", {})
    assert sorted(os.listdir(folder)) == ["other", "run.h5"]


def test_a_disk_that_another_program_fills_costs_nothing_that_was_taken(tmp_path: Path) -> None:
    mount = f"mount -t tmpfs -o size=4m tmpfs '{tmp_path}'"
    if os.name != "posix" or subprocess.run([*IN_A_SMALL_DISK, mount], capture_output=True, check=False).returncode:
        pytest.skip("no small disk can be mounted here")
    done = subprocess.run(
        [*IN_A_SMALL_DISK, f"{mount} && exec '{sys.executable}' '{__file__}' '{tmp_path}'"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


if __name__ == "__main__":
    fill_and_write(Path(sys.argv[1]))


def write_until_refused(writer: RecordingWriter) -> None:
    for _ in range(400):
        writer.append_rows("imu/a", {"rate_rps": np.zeros((500, 4))})
        writer.flush()


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of a process")
def test_a_limit_on_the_size_of_files_leaves_a_recording_that_can_be_read(tmp_path: Path) -> None:
    import resource

    path, before = tmp_path / "run.h5", resource.getrlimit(resource.RLIMIT_FSIZE)
    writer = RecordingWriter(path, {}, journal=True)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4_000_000, before[1]))
    try:
        with pytest.raises(RecordingError, match="Raise the limit"):
            write_until_refused(writer)
        writer.append_text("events", {"t_ns": 5}, "text", "table at rest")
        writer.close()
        write_attributes(path, {"outcome": "FAULT"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    with h5py.File(path) as file:
        assert len(file["imu/a/rate_rps"]) > 50_000
        assert list(file["events/text"]) == [b"table at rest"]
        assert file.attrs["outcome"] == "FAULT"
    assert not writer.complete  # the rows that were refused may be in the journal
    writer.finish()
    assert journal_of(path).exists()


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of a process")
def test_a_recording_that_does_not_fit_is_refused_and_leaves_no_file(tmp_path: Path) -> None:
    import resource

    t_ns = np.arange(200_000) * 1_000_000
    rate_rps = np.zeros((len(t_ns), 3))
    recording = Recording({"imu": ImuData(triad(), t_ns, rate_rps)}, RateReadings(t_ns, rate_rps))
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, before[1]))
    try:
        with pytest.raises(RecordingError, match="Raise the limit"):
            write_recording(tmp_path / "run.h5", recording)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
    write_recording(tmp_path / "run.h5", recording)


@pytest.mark.skipif(sys.platform == "win32", reason="there are no limits of a process")
@pytest.mark.parametrize("journal", [False, True])
def test_a_recording_that_cannot_be_begun_leaves_no_file(tmp_path: Path, journal: bool) -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, before[1]))  # as much as is reserved, and nothing more
    try:
        with pytest.raises(RecordingError, match="Raise the limit"):
            RecordingWriter(tmp_path / "run.h5", {"operator": "A. Operator"}, journal=journal)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
    with pytest.raises((RecordingError, TypeError)):
        RecordingWriter(tmp_path / "run.h5", {"operator": {"name": "A. Operator"}}, journal=journal)
    assert not list(tmp_path.iterdir())
    RecordingWriter(tmp_path / "run.h5", {"operator": "A. Operator"}, journal=journal).close()
