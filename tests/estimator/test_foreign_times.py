"""Logs of others whose reference is late, slow or stamped unevenly: the delay, the units and the states are right."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from foreign_logs import CSV
from foreign_motion import (
    ATTITUDE,
    BESIDE,
    RATE,
    TIME,
    TOP,
    Gyros,
    K,
    calibrated,
    imported,
    instants,
    investigated,
    outputs,
    quaternions,
    rate,
    write,
)

HEADING = "t,gx,gy,gz,rx,ry,rz"
T_S = instants()


def right(gyros: Gyros, widest: float) -> None:
    """Assert that scale factor errors are right within their sigmas, and that these tell something."""
    for name, true in zip("xyz", K.tolist(), strict=True):
        sd = gyros[name]["sd"]["k"]
        assert sd < widest
        assert abs(gyros[name]["k"] - true) < 4 * sd, name


def delay_ms(told: str) -> float:
    """Return by how much the reference is late, as it is told."""
    found = re.search(r"reference .*?(-?\d+\.?\d*) (\+- \S+ )?ms", told)
    assert found, told
    return float(found[1])


@pytest.mark.parametrize("late_s", [0.02, 0.09, 0.15])
def test_a_late_reference_leaves_the_states_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], late_s: float
) -> None:
    write(tmp_path / "log.csv", HEADING, T_S, outputs(rate(T_S)), rate(T_S - late_s))
    run, _ = imported(capsys, tmp_path, TOP + RATE)
    gyros, told = calibrated(capsys, run)
    right(gyros, 0.0005)
    assert delay_ms(told) == pytest.approx(1e3 * late_s, abs=0.5)


def test_the_investigation_tells_the_delay_that_the_calibration_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    t_s = instants(40.0)
    write(tmp_path / "log.csv", HEADING, t_s, outputs(rate(t_s)), rate(t_s - 0.09))
    run, _ = imported(capsys, tmp_path, TOP + RATE)
    _, found = investigated(capsys, run)
    delays = [effect for effect in found["added"] if effect["effect"] in ("latency", "reference_lag")]
    assert delays
    value, sd, _ = delays[0]["parameters"]["delay"]
    assert value == pytest.approx(0.09, rel=0.02)
    assert sd < 0.001


def test_counts_of_unknown_size_are_found_beside_a_reference_that_is_late_and_smooth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from scipy.signal import lfilter

    smooth = lfilter([0.06], [1, -0.94], rate(T_S - 0.045), axis=0)
    write(tmp_path / "log.csv", HEADING, T_S, np.round(outputs(rate(T_S)) / 0.0612), smooth)
    mapping = CSV + TIME + '[gyro]\ncolumns = ["gx", "gy", "gz"]\nunit = "raw"\nscale = "from data"\n' + RATE
    _, said = imported(capsys, tmp_path, mapping)
    found = re.search(r"one count is (\d\.\d+)", said)
    assert found, said
    assert float(found[1]) == pytest.approx(0.0612, rel=0.01)


def test_a_gyro_in_deg_per_s_is_not_called_half_as_sensitive_beside_a_late_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Swings about once a second, of which 0.2 s are a good part.
    w = rate(1.7 * T_S) * 1.7
    write(tmp_path / "log.csv", HEADING, T_S, outputs(w), rate(1.7 * (T_S - 0.2)) * 1.7)
    _, said = imported(capsys, tmp_path, TOP + RATE)
    assert "times the reference" not in said


def test_a_robot_that_tells_its_pose_fifteen_times_a_second_is_a_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "log.csv", "t,gx,gy,gz", T_S, outputs(rate(T_S)))
    at_s = np.arange(0.1, 79, 1 / 15)
    write(tmp_path / "log_reference.csv", "t,qw,qx,qy,qz", at_s + 0.06, quaternions(at_s))
    run, _ = imported(capsys, tmp_path, TOP + ATTITUDE + BESIDE)
    gyros, told = calibrated(capsys, run)
    right(gyros, 0.003)
    assert delay_ms(told) == pytest.approx(60.0, abs=3.0)


@pytest.mark.parametrize("sampled", ["evenly", "when stamped"])
def test_stamps_that_jitter_are_kept_only_if_the_readings_are_of_these_instants(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], sampled: str
) -> None:
    random = np.random.default_rng(8)
    at_s = instants(hz=50.0)
    # A computer looks when it has time: most readings are stamped some ms late, a few by a tenth of a second.
    late_s = random.exponential(0.006, len(at_s)) + np.where(random.random(len(at_s)) < 0.02, 0.1, 0.0)
    stamps_s = np.sort(at_s + late_s)
    write(tmp_path / "log.csv", "t,gx,gy,gz", T_S, outputs(rate(T_S)))
    known = rate(at_s if sampled == "evenly" else stamps_s)
    write(tmp_path / "log_reference.csv", "t,rx,ry,rz", stamps_s, known)
    run, said = imported(capsys, tmp_path, TOP + RATE + BESIDE)
    gyros, _ = calibrated(capsys, run)
    right(gyros, 0.0003)
    assert ("log_reference.csv: uniform rate of" in said) == (sampled == "evenly")
