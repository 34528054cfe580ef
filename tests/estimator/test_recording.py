"""Recordings as files: what is written comes back, and what cannot be read is refused with its reason."""

from __future__ import annotations

import dataclasses
import json
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import pytest

from estimator.errors import RecordingError
from estimator.geometry.array import sensor_array, tetrahedron, triad
from estimator.geometry.kinematics import Site
from estimator.geometry.model import Prior
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import FORMAT_VERSION, ImuData, Recording
from estimator.recordings.reference import AttitudeReadings, RateReadings, Reference, TableReadings, Turns
from estimator.recordings.safe_open import probe
from estimator.recordings.writing import RecordingWriter, write_attributes, write_recording, write_results
from station.bench.bench import default_bench_text
from station.cli import main

RNG = np.random.default_rng(1)
T_NS = np.arange(200, dtype=np.int64) * 10_000_000 + 5
TABLE = TableReadings(
    t_ns=T_NS[::5],
    angle_rad=RNG.normal(size=(40, 3)),
    rate_rps=RNG.normal(size=(40, 3)),
    gimbals=("z", "y", "x"),
    half_width_ns=np.arange(40, dtype=np.int64) * 100_000,
)


def recording(reference: Reference = TABLE) -> Recording:
    skewed = sensor_array(np.eye(3), np.roll(np.eye(3), 1, axis=1), np.roll(np.eye(3), 2, axis=1))
    full = ImuData(
        skewed,
        T_NS,
        RNG.normal(size=(200, 3)),
        temperature_c=RNG.normal(25, 1, 200),
        accel_mps2=RNG.normal(size=(200, 3)),
        counter=np.arange(200, dtype=np.int64),
        lost=7,
        prior=Prior(0.01, 0.002, 0.003),
    )
    plain = ImuData(tetrahedron(), T_NS[:150], RNG.normal(size=(150, 4)))
    return Recording({"a": full, "b": plain}, reference, Site(0.7, 1.1), {"device": "unit 7", "seed": 3})


@pytest.fixture
def path(tmp_path: Path) -> Path:
    file = tmp_path / "run.h5"
    write_recording(file, recording())
    return file


def changed(path: Path, change: Callable[[Any], None]) -> Path:
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def remove(name: str) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[name]

    return change


def replace(name: str, values: Any) -> Callable[[Any], None]:
    def change(file: Any) -> None:
        del file[name]
        file[name] = values

    return change


def test_what_is_written_comes_back(tmp_path: Path) -> None:
    sent = recording()
    write_recording(tmp_path / "run.h5", sent)
    found = read_recording(tmp_path / "run.h5")
    assert found.site == sent.site
    assert found.path == tmp_path / "run.h5"
    assert found.name == "run.h5"
    assert {key: found.attributes[key] for key in sent.attributes} == dict(sent.attributes)
    assert list(found.sources) == ["a", "b"]
    for name, data in sent.sources.items():
        got = found.sources[name]
        assert got.array.names == data.array.names
        for axes in ("p", "j", "k"):
            np.testing.assert_array_equal(getattr(got.array, axes), getattr(data.array, axes))
        for values in ("t_ns", "rate_rps", "temperature_c", "accel_mps2", "counter"):
            np.testing.assert_array_equal(getattr(got, values), getattr(data, values), values)
        assert (got.lost, got.prior) == (data.lost, data.prior)
    assert isinstance(found.reference, TableReadings)
    assert found.reference.gimbals == ("z", "y", "x")
    np.testing.assert_array_equal(found.reference.t_ns, TABLE.t_ns)
    np.testing.assert_array_equal(found.reference.angle_rad, TABLE.angle_rad)
    np.testing.assert_array_equal(found.reference.rate_rps, TABLE.rate_rps)
    np.testing.assert_array_equal(found.reference.half_width_ns, TABLE.half_width_ns)


