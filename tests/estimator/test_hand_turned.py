"""Turns by hand: against stops, by known angles, and between rests, with gravity as the only witness."""

from __future__ import annotations

from functools import reduce

import numpy as np
import pytest
from foreign_logs import GYRO, STAMPED, imported, written
from hand_turned import ARW, G_MPS2, RATE_HZ, Errors, Laid, by_known_angles, fine_rests, from_pose_to_pose
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimator.calibration.error_model import ErrorModel, KnownEffect, ModelError
from estimator.errors import InvestigationError
from estimator.estimation.calibrate import calibrate
from estimator.recordings.reading import read_recording
from estimator.recordings.recording import Recording
from estimator.recordings.writing import write_recording
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Finding
from estimator.tracing.type_model import error_model_of

SIZES = np.array([0.004, -0.003, 0.005])

ASYMMETRY: Errors = lambda up, t_s, w, warmth: SIZES * np.abs(w)  # noqa: E731
CUBIC: Errors = lambda up, t_s, w, warmth: 0.1 * SIZES * w**3  # noqa: E731
THERMAL_SCALE: Errors = lambda up, t_s, w, warmth: 0.1 * SIZES * w * (warmth[:, None] - 25)  # noqa: E731
THERMAL_BIAS: Errors = lambda up, t_s, w, warmth: SIZES * (warmth[:, None] - 25) / 40  # noqa: E731
GRAVITY: Errors = lambda up, t_s, w, warmth: np.radians(0.05) * up[:, [1, 2, 0]]  # noqa: E731


@pytest.mark.parametrize(
    ("effect", "errors", "further"),
    [
        ("scale_asymmetry", ASYMMETRY, {}),
        pytest.param("scale_cubic", CUBIC, {}, marks=pytest.mark.full),
        pytest.param("thermal_scale", THERMAL_SCALE, {"temperature_c": (20.0, 45.0)}, marks=pytest.mark.full),
        ("thermal_bias", THERMAL_BIAS, {"temperature_c": (20.0, 45.0)}),
        pytest.param("g_sensitivity", GRAVITY, {"accelerometer": True}, marks=pytest.mark.full),
    ],
)
def test_what_the_integral_over_a_turn_shows_is_traced(effect: str, errors: Errors, further: dict) -> None:
    recording, unit = by_known_angles(1, errors, **further)
    found = investigate([recording])
    assert found.finding == Finding.ADDED, found.reason
    assert [added.effect for added in found.added] == [effect]
    assert {"latency", "bandwidth", "acceleration_sensitivity"} <= set(found.left_out)
    assert "turn from rest to rest" in found.left_out["latency"]
    after = np.array([gyro.states_after for gyro in found.gyros])
    sd = np.array([gyro.sd_after for gyro in found.gyros])
    assert np.all(np.abs(after - unit.states()) < 4 * sd)
    if effect == "scale_asymmetry":
        values = [found.added[0].parameters[f"{name} each direction"] for name in "xyz"]
        for value, true in zip(values, SIZES, strict=True):
            assert abs(value.value - true) < 4 * value.sd < 0.004


def test_turns_of_a_gyro_that_lacks_nothing_end_with_nothing_to_add() -> None:
    found = investigate([by_known_angles(2, each=2, temperature_c=(20.0, 45.0), accelerometer=True)[0]])
    assert found.finding == Finding.NOTHING, found.reason


def test_an_effect_that_turns_showed_is_judged_on_others_and_put_into_their_calibration() -> None:
    recording, _ = by_known_angles(4, ASYMMETRY)
    other, unit = by_known_angles(5, ASYMMETRY)
    found = investigate([recording], [by_known_angles(4, ASYMMETRY, each=3)[0]])
    assert found.finding == Finding.ADDED
    assert found.improvement is not None
    assert found.improvement.low > 2
    assert found.model is not None
    calibration = calibrate(other, model=error_model_of(found.model))
    k, var = (
        np.array(each) for each in zip(*((g.states[0], g.covariance[0, 0]) for g in calibration.gyros), strict=True)
    )
    assert np.all(np.abs(k - unit.states()[:, 0]) < 4 * np.sqrt(var))


def test_a_few_turns_are_too_few_to_trace_anything() -> None:
    recording, _ = by_known_angles(6, each=1, seconds=(3.0,), angles_deg=(360.0,))
    with pytest.raises(InvestigationError, match="6 turns and rests .* at least 12"):
        investigate([recording])


ACCELEROMETER = '[accelerometer]\ncolumns = ["ax", "ay", "az"]\nunit = "m/s2"\n'
GRAVITY_MAPPING = STAMPED + GYRO + ACCELEROMETER + '[reference]\nkind = "gravity"\n'


