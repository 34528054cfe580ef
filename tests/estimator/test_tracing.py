"""Closing the loop: what twins were given and nobody told is found, and nothing else."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.importing import import_recording
from estimator.mapping import read_mapping
from estimator.recording import Recording
from estimator.reference import TableReadings
from estimator.tracing.investigate import fit_known, investigate
from estimator.tracing.investigation import Finding, InvestigationError
from station.studies.detection import Case, end_of, recordings_of

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


def test_what_no_effect_explains_is_said_to_be_unexplained_with_what_it_depends_on() -> None:
    ended = end_of(Case(("hysteresis",), 1.0, 1))
    assert ended.finding == Finding.UNEXPLAINED
    assert ended.depends_on == "direction"
    assert not ended.added


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
    recordings = recordings_of(Case((), 1.0, 1))
    cold = [changed(recording, temperature_c=None) for recording in recordings]
    found = investigate(cold[:2], cold[2:])
    assert found.finding == Finding.NOTHING
    assert {"thermal_bias", "thermal_scale", "thermal_gradient"} <= set(found.left_out)
    assert "temperature" in found.left_out["thermal_bias"]
    with pytest.raises(InvestigationError, match="temperature"):
        fit_known(cold[:2], ["thermal_bias"])


def test_faults_of_the_data_are_named_and_cost_only_what_they_spoil() -> None:
    calibration, exploration, verification = recordings_of(Case((), 1.0, 6))
    rate = exploration.sources["array"].rate_rps.copy()
    rate[10_000:10_400, 1] = rate[10_000, 1]
    found = investigate([calibration, changed(exploration, rate_rps=rate)], [verification])
    assert [(a.effect, a.gyros) for a in found.added] == [("stuck", ("gyro2",))]
    assert found.added[0].parameters["gyro2 from"].value == pytest.approx(100.0, abs=0.1)
    assert len(found.gyros) == 4

    held = [
        changed(r, rate_rps=np.repeat(r.sources["array"].rate_rps[::4], 4, axis=0)) for r in (calibration, exploration)
    ]
    found = investigate(held)
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
    assert found.added[0].parameters["delay"].value == pytest.approx(0.0043, abs=0.0015)
    assert found.improvement is not None
    assert found.improvement.ratio > 1.5  # extracts of a minute: its interval is wide