def test_the_time_that_rates_are_means_of_is_kept_and_is_none_in_older_recordings(tmp_path: Path) -> None:
    write_recording(tmp_path / "run.h5", recording(dataclasses.replace(TABLE, rate_window_ns=250_000_000)))
    found = read_recording(tmp_path / "run.h5", trusted=True).reference
    assert isinstance(found, TableReadings)
    assert found.rate_window_ns == 250_000_000
    with h5py.File(tmp_path / "run.h5", "a") as file:
        del file["table"].attrs["rate_window_ns"]
    older = read_recording(tmp_path / "run.h5", trusted=True).reference
    assert isinstance(older, TableReadings)
    assert older.rate_window_ns == 0


def test_readings_without_half_widths_have_none(tmp_path: Path) -> None:
    write_recording(tmp_path / "run.h5", recording(dataclasses.replace(TABLE, half_width_ns=None)))
    found = read_recording(tmp_path / "run.h5", trusted=True).reference
    assert isinstance(found, TableReadings)
    assert found.half_width_ns is None


@pytest.mark.parametrize(
    "reference",
    [
        RateReadings(T_NS, RNG.normal(size=(200, 3))),
        AttitudeReadings(T_NS, RNG.normal(size=(200, 4))),
        Turns(T_NS[:3], T_NS[3:6], RNG.normal(size=(3, 3)), np.array([0.1, 0.2, 0.3])),
    ],
    ids=lambda r: type(r).__name__,
)
def test_every_kind_of_reference_comes_back(tmp_path: Path, reference: Reference) -> None:
    write_recording(tmp_path / "run.h5", recording(reference))
    found = read_recording(tmp_path / "run.h5").reference
    assert type(found) is type(reference)
    for name in type(reference).__slots__:
        np.testing.assert_array_equal(getattr(found, name), getattr(reference, name), name)


def test_datasets_say_their_units(path: Path) -> None:
    with h5py.File(path) as file:
        units = {
            name: file[name].attrs["units"]
            for name in (
                "table/t_ns",
                "table/angle_rad",
                "table/rate_rps",
                "table/half_width_ns",
                "imu/a/t_ns",
                "imu/a/rate_rps",
                "imu/a/temperature_c",
                "imu/a/accel_mps2",
            )
        }
    assert list(units.values()) == ["ns", "rad", "rad/s", "ns", "ns", "rad/s", "degC", "m/s2"]


def test_a_recording_without_site_has_none(tmp_path: Path) -> None:
    sent = recording()
    write_recording(tmp_path / "run.h5", Recording(sent.sources, sent.reference))
    assert read_recording(tmp_path / "run.h5").site is None


SKEWED_ACCELEROMETERS = np.array([[0.6, 0.8, 0.0], [0.0, 0.6, 0.8], [0.8, 0.0, 0.6], [0.0, 0.0, 1.0]])


def with_skewed_accelerometers() -> tuple[Recording, np.ndarray]:
    """Return a recording whose source has four accelerometers along axes of their own, and the true specific force."""
    force_mps2 = RNG.normal(size=(200, 3))
    sent = recording()
    data = dataclasses.replace(
        sent.sources["a"], accel_mps2=force_mps2 @ SKEWED_ACCELEROMETERS.T, accel_axes=SKEWED_ACCELEROMETERS
    )
    return dataclasses.replace(sent, sources={"a": data}), force_mps2


def test_accelerometers_along_axes_of_their_own_give_the_specific_force_of_the_body(tmp_path: Path) -> None:
    sent, force_mps2 = with_skewed_accelerometers()
    write_recording(tmp_path / "run.h5", sent)
    found = read_recording(tmp_path / "run.h5", trusted=True)
    np.testing.assert_array_equal(found.sources["a"].accel_mps2, sent.sources["a"].accel_mps2)
    np.testing.assert_allclose(found.sources["a"].specific_force_mps2, force_mps2, atol=1e-12)
    np.testing.assert_allclose(found.sources["a"].to_frame().iloc[:, -3:], force_mps2, atol=1e-12)
    assert found.attributes["format_version"] == 2  # who reads only version 1 takes them for axes of the body


