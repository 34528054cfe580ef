"""What a model leaves: noise is called noise, structure is seen, with what it depends on and whose it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from detection_study.study import Case, recordings_of
from known_effects import fit_known

from estimator.estimation.runs.build import runs_of
from estimator.estimation.runs.run import Run
from estimator.recordings.recording import Recording
from estimator.tracing.investigate import investigate
from estimator.tracing.judging.shared_errors import Sharing, sharing
from estimator.tracing.residuals.origin import Origin
from estimator.tracing.residuals.residual import GyroResidual, Residual, residuals

DEG = np.pi / 180


def runs_in(recordings: list[Recording]) -> list[Run]:
    return [run for order, recording in enumerate(recordings) for run in runs_of(recording, order=order)[0]]


def left_by_the_first_model(recordings: list[Recording]) -> Residual:
    """Return what the four states leave of recordings, against the noise found in them."""
    (residual,) = residuals(runs_in(recordings), [fit_known(recordings, [])])
    return residual


def largest(gyro: GyroResidual) -> str:
    return max(gyro.dependences, key=lambda dependence: dependence.share).variable


def with_gyros(recording: Recording, **rows: list[int]) -> Recording:
    """Return a recording of some of its gyros, in sources of these names."""
    data = recording.sources["array"]
    sources = {
        name: replace(data, array=data.array.select(own), rate_rps=data.rate_rps[:, own]) for name, own in rows.items()
    }
    return replace(recording, sources=sources)


def shared_with(recordings: list[Recording], steps_of: Callable[[np.ndarray], np.ndarray]) -> Sharing:
    """Return what gyros share beside their states, with random walks of 400 deg/h in a root hour added to the biases.

    ``steps_of`` makes the steps (n, 4) of the walks from random numbers (n, 4).
    """
    walked = []
    for order, recording in enumerate(recordings):
        data = recording.sources["array"]
        steps = steps_of(np.random.default_rng(order).standard_normal(data.rate_rps.shape))
        walk = np.cumsum(steps, axis=0) * 400 * DEG / 3600 / 60 / np.sqrt(100)
        sources = {"array": replace(data, rate_rps=data.rate_rps + walk)}
        walked.append(replace(recording, sources=sources))
    return sharing(runs_in(walked), fit_known(walked, []))


@pytest.fixture(scope="module")
def clean() -> list[Recording]:
    return list(recordings_of(Case((), 1.0, 11)))


@pytest.fixture(scope="module")
def late() -> list[Recording]:
    """Return recordings with a delay, which is that of the clock."""
    return list(recordings_of(Case(("latency",), 1.0, 11)))


def test_noise_is_as_large_as_its_model_white_and_depends_on_nothing(clean: list[Recording]) -> None:
    residual = left_by_the_first_model(clean[:2])
    assert residual.clean
    assert [gyro.name for gyro in residual.gyros] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    for gyro in residual.gyros:
        assert gyro.nis == pytest.approx(1.0, abs=4 * gyro.nis_sd)
        assert gyro.nis_sd < 0.1
        assert abs(gyro.lag1) < 4 * gyro.lag1_sd
        assert gyro.white_p > 1e-3
        assert {d.variable for d in gyro.dependences} == {
            "time",
            "rate",
            "direction",
            "angle",
            "acceleration",
            "temperature",
            "gravity",
        }
        assert all(d.share == 0 for d in gyro.dependences)
    assert residual.split is not None
    assert residual.split.origin == Origin.NOISE
    assert max(residual.split.common, residual.split.own) < 0.3  # over the noise of one gyro, of which there are four


def test_the_density_of_white_noise_is_twice_the_square_of_its_random_walk(clean: list[Recording]) -> None:
    for gyro in left_by_the_first_model(clean[:2]).gyros:
        spectrum = gyro.spectrum
        fast = spectrum.frequency_hz > 0.3
        assert np.mean(spectrum.density[fast]) == pytest.approx(2 * (0.005 * DEG) ** 2, rel=0.1)
        assert np.mean(spectrum.noise[fast]) == pytest.approx(2 * (0.005 * DEG) ** 2, rel=0.15)
        assert np.all(np.diff(spectrum.frequency_hz) > 0)
        assert np.all(np.diff(spectrum.noise) <= 0)


def test_an_error_of_each_gyro_is_seen_with_its_cause_and_is_gone_with_it() -> None:
    calibration, exploration, verification = recordings_of(Case(("thermal_bias",), 1.0, 3))
    found = investigate([calibration, exploration], [verification])
    assert [a.effect for a in found.added] == ["thermal_bias"]
    assert "thermal_gradient" in found.added[0].same  # the temperature rose as one exponential
    for before, after in (
        (found.residual_before, found.residual_after),
        (found.verified_before, found.verified_after),
    ):
        assert before is not None
        assert after is not None
        assert not before.clean
        assert after.clean
        assert max(gyro.nis for gyro in before.gyros) > 1.4
        for gyro in before.gyros:
            assert not gyro.white
            assert {d.variable: d.share for d in gyro.dependences}["temperature"] > 0.4
        assert before.split is not None
        assert before.split.origin == Origin.OWN
        assert before.split.own > 0.05
        assert before.split.own_share is not None
        for old, new in zip(before.gyros, after.gyros, strict=True):
            slow = old.spectrum.frequency_hz < 0.005
            assert np.all(old.spectrum.density[slow] > 3 * new.spectrum.density[slow])


def test_an_error_of_the_clock_is_common_to_all_gyros(late: list[Recording]) -> None:
    residual = left_by_the_first_model(late[:2])
    assert residual.split is not None
    assert residual.split.origin == Origin.COMMON
    assert residual.split.common > 20 * residual.split.own
    assert {largest(gyro) for gyro in residual.gyros} == {"acceleration"}


def test_an_error_of_the_site_is_common_to_all_gyros() -> None:
    recordings = list(recordings_of(Case(("earth_rate",), 1.0, 11)))
    residual = left_by_the_first_model(recordings[:2])
    assert residual.split is not None
    assert residual.split.origin == Origin.COMMON


def test_gyros_in_several_sources_are_compared_as_those_of_one(late: list[Recording]) -> None:
    apart = [with_gyros(recording, a=[0, 1], b=[2, 3]) for recording in late[:2]]
    split = left_by_the_first_model(apart).split
    assert split is not None
    assert split.origin == Origin.COMMON


def test_a_wander_that_all_gyros_share_is_not_that_of_their_biases(clean: list[Recording]) -> None:
    assert not shared_with(clean[:2], lambda steps: steps).certain
    # One course, with another sign and size in each gyro.
    alike = shared_with(clean[:2], lambda steps: steps[:, :1] * [1.0, -0.7, 1.3, -1.0])
    assert alike.certain
    assert alike.share > 0.5


def test_three_gyros_on_three_axes_cannot_tell_whose_an_error_is(late: list[Recording]) -> None:
    residual = left_by_the_first_model([with_gyros(recording, array=[0, 1, 2]) for recording in late[:2]])
    assert residual.split is None
    assert residual.no_split.startswith("3 gyros on 3 axes")
    assert not residual.clean  # what each gyro shows is told all the same


def test_states_that_do_not_fit_another_run_are_what_its_residual_depends_on(clean: list[Recording]) -> None:
    model = fit_known(clean[:2], [])
    mean = model.mean.copy()
    mean[:, 0] += 1e-3  # a scale factor that changed by 1000 ppm since
    runs = runs_in(clean)[2:]
    good, wrong = residuals(runs, [model, replace(model, mean=mean)], 2, held_back=True)
    assert good.clean
    assert not wrong.clean
    assert {largest(gyro) for gyro in wrong.gyros} == {"states"}


def test_recordings_without_a_temperature_have_no_dependence_on_it(clean: list[Recording]) -> None:
    cold = [
        replace(r, sources={"array": replace(r.sources["array"], temperature_c=None)}) for r in (clean[0], clean[1])
    ]
    for gyro in left_by_the_first_model(cold).gyros:
        assert "temperature" not in {d.variable for d in gyro.dependences}
