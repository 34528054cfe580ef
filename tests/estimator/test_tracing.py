"""Closing the loop: what twins were given and nobody told is found, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from detection_study.study import Case, end_of, recordings_of
from known_effects import fit_known
from open_worlds import cases as open_worlds
from open_worlds.answers import true_errors
from support import first_gyros

from estimator.errors import InvestigationError
from estimator.geometry.array import sensor_array
from estimator.geometry.kinematics import EARTH_RATE_RPS
from estimator.importing.importing import import_recording
from estimator.importing.mapping.mapping import read_mapping
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from estimator.tracing.investigate import investigate
from estimator.tracing.investigation import Finding

DEG = np.pi / 180


def changed(recording: Recording, **changes: object) -> Recording:
    data = replace(recording.sources["array"], **changes)  # type: ignore[arg-type]
    return replace(recording, sources={"array": data})


@pytest.mark.full  # the short form is the command's, in tests/station
def test_clean_recordings_lack_nothing() -> None:
    ended = end_of(Case((), 1.0, 3))
    assert ended.finding == Finding.NOTHING
    assert not ended.added
    assert not ended.rivals
    assert 0.9 <= ended.coverage_after <= 1.0


@pytest.mark.full
def test_a_bias_that_differs_from_run_to_run_is_told_and_in_the_sigma() -> None:
    recordings = recordings_of(Case((), 1.0, 3))
    shifts = DEG / 3600 * np.array([[50, -40, 10, -30], [-60, 30, 40, 20], [10, 20, -50, 40]])
    moved = [changed(r, rate_rps=r.sources["array"].rate_rps + own) for r, own in zip(recordings, shifts, strict=True)]
    found, still = investigate(moved), investigate(recordings)
    assert any("b differs by" in note and "from run to run" in note for note in found.notes)
    assert not any("from run to run" in note for note in still.notes)
    assert found.finding == Finding.NOTHING
    for gyro, own in zip(found.gyros, still.gyros, strict=True):
        assert 20 * DEG / 3600 < gyro.sd_after[1] < 80 * DEG / 3600
        assert gyro.sd_after[0] < 1.3 * own.sd_after[0]


@pytest.mark.full  # the short form is the command's, in tests/station
def test_an_effect_is_named_added_and_takes_the_error_away_on_a_run_that_was_not_used() -> None:
    calibration, exploration, verification = recordings_of(Case(("scale_asymmetry",), 1.0, 4))
    found = investigate([calibration, exploration], [verification])
    assert found.finding == Finding.ADDED
    assert [(a.effect, a.probability > 0.99) for a in found.added] == [("scale_asymmetry", True)]
    assert set(found.added[0].gyros) == {"gyro1", "gyro2", "gyro3", "gyro4"}
    sizes = [value.value for value in found.added[0].parameters.values()]
    assert np.all(np.abs(np.abs(sizes) - 0.002) < 0.0011)  # from 0.5 to 1.5 of 2000 ppm
    assert found.before.coverage95 < 0.6
    assert found.after.coverage95 > 0.85
    assert found.improvement is not None
    assert found.improvement.low > 8
    assert not found.in_sample
    assert found.before.rms_rps > 10 * found.after.rms_rps
    moved = np.array([gyro.moved for gyro in found.gyros])
    assert np.abs(moved[:, 0]).max() > 5  # the asymmetry had passed for scale factor error
    assert [step.effects for step in found.models] == [(), ("scale_asymmetry",)]
    told = found.added[0].out_of_sample
    assert told is not None
    assert told.by_run is not None
    assert told.least > 100  # what was left out of the fit says so too


@pytest.mark.parametrize(
    "effects",
    [
        pytest.param(("tone",), marks=pytest.mark.full),
        pytest.param(("latency", "warm_up"), marks=pytest.mark.full),
        pytest.param(("bias_drift", "g_sensitivity", "scale_cubic"), marks=pytest.mark.full),
    ],
    ids=str,
)
def test_the_error_that_is_left_is_that_of_an_estimate_that_was_told(effects: tuple[str, ...]) -> None:
    ended = end_of(Case(effects, 1.0, 5))
    assert ended.exact
    assert ended.error < 1.1 * ended.oracle
    assert ended.bare > 1.5 * ended.error


def test_what_the_catalogue_does_not_hold_is_composed_of_what_was_measured() -> None:
    calibration, exploration, verification = first_gyros(2, *recordings_of(Case(("hysteresis",), 1.0, 1)))
    found = investigate([calibration, exploration], [verification], most_effects=1)
    assert found.finding == Finding.ADDED
    assert [(a.constructed, a.expression.partition(",")[0]) for a in found.added] == [(True, "last(u")]
    assert "last direction of the rate" in found.added[0].effect
    assert found.improvement is not None
    assert found.improvement.low > 5


@pytest.mark.full
def test_a_bias_that_lags_the_temperature_has_the_lag_and_the_sizes_that_it_has() -> None:
    recordings = recordings_of(Case(("thermal_lag",), 1.0, 3, shape="cycle"))
    found = investigate(recordings[:2], recordings[2:])
    (added,) = found.added
    assert added.expression.startswith("lag(T, ")
    assert added.parameters["constant"].value == pytest.approx(40, abs=5)


def test_what_does_not_lower_the_error_on_the_verification_run_is_taken_back() -> None:
    calibration, exploration, _ = recordings_of(Case(("scale_asymmetry",), 1.0, 4))
    without = recordings_of(Case((), 1.0, 4))[2]
    found = investigate(first_gyros(1, calibration, exploration), first_gyros(1, without))
    assert not found.added
    assert found.taken_back == ("scale_asymmetry",)
    assert any("but removed" in note for note in found.notes)


def test_an_effect_that_leaves_much_of_its_kind_in_a_run_that_contradicts_it_is_not_stated() -> None:
    calibration, exploration, _ = recordings_of(Case(("scale_cubic",), 1.0, 4))
    more = recordings_of(Case(("scale_cubic", "scale_asymmetry"), 1.0, 4))[2]
    found = investigate(first_gyros(1, calibration, exploration), first_gyros(1, more))
    (added,) = found.added
    assert added.effect == "scale_cubic"
    assert added.probability < 0.95


def test_an_error_that_gyros_share_is_no_wander_of_their_biases_and_leaves_no_law_certain() -> None:
    # The biases follow half the difference of two angles, which no law here does.
    world = open_worlds.made(open_worlds.Case("half_angle_difference", 1.0, 0))
    fitted, verification, clean = (first_gyros(3, *own) for own in (world.fitted, [world.verification], [world.clean]))
    found = investigate(fitted, verification)
    _, true_after_rps = true_errors(found, clean[0])
    assert found.after.rms_rps == pytest.approx(true_after_rps, rel=0.2)
    assert found.finding == Finding.UNEXPLAINED
    assert "a cause that acts on all gyros" in found.reason
    assert all(added.constructed and added.probability < 0.95 for added in found.added)


def test_the_constant_of_a_law_is_found_under_the_noise_beside_it() -> None:
    # Without the law the noise holds what it explains, and the constant is found several sigmas off.
    world = open_worlds.made(open_worlds.Case("self_heating", 1.0, 0))
    found = investigate(world.fitted, [world.verification])
    (added,) = found.added
    assert added.expression.startswith("lag(abs(u), ")
    constant = added.parameters["constant"]
    assert constant.value == pytest.approx(28.126, abs=3 * constant.sd)  # as the case draws it
    assert constant.sd < 1.5


def test_an_effect_with_a_name_has_no_rival_of_the_same_law() -> None:
    world = open_worlds.made(open_worlds.Case("rate_saturating", 1.0, 0))
    found = investigate(world.fitted, [world.verification])
    assert found.finding == Finding.ADDED
    assert [(added.effect, added.probability > 0.95) for added in found.added] == [("scale_cubic", True)]


@pytest.mark.full
def test_gyros_that_pick_up_one_field_have_it_in_one_law_of_one_shape() -> None:
    world = open_worlds.made(open_worlds.Case("lorentz_drive_scale", 1.0, 0))
    found = investigate(world.fitted, [world.verification])
    (added,) = found.added
    assert added.probability > 0.95
    assert all(term in added.expression for term in ("u*gs", "u*ms", "u*ns"))
    assert len(added.parameters) == 4


def test_laws_that_predict_the_same_are_no_rivals() -> None:
    # The size of the rate and the sum of the axes' rates, both with a lag: turns are about one axis at a time.
    world = open_worlds.made(open_worlds.Case("supply_of_table", 1.0, 0))
    found = investigate(first_gyros(1, *world.fitted), first_gyros(1, world.verification))
    assert found.finding == Finding.ADDED
    assert not found.rivals
    (added,) = found.added
    assert any("a law of the" in same for same in added.same)


@pytest.mark.full
def test_what_happens_in_a_sector_of_an_angle_is_followed_where_no_law_has_a_form() -> None:
    world = open_worlds.made(open_worlds.Case("worn_slip_ring", 1.0, 1))
    found = investigate(world.fitted, [world.verification])
    (added,) = found.added
    assert "angle of axis y" in added.effect
    assert "one shape for all gyros" in added.effect
    assert found.after.rms_rps < found.before.rms_rps / 8


@pytest.mark.full  # the short form is the command's, in tests/station
def test_an_error_that_only_the_verification_shows_is_no_cause_but_a_question() -> None:
    calibration, _, verification = recordings_of(Case(("scale_asymmetry",), 1.0, 2))
    alone = investigate([calibration])
    assert alone.in_sample
    assert alone.finding == Finding.NOTHING  # the script is saturated: the residual is clean, the calibration wrong
    found = investigate([calibration], [verification])
    assert found.finding in (Finding.CANNOT_TELL, Finding.UNEXPLAINED)
    assert not found.added
    assert "verification" in found.reason
    assert any("scale_asymmetry" in names for names in found.rivals)


def test_recordings_that_do_not_belong_together_are_refused() -> None:
    calibration, exploration, verification = recordings_of(Case((), 1.0, 0))
    array = verification.sources["array"].array
    other = changed(verification, array=replace(array, names=("a", "b", "c", "d")))
    with pytest.raises(InvestigationError, match="another device"):
        investigate([calibration, exploration], [other])
    with pytest.raises(InvestigationError, match="another device"):
        investigate([calibration, changed(exploration, array=replace(array, p=-array.p))])
    data = verification.sources["array"]
    rest = changed(verification, t_ns=data.t_ns[:1400], rate_rps=data.rate_rps[:1400], temperature_c=None)
    with pytest.raises(InvestigationError, match="no conditions in common"):
        investigate([calibration, exploration], [rest])
    data = calibration.sources["array"]
    short = changed(calibration, t_ns=data.t_ns[:300], rate_rps=data.rate_rps[:300], temperature_c=None)
    with pytest.raises(InvestigationError, match="too little data"):
        investigate([short])


def test_effects_that_the_recordings_cannot_show_are_left_out_by_name() -> None:
    recordings = first_gyros(1, *recordings_of(Case((), 1.0, 1)))
    cold = [changed(recording, temperature_c=None) for recording in recordings]
    found = investigate(cold[:2], cold[2:])
    assert found.finding == Finding.NOTHING
    assert {"thermal_bias", "thermal_scale", "thermal_gradient"} <= set(found.left_out)
    assert "temperature" in found.left_out["thermal_bias"]
    with pytest.raises(InvestigationError, match="temperature"):
        fit_known(cold[:2], ["thermal_bias"])


@pytest.mark.parametrize(
    ("excess_rps", "finding"),
    [(0.0, Finding.NOTHING), pytest.param(30.0, Finding.UNEXPLAINED, id="with a law no effect is as large as")],
)
def test_effects_that_all_drown_in_noise_are_left_out_and_nothing_is_added(excess_rps: float, finding: Finding) -> None:
    (recording,) = first_gyros(1, recordings_of(Case((), 1.0, 6))[1])
    rate_rps = recording.sources["array"].rate_rps
    output = np.random.default_rng(1).normal(rate_rps + excess_rps * np.abs(rate_rps) / np.abs(rate_rps).max(), 30.0)
    found = investigate([changed(recording, rate_rps=output)])
    assert (found.finding, found.added) == (finding, ())
    assert set(found.left_out.values()) == {"the motion does not excite it"}


def test_faults_of_the_data_are_named_and_cost_only_what_they_spoil() -> None:
    _, exploration, verification = recordings_of(Case((), 1.0, 6))
    rate = exploration.sources["array"].rate_rps.copy()
    for first in (10_000, 15_000):
        rate[first : first + 400, 1] = rate[first, 1]
    found = investigate([changed(exploration, rate_rps=rate)], [verification])
    assert [(a.effect, a.gyros) for a in found.added] == [("stuck", ("gyro2",))]
    spans_s = {"gyro2 from": 100.0, "gyro2 until": 104.0, "gyro2 from (2)": 150.0, "gyro2 until (2)": 154.0}
    assert {name: value.value for name, value in found.added[0].parameters.items()} == pytest.approx(spans_s, abs=0.1)
    assert len(found.gyros) == 4

    held = np.repeat(exploration.sources["array"].rate_rps[::4], 4, axis=0)
    found = investigate(first_gyros(1, changed(exploration, rate_rps=held)))
    assert [a.effect for a in found.added] == ["sample_hold"]
    assert found.added[0].parameters["delay"].value == pytest.approx(0.015, abs=0.003)


@pytest.mark.full
def test_drift_on_the_clock_of_a_session_is_told_from_temperature() -> None:
    recordings = list(recordings_of(Case((), 1.0, 7)))
    for number, recording in enumerate(recordings):
        data, reference = recording.sources["array"], recording.reference
        assert isinstance(reference, TableReadings)
        later_ns = 400_000_000_000 * number
        t_ns = data.t_ns + later_ns
        drift = np.outer(t_ns * 1e-9, 1e-4 * DEG * np.array([1.0, -1.0, 0.7, 1.3]))
        moved = changed(recording, t_ns=t_ns, rate_rps=data.rate_rps + drift)
        recordings[number] = replace(moved, reference=replace(reference, t_ns=reference.t_ns + later_ns))
    found = investigate(recordings[:2], recordings[2:])
    assert [a.effect for a in found.added] == ["bias_drift"]
    slopes = [v.value / (1e-4 * DEG) for v in found.added[0].parameters.values()]
    np.testing.assert_allclose(slopes, [1.0, -1.0, 0.7, 1.3], atol=0.06)


def test_nothing_is_found_in_the_rests_of_a_real_session() -> None:
    folder = Path(__file__).parent.parent / "data" / "ferraris"
    imported = import_recording(read_mapping(folder / "mapping_rest.toml"), [folder / "session.csv"])
    found = investigate([imported.recording])
    assert found.finding == Finding.NOTHING
    assert found.in_sample


def test_the_lag_of_a_real_gyro_behind_its_optical_reference_is_found_and_helps_on_another_trial() -> None:
    folder = Path(__file__).parent.parent / "data" / "broad"
    first, second = (
        import_recording(read_mapping(folder / "mapping.toml"), [path]).recording
        for path in sorted(folder.glob("*.mat"))
    )
    found = investigate([first], [second])
    assert [a.effect for a in found.added] == ["latency"]
    assert found.added[0].parameters["delay"].value == pytest.approx(0.0042, abs=0.0005)  # extracts of a minute
    assert found.improvement is not None
    assert found.improvement.ratio > 2


def test_a_real_gyro_that_lags_behind_a_coarse_encoder_is_late_and_nothing_else() -> None:
    folder = Path(__file__).parent.parent / "data" / "mpu6050"
    imported = import_recording(read_mapping(folder / "yaw.toml"), sorted(folder.glob("*.mat")))
    found = investigate([imported.recording])
    assert [a.effect for a in found.added] == ["latency"]
    assert found.added[0].parameters["delay"].value == pytest.approx(0.0118, abs=0.001)


def test_a_reference_that_lags_is_named_as_that() -> None:
    recording = _on_a_shaft(gyro_early_s=0.023)
    found = investigate([recording])
    assert [a.effect for a in found.added] == ["reference_lag"]
    assert found.added[0].parameters["delay"].value == pytest.approx(0.023, abs=0.0015)


def _on_a_shaft(gyro_early_s: float) -> Recording:
    """Return a gyro on a shaft that is turned by hand, beside an encoder that is read 26 times a second."""
    random = np.random.default_rng(11)
    tones = random.uniform(0.1, 0.7, 6), random.uniform(0, 6.28, 6), random.uniform(0.2, 1.0, 6)

    def angle(t_s: np.ndarray) -> np.ndarray:
        return np.asarray(sum(a * np.sin(2 * np.pi * f * t_s + p) for f, p, a in zip(*tones, strict=True)))

    t_ns = np.round(np.arange(0, 120, 0.01) * 1e9).astype(np.int64)
    read_ns = np.round(np.arange(0.013, 120, 1 / 26) * 1e9).astype(np.int64)
    shown = t_ns * 1e-9 + gyro_early_s
    rate = (angle(shown + 5e-5) - angle(shown - 5e-5)) / 1e-4 + 0.02 + 0.002 * random.standard_normal(len(t_ns))
    counts = 2 * np.pi / 4000 * np.round(angle(read_ns * 1e-9) * 4000 / (2 * np.pi))
    slope = np.gradient(counts, read_ns * 1e-9)
    reference = TableReadings(t_ns=read_ns, angle_rad=counts[:, None], rate_rps=slope[:, None], gimbals=("z",))
    array = sensor_array([[0.0, 0.0, 1.0]], names=("z",), part_of_array=True)
    return Recording({"gyro": ImuData(array, t_ns, rate[:, None])}, reference)


def test_earth_rate_is_a_rival_where_a_body_rests_and_tilts() -> None:
    random = np.random.default_rng(5)
    n, rate_hz = 6000, 100.0
    ups = np.repeat([[0.0, 0, 1], [0, 0, -1], [0, 0, 1], [0, 0, -1]], n, axis=0)
    t_s = np.arange(len(ups)) / rate_hz + 20.0 * (np.arange(len(ups)) // n)
    earth = EARTH_RATE_RPS * np.sin(np.radians(51.0)) * ups
    noise = np.radians(0.002 / 60) * np.sqrt(rate_hz) * random.standard_normal(ups.shape)
    t_ns = np.round(t_s * 1e9).astype(np.int64)
    data = ImuData(sensor_array(np.eye(3), names=("x", "y", "z")), t_ns, earth + noise, accel_mps2=9.80665 * ups)
    edges = np.concatenate([[t_ns[k * n], t_ns[k * n + n - 1], t_ns[k * n + n - 1] + 10**9] for k in range(4)])
    still = np.tile([[0.0] * 3, [0.0] * 3, [np.nan] * 3], (4, 1))
    found = investigate([Recording({"imu": data}, RateReadings(edges, still))])
    told = {a.effect for a in found.added} | {name for names in found.rivals for name in names}
    assert "earth_rate" in told