def test_accelerations_of_a_recording_without_their_axes_are_along_the_body(path: Path) -> None:
    found = read_recording(path, trusted=True)
    data = found.sources["a"]
    assert found.attributes["format_version"] == 1
    assert data.accel_mps2 is not None
    assert data.specific_force_mps2 is data.accel_mps2


@pytest.mark.parametrize(
    ("axes", "complaint"),
    [
        (np.eye(3), "has 4 accelerometers, but accel_axes of the shape"),
        (np.ones((4, 3)), "accel_axes do not span all directions"),
        (np.full((4, 3), np.nan), "accel_axes do not span all directions"),
    ],
)
def test_impossible_axes_of_accelerometers_are_refused(tmp_path: Path, axes: np.ndarray, complaint: str) -> None:
    write_recording(tmp_path / "run.h5", with_skewed_accelerometers()[0])

    def change(file: Any) -> None:
        file["imu/a"].attrs["accel_axes"] = axes

    with pytest.raises(RecordingError, match=f"/imu/a.* {complaint}"):
        read_recording(changed(tmp_path / "run.h5", change), trusted=True)


def test_nothing_is_overwritten(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(RecordingError, match=r"cannot create .*run\.h5"):
        write_recording(path, recording())
    assert path.read_bytes() == before


def test_folders_are_made_on_the_way(tmp_path: Path) -> None:
    write_recording(tmp_path / "new" / "folder" / "run.h5", recording())
    assert read_recording(tmp_path / "new" / "folder" / "run.h5").name == "run.h5"


def test_rows_may_come_in_any_portions(tmp_path: Path) -> None:
    whole = RNG.normal(size=(5000, 3))
    t_ns = np.arange(5000, dtype=np.int64)
    writer = RecordingWriter(tmp_path / "run.h5", {})
    writer.add_table(("z", "y", "x"))
    writer.add_source("imu", triad(), Prior(), {"rate_hz": 100.0})
    at = 0
    for rows in (1, 1, 17, 0, 481, 2500, 2000):
        writer.append_rows("imu/imu", {"t_ns": t_ns[at : at + rows]})
        writer.append_rows("imu/imu", {"rate_rps": whole[at : at + rows]})
        if rows != 17:
            writer.flush()
        at += rows
    for name, values in (("t_ns", TABLE.t_ns), ("angle_rad", TABLE.angle_rad), ("rate_rps", TABLE.rate_rps)):
        writer.append_rows("table", {name: values})
    writer.set_source("imu", {"lost": 3})
    writer.close()
    writer.close()
    found = read_recording(tmp_path / "run.h5").sources["imu"]
    np.testing.assert_array_equal(found.rate_rps, whole)
    np.testing.assert_array_equal(found.t_ns, t_ns)
    assert found.lost == 3


def test_texts_are_kept_to_240_bytes_of_whole_letters(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.h5", {})
    writer.append_text("events", {"t_ns": 5}, "text", "table is home")
    writer.append_text("events", {"t_ns": 6}, "text", "µ" * 200)
    writer.close()
    with h5py.File(tmp_path / "run.h5") as file:
        texts = [value.decode() for value in file["events/text"][()]]
        assert list(file["events/t_ns"][()]) == [5, 6]
    assert texts == ["table is home", "µ" * 120]


def test_results_take_the_place_of_those_before(path: Path) -> None:
    for n in (3, 2):
        write_results(path, "calibration", {"states": np.full((n, 4), n)}, {"samples": n})
    write_attributes(path, {"outcome": "PASS"})
    with h5py.File(path) as file:
        assert file["calibration/states"].shape == (2, 4)
        assert file["calibration"].attrs["samples"] == 2
    assert read_recording(path).attributes["outcome"] == "PASS"


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"absent\.h5 is not a file"):
        read_recording(tmp_path / "absent.h5")
    with pytest.raises(RecordingError, match="is not a file"):
        read_recording(tmp_path)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.h5").touch()
    with pytest.raises(RecordingError, match=r"empty\.h5 cannot be read: it is empty"):
        read_recording(tmp_path / "empty.h5")


def test_a_text_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("t,x,y,z\n0,1,2,3\n")
    with pytest.raises(RecordingError, match="it is not an HDF5 file. Import external data with `station import`"):
        read_recording(tmp_path / "text.h5")


@pytest.mark.parametrize("share", [0.02, 0.5, 0.95])
def test_a_file_cut_short_is_refused(path: Path, share: float) -> None:
    raw = path.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    with pytest.raises(RecordingError, match="cannot be read: it is damaged or cut short"):
        read_recording(path)


def test_a_foreign_hdf5_file_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["gyro"] = np.zeros((10, 3))
    with pytest.raises(RecordingError, match=r"is an HDF5 file but not a recording: .*`station import`"):
        read_recording(tmp_path / "foreign.h5")


@pytest.mark.parametrize("version", [FORMAT_VERSION + 1, "1", None])
def test_a_later_or_unknown_format_version_is_refused(path: Path, version: object) -> None:
    def change(file: Any) -> None:
        del file.attrs["format_version"]
        if version is not None:
            file.attrs["format_version"] = version

    with pytest.raises(
        RecordingError, match=f"format version {version}, but this program reads versions up to {FORMAT_VERSION}"
    ):
        read_recording(changed(path, change), trusted=True)


@pytest.mark.parametrize(
    ("missing", "complaint"),
    [
        ("imu", "holds no IMU samples"),
        ("imu/a/t_ns", "/imu/a has no t_ns"),
        ("imu/b/rate_rps", "/imu/b has no rate_rps"),
        ("table", "neither /table nor /reference"),
        ("table/t_ns", "/table holds no readings"),
        ("table/angle_rad", "/table has no angle_rad"),
    ],
)
def test_a_missing_dataset_is_named(path: Path, missing: str, complaint: str) -> None:
    with pytest.raises(RecordingError, match=complaint):
        read_recording(changed(path, remove(missing)), trusted=True)


def test_rates_of_a_table_that_tells_only_angles_come_from_these(tmp_path: Path) -> None:
    speed_rps = np.array([3.0, -0.2, 0.1])
    angle = (TABLE.t_ns - TABLE.t_ns[0])[:, None] * 1e-9 * speed_rps
    angle = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
    angle[7, 1] = np.nan
    file = tmp_path / "angles.h5"
    write_recording(file, recording(dataclasses.replace(TABLE, angle_rad=angle)))
    told = read_recording(changed(file, remove("table/rate_rps")), trusted=True).reference
    assert isinstance(told, TableReadings)
    assert len(told.t_ns) == len(TABLE.t_ns) - 1
    np.testing.assert_allclose(told.rate_rps, np.tile(speed_rps, (len(told.t_ns), 1)), rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "values", "complaint"),
    [
        ("imu/a/rate_rps", np.zeros((200, 2)), "2 channels but 3 sense axes"),
        ("imu/a/t_ns", np.zeros((200, 2)), "t_ns must have 1 dimensions, it has 2"),
        ("imu/a/rate_rps", np.array([b"fast"] * 200), "rate_rps is not numeric"),
        ("table/angle_rad", np.zeros((40, 2)), "one column per axis"),
        ("table/rate_rps", np.zeros((1, 3)), "two or more rows"),
    ],
)
def test_a_dataset_of_another_shape_is_refused(path: Path, name: str, values: Any, complaint: str) -> None:
    with pytest.raises(RecordingError, match=complaint):
        read_recording(changed(path, replace(name, values)), trusted=True)