def recording_of(tmp_path, laid: Laid, more: str = "") -> Recording:
    found = imported(*written(tmp_path, GRAVITY_MAPPING + more, laid.csv()))
    assert not found.refused
    write_recording(tmp_path / "laid.h5", found.recording)
    return read_recording(tmp_path / "laid.h5")


def least_squares_of(laid: Laid) -> np.ndarray:
    """Return matrix and bias (12,) of the gyros by a fit of its own: rests, and gravity carried between them."""
    rests = [slice(round(a * RATE_HZ) + 5, round(b * RATE_HZ) - 5) for a, b in laid.limits_s]
    means = np.array([laid.accel_mps2[rest].mean(axis=0) for rest in rests])

    def force(x: np.ndarray) -> np.ndarray:
        lower = np.eye(3)
        lower[np.tril_indices(3)] = x[:6]
        return np.linalg.solve(lower, (means - x[6:]).T).T

    start = [1, 0, 1, 0, 0, 1, 0, 0, 0]
    of_norm = least_squares(lambda x: np.linalg.norm(force(x), axis=1) / G_MPS2 - 1, start, x_scale=1e-3)
    ups = force(of_norm.x)
    ups /= np.linalg.norm(ups, axis=1, keepdims=True)

    def left(x: np.ndarray) -> np.ndarray:
        inverse, bias = np.linalg.inv(x[:9].reshape(3, 3)), x[9:]
        out = [(laid.rate_rps[rest].mean(axis=0) + bias) / (ARW / np.sqrt(5.0)) for rest in rests]
        for before, after, rest, then in zip(ups, ups[1:], rests, rests[1:], strict=False):
            w = (laid.rate_rps[rest.stop : then.start + 1] + bias) @ inverse.T
            steps = Rotation.from_rotvec(0.5 * (w[1:] + w[:-1]) / RATE_HZ).as_matrix()
            out.append((reduce(np.matmul, steps).T @ before - after) / 4e-4)
        return np.concatenate(out)

    return least_squares(left, [*np.eye(3).ravel(), 0, 0, 0], x_scale=1e-3).x


def test_a_model_without_effects_counts_as_none_beside_poses_and_few_turns(tmp_path) -> None:
    few_turns, _ = by_known_angles(6, each=1, seconds=(3.0,), angles_deg=(360.0,))
    for recording in (few_turns, recording_of(tmp_path, from_pose_to_pose(11, poses=12))):
        plain, empty = calibrate(recording), calibrate(recording, model=ErrorModel(()))
        assert np.array_equal([gyro.states for gyro in plain.gyros], [gyro.states for gyro in empty.gyros])
    with pytest.raises(ModelError, match="Leave out --model"):
        calibrate(recording, model=ErrorModel((KnownEffect("latency", False, ()),)))


@pytest.mark.parametrize("seed", [11])
def test_gravity_at_rests_calibrates_gyros_that_are_turned_by_hand_between_them(tmp_path, seed: int) -> None:
    laid = from_pose_to_pose(seed, poses=12)
    recording = recording_of(tmp_path, laid)
    assert "accelerometer" in recording.attributes["imported"]
    calibration = calibrate(recording)
    states = np.array([gyro.states for gyro in calibration.gyros])
    sd = np.array([np.sqrt(np.diag(gyro.covariance)) for gyro in calibration.gyros])
    assert np.all(np.abs(states - laid.unit.states()) < 4 * sd)
    assert sd[:, 0].max() < 1e-3
    assert sd[:, 2:].max() < np.radians(0.06)
    assert sd[:, 1].max() < np.radians(0.002)
    own = least_squares_of(laid)
    k = 1 - np.diag(own[:9].reshape(3, 3))
    assert np.all(np.abs(k - states[:, 0]) < 1.0 * sd[:, 0])


def test_one_axis_turned_tells_of_that_axis_only_and_says_so(tmp_path) -> None:
    laid = from_pose_to_pose(12, poses=3)
    calibration = calibrate(recording_of(tmp_path, laid, 'accelerometer = "stated"\nsd_deg = 0.3\n'))
    sd = np.array([np.sqrt(np.diag(gyro.covariance)) for gyro in calibration.gyros])
    assert sd[:, 0].max() > 5e-3
    states = np.array([gyro.states for gyro in calibration.gyros])
    assert np.all(np.abs(states - laid.unit.states()) < 4 * sd)


def test_the_earth_at_rests_of_unknown_heading_is_no_drift_of_the_gyros() -> None:
    found = investigate([fine_rests(1, 0.0)])
    named = {added.effect for added in found.added} | {name for names in found.rivals for name in names}
    assert named <= {"earth_rate"}, found.reason
    found = investigate([fine_rests(2, 60.0)])
    assert [added.effect for added in found.added] == ["g_sensitivity"], found.reason
