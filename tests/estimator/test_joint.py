"""States beside laws: undeclared effects, delays of another instrument, halves that disagree, conditions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from motions import simulate
from support import SITE, TABLE_1, direct_recording

from estimator.calibration.budget import UNSEEN
from estimator.calibration.values import Calibration
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron, triad
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from sims.physics.hidden import Hidden
from station.opening import DeviceTruth
from station.scripts.script import Rest, Rotate, Script, paper_script

ASYMMETRY = {"scale_asymmetry": {"size": ["2000 ppm", "-1500 ppm", "1000 ppm", "2500 ppm"]}}


def with_hidden(tables: dict[str, dict[str, object]], seed: int = 1) -> Recording:
    noise = {"arw_rps_rthz": float(np.radians(0.005)), "bias_instability_rps": float(np.radians(2 / 3600))}
    device = DeviceTruth(tetrahedron(), np.tile(TABLE_1, (4, 1)), **noise, kind="tetrahedron")
    return simulate(paper_script(), {"array": device}, seed, site=SITE, hidden=Hidden.of(tables))


def scores(calibration: Calibration) -> np.ndarray:
    return np.array([(gyro.states - TABLE_1) / gyro.sd for gyro in calibration.gyros])


def unseen(calibration: Calibration) -> np.ndarray:
    lines = [line.u for gyro in calibration.gyros for line in gyro.budget if line.name == UNSEEN]
    return np.array(lines).reshape(-1, 4)


def test_an_effect_that_the_script_cannot_show_is_in_the_sigmas_unless_it_is_ruled_out() -> None:
    recording = with_hidden(ASYMMETRY)
    assert np.abs(scores(calibrate(recording))).max() > 10  # declared: no such effects
    expected = calibrate(recording, excluded=frozenset())
    assert np.abs(scores(expected)).max() < 2.5
    assert unseen(expected)[:, 0].min() > 500e-6
    assert any("cannot show, mainly" in note and "scale asymmetry" in note for note in expected.notes)
    without = calibrate(recording, excluded=frozenset({"scale_asymmetry", "scale_quadratic", "scale_cubic"}))
    assert unseen(without)[:, 0].max() < 0.8 * unseen(expected)[:, 0].min()


def test_the_order_of_sources_does_not_decide_what_may_be_there_unseen() -> None:
    steps = (Rest(20.0), Rotate("z", 0.5, 40.0, 0.5, ""), Rest(20.0), Rotate("z", -0.5, 40.0, 0.5, ""), Rest(20.0))
    recording = direct_recording(3, script=Script("z alone", steps), array=triad(), kind=None, rate_hz=50.0)
    data = recording.sources["array"]
    across, along = (
        replace(data, array=data.array.select(rows), rate_rps=data.rate_rps[:, rows]) for rows in ([0, 1], [2])
    )
    sds = []
    for sources in ({"across": across, "along": along}, {"along": along, "across": across}):
        gyros = calibrate(replace(recording, sources=sources), excluded=frozenset()).gyros
        sds.append({gyro.name: gyro.sd for gyro in gyros})
    for name, sd in sds[0].items():
        assert sd == pytest.approx(sds[1][name], rel=0.01), name


def test_the_residual_still_tells_what_the_motion_does_show() -> None:
    tables = {"latency": {"delay": "6 ms"}, "bias_drift": {"size": "0.03 deg/s", "over": "330 s"}}
    expected = calibrate(with_hidden(tables), excluded=frozenset())
    assert np.abs(scores(expected)).max() < 3
    assert expected.nis_mean == pytest.approx(1, abs=0.1)
    assert expected.doubts == ()


def test_on_a_bench_without_such_effects_nothing_is_added() -> None:
    recording = direct_recording(3)
    plain = calibrate(recording)
    assert not unseen(plain).size
    assert max(gyro.sd[0] for gyro in plain.gyros) < 60e-6


def swinging(delay_s: float, k: float = 0.004, sign: float = 1.0, seconds: float = 300.0) -> Recording:
    """A triad that turns to and fro at up to 90 deg/s about all axes, stamped too late, beside the true rates."""
    t_s = np.arange(0, seconds, 0.01)
    frequency, phase = np.array([0.31, 0.43, 0.57]), np.array([0.0, 1.0, 2.0])

    def rate(at_s: np.ndarray) -> np.ndarray:
        return np.asarray(1.5 * np.sin(2 * np.pi * frequency * at_s[:, None] + phase))

    noise = 1e-3 * np.random.default_rng(5).standard_normal((len(t_s), 3))
    stamps = np.round(t_s * 1e9).astype(np.int64)
    output = sign * (1 - k) * rate(t_s - delay_s) + noise
    return Recording({"imu": ImuData(triad(), stamps, output)}, RateReadings(stamps, rate(t_s)))


@pytest.mark.parametrize("delay_s", [0.0, 0.012, -0.007, 0.06])
def test_a_delay_of_the_reference_is_told_and_leaves_the_states_alone(delay_s: float) -> None:
    calibration = calibrate(swinging(delay_s))
    for gyro in calibration.gyros:
        assert gyro.states[0] == pytest.approx(0.004, abs=2e-4)
        assert np.abs(gyro.states[2:]).max() < 4e-4
    told = [note for note in calibration.notes if "ms apart" in note]
    assert bool(told) == bool(delay_s)
    if told:
        assert (
            f"{abs(1e3 * delay_s):.1f} +- 0.1 ms apart, the {'gyros' if delay_s > 0 else 'reference'} late" in told[0]
        )


def test_halves_that_disagree_are_told() -> None:
    recording = swinging(0.0)
    data = recording.sources["imu"]
    late = data.t_ns > 150_000_000_000
    changed = replace(data, rate_rps=data.rate_rps * np.where(late, 1.01, 1.0)[:, None])
    assert calibrate(recording).doubts == ()
    doubts = calibrate(replace(recording, sources={"imu": changed})).doubts
    assert any("the two halves of this recording disagree: k of" in doubt for doubt in doubts)


def test_noise_that_grows_with_the_rate_is_told_and_what_is_slow_counts_for_more() -> None:
    recording = direct_recording(5)
    data = recording.sources["array"]
    sd = 0.05 * np.sqrt(100) * np.abs(data.rate_rps) / 20  # at 20 deg/s ten times the noise at rest
    added = sd * np.random.default_rng(1).standard_normal(sd.shape)
    growing = replace(recording, sources={"array": replace(data, rate_rps=data.rate_rps + added)})
    plain, found = calibrate(recording), calibrate(growing)
    assert not any("grows with the rate" in note for note in plain.notes)
    assert any("grows with the rate" in note for note in found.notes)
    assert found.doubts == ()
    assert not any(check.suspect for check in found.parity)
    assert np.abs(scores(found)).max() < 3.5
    alike = np.sqrt(1 + np.mean(sd**2) / (100 * np.radians(0.005) ** 2))  # if all samples had the mean noise
    biases = [np.mean([gyro.sd[1] for gyro in calibration.gyros]) for calibration in (plain, found)]
    assert biases[1] < 0.6 * alike * biases[0]


def test_states_are_stated_for_their_conditions() -> None:
    said = calibrate(with_hidden({"temperature": {"rise": "8 degC", "time_constant": "250 s"}})).holds_for
    assert "0 to 20 deg/s about x, 0 to 20 deg/s about y, 0 to 20 deg/s about z (x, y, z in one direction)" in said
    assert "25.0 to 31." in said
    assert "0 to 360 s" in said


@pytest.mark.parametrize("accelerometer", [False, True])
@pytest.mark.parametrize("excluded", [None, frozenset[str]()])
def test_a_long_rest_has_numbers_and_no_false_doubts(accelerometer: bool, excluded: frozenset[str] | None) -> None:
    random = np.random.default_rng(7)
    t_ns = np.arange(0, 3_000_000_000_000, 50_000_000, dtype=np.int64)
    walk = np.cumsum(1e-7 * random.standard_normal((len(t_ns), 3)), axis=0)
    rate = 2e-3 + walk + 1e-3 * random.standard_normal((len(t_ns), 3))
    force = np.tile([0.0, 0.0, 9.8], (len(t_ns), 1)) if accelerometer else None
    still = np.zeros((len(t_ns) // 5, 3))
    for reference in (
        RateReadings(t_ns[[0, -1]], np.zeros((2, 3))),
        TableReadings(t_ns=t_ns[::5], angle_rad=still, rate_rps=still, gimbals=("z", "y", "x")),
    ):
        found = calibrate(
            Recording({"imu": ImuData(triad(), t_ns, rate, accel_mps2=force)}, reference), excluded=excluded
        )
        assert np.isfinite([gyro.covariance for gyro in found.gyros]).all()
        assert found.nis_mean == pytest.approx(1, abs=0.1)
        assert found.doubts == ()