def test_skewed_axes_in_a_file_are_refused_with_their_source(path: Path) -> None:
    def change(file: Any) -> None:
        file["imu/a"].attrs["j"] = file["imu/a"].attrs["p"]

    with pytest.raises(RecordingError, match="/imu/a: axes p, j, k of gyro1 are not orthonormal"):
        read_recording(changed(path, change), trusted=True)


def test_a_source_needs_its_sense_axes(path: Path) -> None:
    def change(file: Any) -> None:
        del file["imu/b"].attrs["p"]

    with pytest.raises(RecordingError, match="/imu/b has no sense axes p"):
        read_recording(changed(path, change), trusted=True)


def test_tilt_axes_may_be_left_out(path: Path) -> None:
    def change(file: Any) -> None:
        for key in ("j", "k", "names", "prior", "lost"):
            del file["imu/b"].attrs[key]

    found = read_recording(changed(path, change), trusted=True).sources["b"]
    np.testing.assert_allclose(found.array.j, tetrahedron().j, atol=1e-12)
    np.testing.assert_allclose(found.array.k, tetrahedron().k, atol=1e-12)
    assert found.array.names == ("b1", "b2", "b3", "b4")
    assert (found.lost, found.prior) == (0, Prior())


def test_axes_may_be_datasets(path: Path) -> None:
    def change(file: Any) -> None:
        for key in "pjk":
            values = file["imu/a"].attrs[key]
            del file["imu/a"].attrs[key]
            file[f"imu/a/{key}"] = values

    found = read_recording(changed(path, change), trusted=True).sources["a"]
    np.testing.assert_array_equal(found.array.p, np.eye(3))
    np.testing.assert_array_equal(found.array.j, np.roll(np.eye(3), 1, axis=1))


