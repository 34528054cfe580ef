"""A whole IMU by the commands that a user types: calibrate, report, plan, and a run over the wires of its twin."""

from __future__ import annotations

import json
import re
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimator.calibration.calibration_file import read_calibration
from estimator.calibration.error_model import ErrorModel, KnownForceEffect, Size
from estimator.recordings.reading import read_recording
from estimator.recordings.writing import write_recording
from station.bench.bench import load_bench, read_bench
from station.cli import main
from station.opening.simulate import simulate_bench
from station.screen.panes.start import limits_text
from station.scripts.script import load_script

BENCH = Path(__file__).parents[1] / "data" / "benches" / "full_imu.toml"
TRUE_K = (800e-6, -500e-6, 300e-6)
TRUE_B_MPS2 = tuple(9.80665e-3 * b for b in (5.0, -8.0, 3.0))
TRUE_PLACES_MM = ((42.0, -25.0, 15.0), (40.0, -26.0, 15.0), (40.0, -25.0, 16.0))
TILTS = """
name = "tilts"
[[step]]
kind = "rest"
duration = "3 s"
[[step]]
kind = "pose"
x = "90 deg"
rate = "60 deg/s"
acceleration = "45 deg/s2"
settle = "1 s"
duration = "3 s"
"""


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a recording of the shipped script with its calibration, and what was printed of it with details."""
    path = tmp_path_factory.mktemp("imu") / "imu.h5"
    bench = read_bench(BENCH.read_text(encoding="utf-8").replace('rate = "100 Hz"', 'rate = "50 Hz"'), "bench")
    write_recording(path, simulate_bench(bench, load_script(Path("full-imu")), 1))
    with redirect_stdout(StringIO()) as printed:
        assert main(["calibrate", "--write", "--details", str(path)]) == 0
    return path, printed.getvalue()


@pytest.fixture(scope="module")
def recorded(calibrated: tuple[Path, str]) -> Path:
    """Return the recording, which is to be read only."""
    return calibrated[0]


def test_calibrate_prints_states_and_places(calibrated: tuple[Path, str]) -> None:
    recorded, text = calibrated
    assert "Accelerometers of mti" in text
    (found,) = read_calibration(recorded).forces
    for one in found.accelerometers:
        row = next(line for line in text.splitlines() if one.name in line)
        assert float(re.findall(r"-?[\d.]+", row.replace(one.name, ""))[0]) == pytest.approx(1e6 * one.states[0], abs=1)
    for words in ("Places from where", "delay:", "gravity: 9.80620", "Intrinsic parameters", "local gravity"):
        assert words in text
    assert "the axes of the table stand between the counts of their encoders" in " ".join(text.split())


def test_json_has_the_values_in_si(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["calibrate", str(recorded), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["accelerometers"]
    for one, k, b, place in zip(found["accelerometers"], TRUE_K, TRUE_B_MPS2, TRUE_PLACES_MM, strict=True):
        assert one["k"] == pytest.approx(k, abs=5 * one["sd"]["k"])
        assert one["b_mps2"] == pytest.approx(b, abs=5 * one["sd"]["b_mps2"])
        assert 1e3 * np.array(one["place_m"]) == pytest.approx(place, abs=1.0)
    assert found["delay"]["value_s"] == pytest.approx(1.5e-3, abs=5 * found["delay"]["sd_s"])
    assert found["intrinsic"]["pairs"][0] == ["accel x", "accel y"]


def test_limits_of_accelerometers_fail_a_run_and_say_by_how_much(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth of accel x is 800 ppm."""
    limits = '[limits.accelerometers]\nscale_factor_error = "600 ppm"\nbias = "10 mg"\n\n[undeclared]'
    (tmp_path / "bench.toml").write_text(BENCH.read_text(encoding="utf-8").replace("[undeclared]", limits))
    assert main(["calibrate", str(recorded), "--bench", str(tmp_path / "bench.toml")]) == 1
    text = capsys.readouterr().out
    assert "1 limit of the bench exceeded" in text
    assert "accel x k" in text
    assert "600 ppm" in text


def limited(folder: Path, lines: str) -> Path:
    """Write the bench with these limits of accelerometers and no others."""
    before, _, after = BENCH.read_text(encoding="utf-8").partition("[limits]")
    _, _, after = after.partition("[undeclared]")
    (folder / "bench.toml").write_text(f"{before}[limits.accelerometers]\n{lines}\n[undeclared]{after}")
    return folder / "bench.toml"


