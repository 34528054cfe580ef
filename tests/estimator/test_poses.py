"""Accelerometers laid in many poses by hand: nine parameters from gravity alone, and what is said of bad sessions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from handheld import SIX, G, Log, Session, Truth, bumped, device, general_poses, make, saturated

from estimator.errors import RecordingError
from estimator.geometry.kinematics import Gravity
from estimator.poses.calibration import PoseCalibration
from estimator.poses.session import PoseSamples, calibrate_poses

GRAVITY = Gravity(value_mps2=G, sd=5e-5, source="stated")


def calibrated(log: Log, *, scale_known: bool = True) -> PoseCalibration:
    samples = PoseSamples(name="log.csv", t_s=log.t_s, outputs=log.accel, scale_known=scale_known)
    return calibrate_poses([samples], GRAVITY, 1.0)


def session(seed: int, poses: int = 20, **changed: float) -> tuple[Truth, Log]:
    rng = np.random.default_rng(seed)
    truth = device(rng)
    return truth, make(rng, truth, Session(up=general_poses(rng, poses), **changed))  # type: ignore[arg-type]


def errors_of(result: PoseCalibration, truth: Truth) -> np.ndarray:
    """Return errors of the shown parameters in half widths of their intervals."""
    rows = zip(result.parameters, truth.nine, strict=True)
    return np.array([(own.value - true) / own.u95 for own, true in rows if own.shown])


@pytest.mark.parametrize(
    ("seed", "changed"),
    [
        (1, {"rate_hz": 50.0, "noise": 0.01}),
        (2, {"rate_hz": 400.0, "noise": 0.1}),
        (3, {"tremor": 0.05}),
        (4, {"instability": 0.003, "longest_s": 12.0}),
    ],
    ids=["quiet 50 Hz", "noisy 400 Hz", "held by hand", "bias that wanders"],
)
def test_nine_parameters_are_found_with_their_uncertainty(seed: int, changed: dict[str, float]) -> None:
    truth, log = session(seed, **changed)
    result = calibrated(log)
    assert len(result.used) == 20
    assert not result.refused
    assert np.abs(errors_of(result, truth)).max() < 2
    assert result.after_mps2 < 0.05 * result.before_mps2


def test_counts_of_unknown_size_and_zero_are_calibrated_too() -> None:
    truth, log = session(5)
    counts = replace(log, accel=np.round(log.accel * 208 + [33000, 32700, 31000]))
    result = calibrated(counts, scale_known=False)
    scaled = Truth(accel=truth.accel * 208, bias=truth.bias * 208 + [33000, 32700, 31000])
    assert result.unit == "counts"
    assert np.abs(errors_of(result, scaled)).max() < 2


def test_the_sigmas_hold_what_is_not_known_of_gravity() -> None:
    _, log = session(6)
    samples = PoseSamples(name="log.csv", t_s=log.t_s, outputs=log.accel)
    wide = calibrate_poses([samples], Gravity(value_mps2=G, sd=1e-3, source="unstated"), 1.0)
    assert wide.parameters[0].sd == pytest.approx(1e-3, rel=0.05)
    assert wide.parameters[3].sd == pytest.approx(calibrated(log).parameters[3].sd)


def test_six_poses_along_the_axes_show_scale_and_bias_but_no_angles() -> None:
    rng = np.random.default_rng(7)
    truth = device(rng)
    result = calibrated(make(rng, truth, Session(up=SIX)))
    assert [own.name for own in result.parameters if not own.shown] == ["angle xy", "angle xz", "angle yz"]
    assert "at least 9 poses in general position are needed; these 6 show scale and bias but no angles" in result.notes
    assert np.abs(errors_of(result, truth)).max() < 1.5


def test_many_poses_on_one_circle_do_not_show_the_axis_that_stays_level() -> None:
    rng = np.random.default_rng(8)
    phi = np.arange(16) * np.pi / 8
    up = np.column_stack([np.cos(phi), np.sin(phi), np.zeros(16)])
    result = calibrated(make(rng, Truth(), Session(up=up)))
    assert {own.name for own in result.parameters if own.shown} == {
        "scale x",
        "scale y",
        "bias x",
        "bias y",
        "angle xy",
    }


def test_a_session_of_two_poses_says_how_many_are_needed() -> None:
    with pytest.raises(RecordingError, match="at least 9 poses in general position"):
        calibrated(session(9, poses=2)[1])


@pytest.mark.parametrize("push", [0.05, 0.3])
def test_a_bumped_rest_is_refused_and_the_others_are_used(push: float) -> None:
    truth, log = session(10)
    start, stop = log.rests[4]
    up = log.accel[start:stop].mean(axis=0) / G
    result = calibrated(bumped(log, 4, push * up))
    (refused,) = result.refused
    assert refused.start_s is not None
    assert log.t_s[start] - 0.3 < refused.start_s < log.t_s[stop - 1]
    assert "gravity by the others" in refused.refused
    assert np.abs(errors_of(result, truth)).max() < 2


def test_three_bumped_rests_do_not_hide_each_other() -> None:
    truth, log = session(13)
    for rest in (2, 9, 15):
        start, stop = log.rests[rest]
        log = bumped(log, rest, 0.1 * log.accel[start:stop].mean(axis=0) / G)
    result = calibrated(log)
    assert len(result.refused) == 3
    assert np.abs(errors_of(result, truth)).max() < 2


def test_rests_on_a_table_and_in_a_hand_are_found_in_one_session() -> None:
    truth, log = session(14, noise=0.01)
    accel = log.accel.copy()
    for start, stop in log.rests[::2]:
        phase = 2 * np.pi * 8.3 * log.t_s[start:stop, None]
        accel[start:stop] += 0.15 * np.sin(phase + np.array([0.0, 2.0, 4.0]))
    result = calibrated(replace(log, accel=accel))
    assert len(result.used) == 20
    assert np.abs(errors_of(result, truth)).max() < 2


def test_rests_in_which_an_axis_saturates_or_sticks_are_refused_by_name() -> None:
    truth, log = session(5)
    result = calibrated(saturated(log, 9.3))
    assert result.refused
    assert all("at the limit of its range" in rest.refused for rest in result.refused)
    assert np.abs(errors_of(result, truth)).max() < 2
    accel = log.accel.copy()
    start, stop = log.rests[7]
    accel[start:stop, 1] = 3.21
    (stuck,) = calibrated(replace(log, accel=accel)).refused
    assert stuck.refused == "y is stuck at 3.21 in 100% of the samples"


def test_coarse_steps_are_no_stuck_axis() -> None:
    _, log = session(11, noise=0.005)
    result = calibrated(replace(log, accel=np.round(log.accel / 0.04) * 0.04))
    assert not [rest for rest in result.refused if "stuck" in rest.refused or "limit" in rest.refused]
    assert result.shown.all()


def _z_reads_14_6(accel: np.ndarray) -> np.ndarray:
    return accel + np.array([0, 0, 4.8])


def _z_too_steep(accel: np.ndarray) -> np.ndarray:
    return accel * [1, 1, 1.49]


def _in_g(accel: np.ndarray) -> np.ndarray:
    return accel / 9.80665


def _twice_in_g(accel: np.ndarray) -> np.ndarray:
    return accel * 9.80665


def _y_dead(accel: np.ndarray) -> np.ndarray:
    return accel * [1, 0, 1]


def _y_only_noise(accel: np.ndarray) -> np.ndarray:
    return accel * [1, 1e-3, 1]


def _x_twice(accel: np.ndarray) -> np.ndarray:
    return accel[:, [0, 0, 2]]


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_z_reads_14_6, "gross error, not a calibration: z reads 14"),
        (_z_too_steep, "gross error, not a calibration: z reads 1.*scale factor 1."),
        (_in_g, "its values look like g. Check unit"),
        (_twice_in_g, "its values look like m/s2 given as g"),
        (_y_dead, "accelerometer y puts out 0 all the time"),
        (_y_only_noise, "accelerometer y does not respond to gravity"),
        (_x_twice, "accelerometers x and y are the same column"),
    ],
)
def test_a_gross_error_is_named_and_not_fitted_away(spoil, message: str) -> None:  # type: ignore[no-untyped-def]
    _, log = session(12)
    with pytest.raises(RecordingError, match=message):
        calibrated(replace(log, accel=spoil(log.accel)))