def test_a_single_gyro_may_be_one_column(path: Path) -> None:
    def change(file: Any) -> None:
        group = file.create_group("imu/single")
        group["t_ns"], group["rate_rps"] = T_NS, np.arange(200.0)
        group.attrs["p"] = [0.0, 0.0, 1.0]

    found = read_recording(changed(path, change), trusted=True).sources["single"]
    assert found.rate_rps.shape == (200, 1)
    assert found.array.names == ("single",)


def test_columns_of_the_table_may_stand_in_another_order_than_its_gimbals(path: Path) -> None:
    def change(file: Any) -> None:
        file["table"].attrs["axes"] = ["x", "y", "z"]
        for name in ("angle_rad", "rate_rps"):
            file[f"table/{name}"][...] = file[f"table/{name}"][()][:, ::-1]

    found = read_recording(changed(path, change), trusted=True).reference
    assert isinstance(found, TableReadings)
    assert found.gimbals == ("z", "y", "x")
    np.testing.assert_array_equal(found.angle_rad, TABLE.angle_rad)
    np.testing.assert_array_equal(found.rate_rps, TABLE.rate_rps)


def test_axes_that_are_not_the_gimbals_are_refused(path: Path) -> None:
    def change(file: Any) -> None:
        file["table"].attrs["axes"] = ["x", "y", "w"]

    with pytest.raises(RecordingError, match="does not name the gimbals"):
        read_recording(changed(path, change), trusted=True)


def test_gimbals_default_to_the_columns(path: Path) -> None:
    def change(file: Any) -> None:
        del file["table"].attrs["gimbals"]

    found = read_recording(changed(path, change), trusted=True).reference
    assert isinstance(found, TableReadings)
    assert found.gimbals == ("z", "y", "x")


def test_table_rows_that_hold_no_number_are_left_out(path: Path) -> None:
    def change(file: Any) -> None:
        file["table/angle_rad"][3, 1] = np.nan
        file["table/rate_rps"][5, 0] = np.inf

    found = read_recording(changed(path, change), trusted=True).reference
    assert isinstance(found, TableReadings)
    np.testing.assert_array_equal(found.t_ns, np.delete(TABLE.t_ns, [3, 5]))
    np.testing.assert_array_equal(found.half_width_ns, np.delete(TABLE.half_width_ns, [3, 5]))


