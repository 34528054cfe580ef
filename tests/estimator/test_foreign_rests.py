"""Rests of others: without temperature, one pose a file, beside a fan; what is told of them, and what moves a state."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_motion import (
    ACCEL,
    BIAS_DPS,
    G_MPS2,
    RATE,
    TOP,
    calibrated,
    imported,
    instants,
    investigated,
    outputs,
    ran,
    rate,
    write,
)

from station.errors import EXIT_USAGE

REST = '[reference]\nkind = "rest"\n'
EVERYWHERE = REST + 'where = "everywhere"\n'
HEADING = "t,gx,gy,gz,ax,ay,az"
SIDES = np.vstack([np.eye(3), -np.eye(3)])
POSES = np.vstack([SIDES, [[0.6, 0.8, 0.0], [0.0, -0.6, 0.8]]])
HZ = 20.0
NOISE_DPS = 0.02


def rest(path: Path, bias_dps: np.ndarray, up: np.ndarray, seed: int, seconds: float = 40.0) -> None:
    """Write a rest with one side up."""
    random = np.random.default_rng(seed)
    t_s = instants(seconds, HZ)
    output = -bias_dps + NOISE_DPS * random.standard_normal((len(t_s), 3))
    felt = G_MPS2 * up + 0.02 * random.standard_normal((len(t_s), 3))
    write(path, HEADING, t_s, output, felt)


@pytest.fixture
def long_rest(tmp_path: Path) -> Path:
    rest(tmp_path / "log.csv", BIAS_DPS, np.array([0.1, -0.05, 0.99]), 3, 300.0)
    return tmp_path


def test_a_temperature_that_nobody_recorded_moves_no_bias_and_is_a_line(
    long_rest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, _ = imported(capsys, long_rest, TOP + ACCEL + REST)
    gyros, _ = calibrated(capsys, run)
    for name, bias_dps in zip("xyz", BIAS_DPS.tolist(), strict=True):
        error_dps = np.degrees(gyros[name]["b_rps"]) - bias_dps
        sd_dps = np.degrees(gyros[name]["sd"]["b_rps"])
        assert sd_dps < 0.02
        assert abs(error_dps) < min(4 * sd_dps, 0.002)


def test_what_is_ruled_out_in_a_mapping_or_a_file_widens_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t_s = instants(40.0)
    write(tmp_path / "log.csv", "t,gx,gy,gz,rx,ry,rz", t_s, outputs(rate(t_s)), rate(t_s))
    run, _ = imported(capsys, tmp_path, TOP + RATE)
    wide, _ = calibrated(capsys, run)
    (tmp_path / "none.toml").write_text('effects = "none"\n')
    by_file, _ = calibrated(capsys, run, "--undeclared", tmp_path / "none.toml")
    run.unlink()
    run, _ = imported(capsys, tmp_path, TOP + RATE + '[undeclared]\neffects = "none"\n')
    by_mapping, _ = calibrated(capsys, run)
    for name in "xyz":
        assert by_file[name]["sd"]["k"] < 0.7 * wide[name]["sd"]["k"]
        assert wide[name]["sd_declared"]["k"] < 0.7 * wide[name]["sd"]["k"]
        assert by_mapping[name]["sd"] == pytest.approx(by_file[name]["sd"])


def test_a_better_type_depends_less_on_what_was_not_recorded(
    long_rest: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sds = []
    for bias_dps in (20.0, 0.5):
        run, _ = imported(capsys, long_rest, TOP + ACCEL + REST + f"[datasheet]\nbias_dps = {bias_dps}\n")
        gyros, _ = calibrated(capsys, run)
        sds.append(gyros["x"]["sd"]["b_rps"])
        run.unlink()
    assert sds[1] < sds[0]


def test_an_effect_that_there_is_not_cannot_be_ruled_out(long_rest: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (long_rest / "mapping.toml").write_text(TOP + ACCEL + REST + '[undeclared]\nexcluded = ["bias_drifts"]\n')
    code, said = ran(capsys, "import", long_rest / "mapping.toml", long_rest / "log.csv", "-o", long_rest / "run.h5")
    assert code == EXIT_USAGE
    assert "bias_drift" in said


def test_biases_that_differ_from_file_to_file_are_told_and_are_no_sensitivity_to_gravity(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    random = np.random.default_rng(5)
    names = [f"pose{number}.csv" for number in range(len(POSES))]
    for number, (name, up) in enumerate(zip(names, POSES, strict=True)):
        rest(tmp_path / name, BIAS_DPS + 0.05 * random.standard_normal(3), up, number)
    run, _ = imported(capsys, tmp_path, TOP + ACCEL + REST, *names)
    gyros, told = calibrated(capsys, run)
    found = re.search(r"biases differ from file to file by (\S+) deg/h", told)
    assert found, told
    assert 90 < float(found[1]) < 360
    for name, bias_dps in zip("xyz", BIAS_DPS.tolist(), strict=True):
        sd_dps = np.degrees(gyros[name]["sd"]["b_rps"])
        assert 0.012 < sd_dps < 0.04
        assert abs(np.degrees(gyros[name]["b_rps"]) - bias_dps) < 4 * sd_dps
    _, traced = investigated(capsys, run)
    assert not [added for added in traced["added"] if added["effect"] != "tone"]
    assert any("differ from file to file" in note for note in traced["notes"])


def test_a_line_and_its_image_by_the_sampling_are_one_cause(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    random = np.random.default_rng(2)
    measured_s = np.arange(3000) / 50.0
    wave = 0.4 * np.sin(2 * np.pi * 8.3 * measured_s)[:, None] * [1.0, -0.6, 0.3]
    output = -BIAS_DPS + wave + NOISE_DPS * random.standard_normal((len(measured_s), 3))
    t_s = np.arange(2 * len(measured_s) - 1) / 100.0
    logged = np.column_stack([np.interp(t_s, measured_s, column) for column in output.T])
    write(tmp_path / "log.csv", "t,gx,gy,gz", t_s, logged)
    run, _ = imported(capsys, tmp_path, TOP + EVERYWHERE)
    _, traced = investigated(capsys, run)
    assert [added["effect"] for added in traced["added"]] == ["tone"]
    frequencies = [
        value for label, (value, _, unit) in traced["added"][0]["parameters"].items() if unit == "Hz" and value > 20
    ]
    assert frequencies == pytest.approx([50 - 8.3], abs=0.05)


def test_gravity_between_rests_is_said_not_to_be_traced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t_s = instants(120.0, HZ)
    place = np.minimum((t_s // 10).astype(int), 11)
    ups = np.vstack([POSES, -POSES[6:], POSES[:2] @ np.array([[0.8, 0.6, 0], [0, 0.8, 0.6], [0.6, 0, 0.8]])])
    ups /= np.linalg.norm(ups, axis=1)[:, None]
    turning = (t_s % 10 > 8.0)[:, None]
    random = np.random.default_rng(1)
    output = -BIAS_DPS + np.where(turning, 60 * np.sin(np.pi * (t_s % 10 - 8))[:, None], 0.0)
    output = output + NOISE_DPS * random.standard_normal((len(t_s), 3))
    felt = G_MPS2 * ups[place] + 0.01 * random.standard_normal((len(t_s), 3)) + np.where(turning, 3.0, 0.0)
    write(tmp_path / "log.csv", HEADING, t_s, output, felt)
    run, _ = imported(capsys, tmp_path, TOP + ACCEL + '[reference]\nkind = "gravity"\n')
    code, said = ran(capsys, "investigate", run)
    assert code == EXIT_USAGE
    assert "no effect can be traced" in said
