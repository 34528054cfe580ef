"""Devices that are mounted otherwise on the table: what the bench file says, the twin feels, and a recording holds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.estimation.calibrate import calibrate
from estimator.recordings.reading import read_recording
from estimator.recordings.writing import write_recording
from station.bench.bench import Bench, read_bench
from station.cli import main
from station.errors import BenchError
from station.exports.exported import exported_of, file_sha256, raw_sha256
from station.opening.simulate import simulate_bench
from station.scripts.script import Rest, Script, load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "one_axis_imu.toml"
LIMITS = """
[limits]
sd_scale_factor_error = "100 ppm"
[limits.accelerometers]
sd_scale_factor_error = "200 ppm"
"""


def mounted(axes: str, more: str = "") -> Bench:
    """Return the bench with its device mounted along ``axes``, with ``more`` in place of its mounting error."""
    text = BENCH.read_text(encoding="utf-8").replace('["x", "y", "z"]', axes)
    text = text.replace('rate = "100 Hz"', 'rate = "50 Hz"')
    return read_bench(text.replace('{ x = "0 mrad", y = "0 mrad", z = "0 mrad" }', more or "{}"), "bench")


@pytest.mark.parametrize(
    ("axes", "up"), [('["y", "z", "x"]', 1), ('["z", "x", "y"]', 0), ('["x", "-y", "-z"]', 2), ('["x", "y", "z"]', 2)]
)
def test_gravity_is_felt_by_the_axis_that_points_up(axes: str, up: int) -> None:
    bench = mounted(axes)
    felt = simulate_bench(bench, Script("rest", (Rest(4.0, "rest"),)), 1).sources["mti"].accel_mps2
    assert felt is not None
    sign = -1.0 if f'"-{"xyz"[up]}"' in axes else 1.0
    assert felt.mean(axis=0) == pytest.approx(9.8 * sign * np.eye(3)[up], abs=0.15)


def test_a_mounting_error_turns_the_device_about_its_own_axes() -> None:
    """Turned by 20 mrad about its x axis, the device has gravity along its y axis, too: g sin(20 mrad)."""
    scripts = Script("rest", (Rest(4.0, "rest"),))
    straight, turned = (
        simulate_bench(mounted('["x", "y", "z"]', error), scripts, 1).sources["mti"].accel_mps2
        for error in ("", '{ x = "20 mrad" }')
    )
    assert straight is not None
    assert turned is not None
    assert (turned - straight).mean(axis=0) == pytest.approx([0.0, 9.806 * np.sin(0.02), 0.0], abs=0.01)


def test_a_gyro_that_is_left_out_leaves_the_others_beside_rounded_angles() -> None:
    count_rad = 2 * np.pi / 65536
    run = simulate_bench(mounted('["x", "y", "z"]'), load_script(Path("full-imu-one-axis")), 1)
    table, data = run.table, run.sources["mti"]
    assert table is not None
    dead_rps = np.where(np.arange(3) == 1, np.nan, data.rate_rps)
    rounded = replace(table, angle_rad=np.round(table.angle_rad / count_rad) * count_rad)
    run = replace(run, reference=rounded, site=None, sources={"mti": replace(data, rate_rps=dead_rps)})
    assert [gyro.name for gyro in calibrate(run, innovations=False).gyros] == ["x", "z"]


def test_a_recording_holds_the_mounting(tmp_path: Path) -> None:
    bench = mounted('["y", "z", "x"]')
    recording = simulate_bench(bench, Script("rest", (Rest(4.0, "rest"),)), 1)
    write_recording(tmp_path / "a.h5", recording)
    data = read_recording(tmp_path / "a.h5").sources["mti"]
    np.testing.assert_array_equal(data.mounting.axes, [[0, 1, 0], [0, 0, 1], [1, 0, 0]])
    assert data.mounting.sd_rad == pytest.approx(np.radians(0.2))
    np.testing.assert_array_equal(data.array.p, data.mounting.axes)


def test_a_run_over_the_wires_holds_it_too(tmp_path: Path) -> None:
    bench, script, path = tmp_path / "bench.toml", tmp_path / "script.toml", tmp_path / "a.h5"
    bench.write_text(BENCH.read_text(encoding="utf-8").replace('["x", "y", "z"]', '["z", "x", "y"]'))
    script.write_text('name = "short"\n[[step]]\nkind = "rest"\nduration = "10 s"\n')
    main(["run", "--bench", str(bench), "--script", str(script), "-o", str(path)])
    data = read_recording(path).sources["mti"]
    np.testing.assert_array_equal(data.mounting.axes, [[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert data.accel_mps2 is not None
    assert data.accel_mps2.mean(axis=0) == pytest.approx([9.8, 0.0, 0.0], abs=0.15)


@pytest.mark.parametrize("axes", ['["x", "y"]', '["x", "x", "z"]', '["x", "z", "y"]', '["x", "y", "up"]'])
def test_a_mounting_that_is_none_is_refused_with_its_line(axes: str) -> None:
    with pytest.raises(BenchError, match="mounting"):
        mounted(axes)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_the_shipped_script_turns_the_axis_that_the_table_has(axis: str) -> None:
    script = load_script(Path("full-imu-one-axis"), axis=axis)
    assert {demand.axis for step in script.steps for demand in step.demands()} == {axis}
    rates = {np.sign(d.rate_rps) for step in script.steps for d in step.demands()}
    assert rates == {-1.0, 1.0}
    assert script.timeline()[-1].start_s < 330
    last = {turn.to_rad for timed in script.timeline() for _, turn in timed.turns()}
    assert len(last) > 12


def test_a_file_with_a_mounting_that_is_none_is_refused(tmp_path: Path) -> None:
    recording = simulate_bench(mounted('["x", "y", "z"]'), Script("rest", (Rest(4.0, "rest"),)), 1)
    data = recording.sources["mti"]
    bad = replace(data, mounting=replace(data.mounting, axes=np.ones((3, 3))))
    write_recording(tmp_path / "bad.h5", replace(recording, sources={"mti": bad}))
    with pytest.raises(Exception, match="mounting must have three axes"):
        read_recording(tmp_path / "bad.h5")


@pytest.fixture(scope="module")
def three(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Return recordings of the shipped script with x, y and z of a device along the axis, which lies."""
    folder = tmp_path_factory.mktemp("three")
    paths = []
    for number, axes in enumerate(('["x", "y", "z"]', '["z", "x", "y"]', '["y", "z", "x"]')):
        bench = mounted(axes, f'{{ x = "{number} mrad", y = "1 mrad" }}')
        paths.append(str(folder / f"{'xyz'[number]}.h5"))
        write_recording(Path(paths[-1]), simulate_bench(bench, load_script(Path("full-imu-one-axis")), number))
        with h5py.File(paths[-1], "r+") as file:  # as a run keeps them, so that nobody filters for them again
            file.create_dataset("innovation/mti/nis", data=np.full(100, 3.0))
            file.create_dataset("innovation/mti/dof", data=np.full(100, 3))
    return paths