def test_half_widths_stay_with_their_readings_where_angles_give_the_rates(path: Path) -> None:
    def change(file: Any) -> None:
        file["table/angle_rad"][3, 1] = np.nan
        del file["table/rate_rps"]

    found = read_recording(changed(path, change), trusted=True).reference
    assert isinstance(found, TableReadings)
    np.testing.assert_array_equal(found.t_ns, np.delete(TABLE.t_ns, 3))
    np.testing.assert_array_equal(found.half_width_ns, np.delete(TABLE.half_width_ns, 3))


@pytest.mark.parametrize("short", ["t_ns", "rate_rps", "temperature_c", "counter"])
def test_a_run_cut_between_two_datasets_is_used_as_far_as_all_go(path: Path, short: str) -> None:
    def change(file: Any) -> None:
        file[f"imu/a/{short}"].resize(120, axis=0)

    found = read_recording(changed(path, change), trusted=True).sources["a"]
    for values in (found.t_ns, found.rate_rps, found.temperature_c, found.accel_mps2, found.counter):
        assert values is not None
        assert len(values) == 120


def test_readings_whose_half_width_was_not_written_any_more_keep_the_last_one(path: Path) -> None:
    def change(file: Any) -> None:
        file["table/half_width_ns"].resize(30, axis=0)

    found = read_recording(changed(path, change), trusted=True).reference
    assert isinstance(found, TableReadings)
    assert TABLE.half_width_ns is not None
    assert len(found.t_ns) == 40
    np.testing.assert_array_equal(found.half_width_ns, np.minimum(TABLE.half_width_ns, TABLE.half_width_ns[29]))


def test_a_run_records_how_far_the_instant_of_each_reading_can_be_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bench, script = tmp_path / "bench.toml", tmp_path / "rest.toml"
    bench.write_text(default_bench_text() + '\n[twin.fault]\nlatency = "4 ms"\n')  # 4 ms there and 4 ms back
    script.write_text('name = "rest"\n[[step]]\nkind = "rest"\nduration = "2 s"\n')
    main(["run", "--bench", str(bench), "--script", str(script), "-o", str(tmp_path / "run.h5"), "--json"])
    found = read_recording(tmp_path / "run.h5", trusted=True).reference
    assert isinstance(found, TableReadings)
    assert found.half_width_ns is not None
    assert len(found.t_ns) > 20
    np.testing.assert_array_equal(found.half_width_ns, 4_000_000)
    assert json.loads(capsys.readouterr().out)["recording"] == str(tmp_path / "run.h5")


def readers() -> list[psutil.Process]:
    """Return the process that has files read for this one, and after it the fork of it that reads them."""
    for one in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # one of another test, that has ended
            if "probe.py" in " ".join(one.cmdline()):
                return [one, *one.children()]
    return []


@pytest.mark.parametrize(("dies", "said"), [(False, "did not end within"), (True, "the HDF5 library failed on it")])
def test_a_file_that_its_reader_hangs_or_dies_on_is_told_and_leaves_no_process(
    path: Path, dies: bool, said: str
) -> None:
    probe(path)
    begun = readers()
    begun[-1].suspend()  # as if it hung in the file
    if dies:
        threading.Timer(0.2, begun[-1].kill).start()
    with pytest.raises(RecordingError, match=said):
        probe(path, limit_s=30.0 if dies else 0.2)
    gone, left = psutil.wait_procs(begun, timeout=10)
    assert len(gone) == len(begun)
    assert not left
    probe(path)


def test_a_file_after_one_that_cannot_be_read_is_read_by_another_process(path: Path, tmp_path: Path) -> None:
    probe(path)
    before = readers()[-1]
    (tmp_path / "cut.h5").write_bytes(path.read_bytes()[:-100])
    with pytest.raises(RecordingError, match="damaged or cut short"):
        probe(tmp_path / "cut.h5")
    probe(path)
    assert readers()[-1] != before
