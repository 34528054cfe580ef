"""Logs of others whose channels clip, are dead or hide zero, whose reference jumps: named, and right on the rest."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_motion import (
    ATTITUDE,
    BIAS_DPS,
    NAMES,
    RATE,
    TOP,
    Gyros,
    K,
    calibrated,
    imported,
    instants,
    outputs,
    quaternions,
    rate,
    write,
)
from hand_turned import by_known_angles

from estimator.recordings.recording import Recording
from estimator.recordings.writing import write_recording

T_S = instants()
W = rate(T_S)
HEADING = {RATE: "rx,ry,rz", ATTITUDE: "qw,qx,qy,qz"}
KNOWN = {RATE: W, ATTITUDE: quaternions(T_S)}


def log_of(folder: Path, output: np.ndarray, reference: str, known: np.ndarray | None = None) -> None:
    """Write outputs beside a reference."""
    known = KNOWN[reference] if known is None else known
    write(folder / "log.csv", f"t,{','.join(NAMES)},{HEADING[reference]}", T_S, output, known)


def right(gyros: Gyros, k: dict[str, float], widest: float = 0.004) -> None:
    """Assert that scale factor errors are right within their sigmas, and that these tell something."""
    for name, true in k.items():
        sd = gyros[name]["sd"]["k"]
        assert sd < widest
        assert abs(gyros[name]["k"] - true) < 4 * sd, name


def all_but(*names: str) -> dict[str, float]:
    """Return true scale factor errors of the other gyros."""
    return {name: float(k) for name, k in zip("xyz", K, strict=True) if name not in names}


def clipped(output: np.ndarray, limit_dps: float, seed: int = 3) -> np.ndarray:
    """Return outputs whose y ends at a limit before the device corrects its axes: the values vary there."""
    random = np.random.default_rng(seed)
    found, at = output.copy(), np.abs(output[:, 1]) > limit_dps
    corrected = 0.005 * output[at, 0] - 0.004 * output[at, 2] + 0.3 * random.standard_normal(at.sum())
    found[at, 1] = limit_dps * np.sign(output[at, 1]) + corrected
    return found


@pytest.mark.parametrize("reference", [RATE, ATTITUDE])
def test_a_gyro_whose_clips_vary_is_named_and_right_on_the_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], reference: str
) -> None:
    log_of(tmp_path, clipped(outputs(W), 50.0), reference)
    run, _ = imported(capsys, tmp_path, TOP + reference)
    gyros, told = calibrated(capsys, run)
    right(gyros, all_but())
    assert re.search(r"^y saturates at -(49|50)\.\d+ deg/s and (49|50)\.\d", told, re.M)


@pytest.mark.parametrize("reference", [RATE, ATTITUDE])
@pytest.mark.parametrize("noise_dps", [0.0, 0.2])
def test_a_dead_gyro_is_named_and_costs_the_others_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], reference: str, noise_dps: float
) -> None:
    output = outputs(W)
    output[:, 2] = -30.0 + noise_dps * np.random.default_rng(5).standard_normal(len(T_S))
    log_of(tmp_path, output, reference)
    run, _ = imported(capsys, tmp_path, TOP + reference)
    gyros, told = calibrated(capsys, run)
    assert set(gyros) == {"x", "y"}
    right(gyros, all_but("z"))
    assert re.search(r"\bz:? .*(constant|dead|follow)", told)


def test_outputs_that_are_exactly_zero_at_slow_rates_are_a_dead_zone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = outputs(W) + BIAS_DPS
    log_of(tmp_path, np.where(np.abs(output) < 4.0, 0.0, output), RATE)
    run, _ = imported(capsys, tmp_path, TOP + RATE)
    gyros, told = calibrated(capsys, run)
    right(gyros, all_but())
    assert re.search(r"x: the output is exactly 0 in .* below (3\.\d+|4) deg/s. This is a dead zone", told)
    assert "stuck" not in told


def test_a_reference_that_jumps_is_told_and_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    known = KNOWN[ATTITUDE].copy()
    for at in (900, 2500, 5100):
        known[at : at + 12] = np.roll(known[at : at + 12], 1, axis=1)  # markers are taken for each other
    log_of(tmp_path, outputs(W), ATTITUDE, known)
    run, _ = imported(capsys, tmp_path, TOP + ATTITUDE)
    gyros, told = calibrated(capsys, run)
    right(gyros, all_but(), 0.001)
    assert re.search(r"reference .*(jumps|wrong)", told)


def test_an_encoder_that_loses_counts_is_told_and_put_right(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    speed = np.interp(T_S % 20, [0, 3, 4, 9, 10, 13, 14, 19, 20], [0, 0, 60, 60, 0, 0, -60, -60, 0])
    angle = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 / 100)])
    for at in (1500, 3300, 6600):
        angle[at:] += 6.0
    output = outputs(speed[:, None] * np.array([0.0, 0.0, 1.0]))
    write(tmp_path / "log.csv", "t,gx,gy,gz,angle", T_S, output, np.round(angle / 0.02) * 0.02)
    mapping = TOP + '[reference]\nkind = "angle"\ncolumn = "angle"\nunit = "deg"\naxis = "z"\n'
    run, _ = imported(capsys, tmp_path, mapping)
    gyros, told = calibrated(capsys, run)
    right(gyros, all_but("x", "y"), 0.001)
    assert re.search(r"(jumps|steps|counts)", told)


def turned(folder: Path, spoil: object) -> tuple[Path, dict[str, float]]:
    """Write turns by hand whose outputs are spoilt; return where, and the true scale factor errors."""
    recording, unit = by_known_angles(4, seconds=(1.5, 6.0))
    data = recording.sources["imu"]
    assert callable(spoil)
    rate_rps = np.radians(spoil(np.degrees(data.rate_rps)))
    changed = Recording({"imu": type(data)(data.array, data.t_ns, rate_rps)}, recording.reference)
    write_recording(folder / "run.h5", changed)
    return folder / "run.h5", dict(zip("xyz", unit.states()[:, 0].tolist(), strict=True))


def test_a_limit_is_found_beside_turns_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, k = turned(tmp_path, lambda output: clipped(output, 250.0))
    gyros, told = calibrated(capsys, run)
    right(gyros, k)
    assert re.search(r"^y saturates at -2(4|5)\d(\.\d)? deg/s and 2(4|5)\d", told, re.M)


def test_a_dead_gyro_is_found_beside_turns_by_hand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run, k = turned(tmp_path, lambda output: output * [1, 1, 0] + [0, 0, 0.4])
    gyros, told = calibrated(capsys, run)
    assert set(gyros) == {"x", "y"}
    right(gyros, {name: k[name] for name in "xy"})
    assert re.search(r"\bz:? .*constant", told)