def test_calibrate_joins_three_mountings(three: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """The truth stands in the bench file."""
    assert main(["calibrate", "--join", "--json", *three]) == 0
    found = json.loads(capsys.readouterr().out)
    for gyro, k, b_dph in zip(found["gyros"], (300e-6, -200e-6, 150e-6), (20, -35, 10), strict=True):
        assert gyro["k"] == pytest.approx(k, abs=4.5 * gyro["sd"]["k"])
        assert gyro["b_rps"] == pytest.approx(np.radians(b_dph / 3600), abs=4.5 * gyro["sd"]["b_rps"])
        assert max(gyro["sd"]["sigma_j_rad"], gyro["sd"]["sigma_k_rad"]) < 30e-6
    (forces,) = found["accelerometers"]
    for one, k, b_mg in zip(forces["accelerometers"], (800e-6, -500e-6, 300e-6), (5, -8, 3), strict=True):
        assert one["k"] == pytest.approx(k, abs=4.5 * one["sd"]["k"])
        assert one["b_mps2"] == pytest.approx(9.80665e-3 * b_mg, abs=4.5 * one["sd"]["b_mps2"])
        assert one["place_m"] is None  # it is another one in each mounting
    turned = [one["mounting_error_rad"] for one in found["joined"]]
    # About axes across that of the table. Those of the gyros are turned by the same, so that differences count.
    assert turned[2][0] - turned[1][0] == pytest.approx(1e-3, abs=60e-6)


def test_a_joined_calibration_is_printed_once(three: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "--join", *three[:2], "--details"]) == 0
    text = capsys.readouterr().out
    assert text.count("States and their standard deviations") == 1
    assert "Places from where" not in text
    for words in ("Accelerometers of mti", "Mounting errors", "mounting of the device", "local gravity", "y.h5"):
        assert words in text