def test_the_lever_arm_has_a_limit_of_its_sigma(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (forces,) = read_calibration(recorded).forces
    widest_mm = 1e3 * float(forces.arm_sd_m.max())
    for times, code, outcome in ((1.1, 0, "PASS"), (0.9, 1, "FAIL")):
        bench = limited(tmp_path, f'sd_lever_arm = "{times * widest_mm:.6f} mm"')
        assert main(["calibrate", str(recorded), "--bench", str(bench), "--json"]) == code
        judged = json.loads(capsys.readouterr().out)
        assert judged["outcome"] == outcome
        assert ("sigma of lever arm" in judged["reason"]) == (outcome == "FAIL")
    bench = limited(tmp_path, f'sd_lever_arm = "{0.5 * widest_mm:.6f} mm"')
    assert main(["plan", "full-imu", "--bench", str(bench)]) == 1  # the run would end FAIL
    text = capsys.readouterr().out
    assert "NOT REACHED  sigmas that the bench requires, for lever arm" in text
    (required,) = [line for line in text.splitlines() if re.search(r"required +│? *-", line)]
    shown = [float(number) for number in re.findall(r"[0-9.]+", required)]
    assert shown == pytest.approx([0.5 * widest_mm] * 3, rel=0.05)


def test_the_page_prepare_lists_the_limits_of_accelerometers(tmp_path: Path) -> None:
    lines = 'bias = "20 mg"\nsd_bias = "0.1 mg"\nsd_misalignment = "50 urad"\nsd_lever_arm = "2 mm"'
    text = limits_text(load_bench(limited(tmp_path, lines)).limits).plain
    assert "accelerometers: |b| up to 20 mg, its sigma up to 0.1 mg" in text
    assert "accelerometers: sigma_j, sigma_k: sigma up to 50 urad" in text
    assert "accelerometers: lever arm: sigma up to 2 mm" in text


def test_the_report_has_a_chapter_of_them(recorded: Path, tmp_path: Path) -> None:
    assert main(["report", str(recorded), "-o", str(tmp_path / "report.html")]) == 0
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    chapter = text[text.index("Accelerometers</h2>") :]
    for words in ("Lever arm", "sensitivity of accel x", "angle of accel y to accel z", "local gravity"):
        assert words in chapter
    assert "&lt;" not in chapter[: chapter.index("</section>")]


@pytest.mark.full
def test_a_plan_foretells_the_sigmas_of_a_run(recorded: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["plan", "full-imu", "--bench", str(BENCH), "--json"])
    (planned,) = json.loads(capsys.readouterr().out)["accelerometers"]
    (found,) = read_calibration(recorded).forces
    for one, own in zip(planned["accelerometers"], found.accelerometers, strict=True):
        assert list(one["sd"].values()) == pytest.approx(own.sd.tolist(), rel=0.5)
        assert one["place_sd_m"] == pytest.approx(own.place_sd_m.tolist(), rel=0.5)
    assert 1e-5 < planned["detected"]["asymmetry"][0] < 1e-3


@pytest.mark.parametrize("name", ["full_imu", "one_axis_imu"])
def test_a_plan_of_a_script_too_short_for_accelerometers_shows_the_gyros(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (tmp_path / "brief.toml").write_text('name = "brief"\n[[step]]\nkind = "rest"\nduration = "4 s"\n')
    main(["plan", str(tmp_path / "brief.toml"), "--bench", str(BENCH.with_name(f"{name}.toml"))])
    said = capsys.readouterr()
    assert "Predicted" in said.out
    assert "accelerometers of mti" not in said.out
    assert "too little data" not in said.err


def test_a_model_of_accelerometers_that_is_not_known_is_refused_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = Size("coefficient", "1", 0.0, 1e-3)
    model = ErrorModel((), forces=(KnownForceEffect(name="unheard", sizes=(size,)),))
    (tmp_path / "model.json").write_text(model.text())
    path = tmp_path / "run.h5"
    assert main(["run", "--bench", str(BENCH), "--model", str(tmp_path / "model.json"), "-o", str(path)]) == 2
    assert "unheard of accelerometers" in capsys.readouterr().err
    assert not path.exists()


def test_a_twin_puts_its_errors_on_the_wire(tmp_path: Path) -> None:
    (tmp_path / "tilts.toml").write_text(TILTS)
    path = tmp_path / "tilts.h5"
    main(["run", "--bench", str(BENCH), "--script", str(tmp_path / "tilts.toml"), "-o", str(path)])
    data = read_recording(path).sources["mti"]
    assert data.accel_mps2 is not None
    assert data.accel_sheet is not None
    lying = data.accel_mps2[-200:].mean(axis=0)  # y points up
    assert lying[1] == pytest.approx((1 - TRUE_K[1]) * 9.8062 - TRUE_B_MPS2[1], abs=2e-3)
    assert data.accel_mps2[-200:].std(axis=0) == pytest.approx([60e-6 * 9.80665 * 10] * 3, rel=0.3)
    with h5py.File(path) as file:
        assert file["calibration"].attrs["live_batch_difference_sigma"] < 1e-6
        live = {name: values[-1] for name, values in file["force_estimate/mti"].items()}
        nis = file["force_innovation/mti/nis"][()].sum() / file["force_innovation/mti/dof"][()].sum()
    # Both tilts have one state in common with the truth: the bias of x, which is level in both.
    assert live["states"][0, 1] == pytest.approx(TRUE_B_MPS2[0], abs=4.5 * live["sd"][0, 1])
    assert live["sd"][0, 1] < 0.1 * 20e-3 * 9.80665
    assert live["delay_s"] == pytest.approx(1.5e-3, abs=4.5 * live["delay_sd_s"])
    assert nis == pytest.approx(1.0, abs=0.3)


def test_an_unknown_script_names_those_that_come_with_the_station(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plan", str(tmp_path / "none")]) == 2
    assert "full-imu" in capsys.readouterr().err