def test_recordings_of_two_serial_numbers_are_not_joined(
    three: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = []
    for name, serial in zip(three[:2], ("A1", "B2"), strict=True):
        paths.append(tmp_path / Path(name).name)
        paths[-1].write_bytes(Path(name).read_bytes())
        with h5py.File(paths[-1], "r+") as file:
            file.attrs["device_serial"] = serial
    assert main(["calibrate", "--join", *map(str, paths)]) == 2
    assert "x.h5 is of the device A1, y.h5 of B2" in capsys.readouterr().err
    with h5py.File(paths[1], "r+") as file:
        file.attrs.update({"device_serial": "A1", "outcome": "ABORTED", "reason": "by the operator"})
    assert main(["calibrate", "--join", *map(str, paths)]) == 2
    assert "y.h5 ended as ABORTED" in capsys.readouterr().err


def test_a_run_is_joined_once(three: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    copy = tmp_path / "copy.h5"
    copy.write_bytes(Path(three[0]).read_bytes())
    assert main(["calibrate", "--join", *three, str(copy)]) == 2
    assert "x.h5 and copy.h5 hold the same run" in capsys.readouterr().err
    assert main(["report", three[0], "--join", three[0], "-o", str(tmp_path / "x.html")]) == 2
    assert "hold the same run" in capsys.readouterr().err


def test_a_joined_calibration_does_not_take_what_it_lacks(three: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", "--join", "--write", *three]) == 2
    assert "has no --write" in capsys.readouterr().err
    assert main(["calibrate", "--join", three[0]]) == 2
    assert "nothing to be joined with" in capsys.readouterr().err


def test_a_plan_says_what_one_mounting_shows_and_what_three_do(capsys: pytest.CaptureFixture[str]) -> None:
    main(["plan", "full-imu-one-axis", "--bench", str(BENCH)])
    text = capsys.readouterr().out
    assert "unobservable: y: k; sigma_k" in text
    together = text[text.index("Three runs with x, y and z of mti") :]
    sigmas = [float(cell) for line in together.splitlines() if "│ y" in line for cell in line.split("│")[2:6]]
    assert sigmas[0] < 20
    assert max(sigmas[2:]) < 30


@pytest.mark.full
def test_a_plan_as_json_has_three_mountings_of_a_table_of_one_axis(capsys: pytest.CaptureFixture[str]) -> None:
    main(["plan", "full-imu-one-axis", "--bench", str(BENCH), "--json"])
    (planned,) = json.loads(capsys.readouterr().out)["mountings"]
    for sensor in (*planned["gyros"], *planned["accelerometers"]):
        assert max(sensor["sd"]["sigma_j_rad"], sensor["sd"]["sigma_k_rad"]) < 30e-6
    main(["plan", "full-imu", "--bench", str(BENCH.parent / "full_imu.toml"), "--json"])
    assert json.loads(capsys.readouterr().out)["mountings"] == []


def test_exports_are_in_the_axes_of_the_device(three: list[str], tmp_path: Path) -> None:
    """In this recording y of the device lies along x of the table."""
    path = tmp_path / "y.h5"
    path.write_bytes(Path(three[1]).read_bytes())
    assert main(["calibrate", "--write", str(path)]) == 0
    exported = exported_of(path)
    np.testing.assert_allclose(exported.compensation.array.p, np.eye(3), atol=1e-12)
    (forces,) = exported.forces
    np.testing.assert_allclose([one.p for one in forces.accelerometers], np.eye(3), atol=1e-12)
    # What a run does not show is as wide as the data sheet: 5 %. In another frame it would be zeros and ones.
    assert np.abs(exported.compensation.sensitivity - np.eye(3)).max() < 0.15


def test_every_format_holds_the_joined_calibration_or_says_why_not(
    three: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", three[0], "--join", three[1], "--all", str(tmp_path / "all"), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["files"]) >= {"c", "python", "json", "yaml", "matlab", "csv", "kalibr"}
    for file in result["files"].values():
        words = Path(file).read_bytes().decode("latin-1").replace(",", " ").split()
        assert not {"nan", "NaN", "NAN", "(nan)", "[nan"} & set(words), file
    exported = json.loads(Path(result["files"]["json"]).read_text())
    assert "y.h5" in exported["identity"]["joined_with"]
    made: dict[str, object] = {}
    exec(Path(result["files"]["python"]).read_text(), made)
    up = made["correct_force"](np.array([0.0, 0.0, 9.80665]))  # type: ignore[operator]
    # z has 300 ppm and 3 mg: (9.80665 + 3 mg) / (1 - 300 ppm)
    assert up[2] == pytest.approx((9.80665 + 3 * 9.80665e-3) / (1 - 300e-6), abs=1e-3)


@pytest.fixture
def judged(three: list[str], tmp_path: Path) -> list[str]:
    """Return the recordings with limits that no single one of them meets."""
    bench = BENCH.read_text(encoding="utf-8") + LIMITS
    paths = [tmp_path / Path(name).name for name in three]
    for name, path in zip(three, paths, strict=True):
        path.write_bytes(Path(name).read_bytes())
        with h5py.File(path, "r+") as file:
            file.attrs.update(bench=bench, outcome="FAIL", reason="y sigma of k 20000 ppm > 100 ppm")
    return list(map(str, paths))


def test_a_report_holds_the_joined_calibration_and_its_recordings(
    judged: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each figure of the states is that of `calibrate --join`; the runs stand there with their mountings and hashes."""
    assert main(["calibrate", "--join", "--json", *judged]) == 0
    found = json.loads(capsys.readouterr().out)
    html = tmp_path / "joined.html"
    joined = [word for name in judged[1:] for word in ("--join", name)]
    assert main(["report", judged[0], *joined, "-o", str(html), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["joined"] == judged[1:]
    assert told["outcome"] == found["outcome"] == "PASS"
    assert told["certificate"] is False
    text = html.read_text(encoding="utf-8")
    for gyro in found["gyros"]:
        assert f'value="{gyro["b_rps"]!r}"' in text
        assert f'value="{gyro["sd"]["b_rps"]!r}"' in text
    for words in (
        "it joins several runs",
        "Accelerometers",
        ">200<",
        "x, y, z",
        "z, x, y",
        "y, z, x",
        *(Path(name).name for name in judged),
    ):
        assert words in text
    for name in judged:
        assert file_sha256(Path(name)) in text
        assert raw_sha256(Path(name)) in text
    assert ">nan<" not in text
    assert "Lever arm, from the point" not in text
    assert "calibration/states[" not in text  # these figures are in none of the recordings


def test_what_a_joined_report_cannot_state_is_refused(three: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", three[0], "--join", three[1], "--dcc"]) == 2
    assert "Leave out --dcc" in capsys.readouterr().err
    assert main(["report", three[0], "--join", three[1], "--investigation", "i.json"]) == 2
    assert "an investigation is of one recording" in capsys.readouterr().err
