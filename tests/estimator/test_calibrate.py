"""From a recording to calibrated gyros: right within its sigmas, and honest about what it did not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimator.calibration.values import Calibration
from estimator.errors import RecordingError
from estimator.estimation.calibrate import calibrate
from estimator.geometry.array import tetrahedron
from estimator.geometry.kinematics import Site
from estimator.geometry.model import predicted_output
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import RateReadings, TableReadings
from sims.direct import TimedMove, direct_run
from sims.physics.geometry import MOUNTS_DEG, mounted
from sims.physics.gyro import GyroTruth

DEG = np.pi / 180
SITE = Site(np.radians(45.0), np.radians(30.0))
GIMBALS = ("z", "y", "x")
STATES = np.random.default_rng(11).uniform(-1, 1, (4, 4)) * np.array([0.01, 0.2 * DEG, 0.5 * DEG, 0.5 * DEG])
NOISE_RPS = 0.05 * DEG


def turns(axes: str, *, back: bool = True) -> tuple[list[TimedMove], float]:
    """Return a whole turn to and fro about each axis after 5 s of rest, and how long all of it takes."""
    moves, at = [], 5.0
    for axis in axes:
        for angle in (2 * np.pi, 0.0) if back else (2 * np.pi,):
            moves.append(TimedMove(at, axis, angle, 40 * DEG, 40 * DEG))
            at += 11.0
    return moves, at + 5.0


def recorded(seed: int, axes: str = "xyz", *, states: np.ndarray = STATES, rate_hz: float = 100.0) -> Recording:
    """Return what a tetrahedron on a table reports of these turns."""
    moves, duration = turns(axes)
    truth = GyroTruth(*states.T, arw_rps_rthz=NOISE_RPS / np.sqrt(rate_hz), bias_instability_rps=0.0)
    run = direct_run(
        moves,
        duration,
        mounted(MOUNTS_DEG["tetrahedron"]),
        truth,
        (seed,),
        gimbals=GIMBALS,
        latitude_rad=SITE.latitude_rad,
        heading_rad=SITE.heading_rad,
        rate_hz=rate_hz,
    )
    reference = TableReadings(t_ns=run.table_t_ns, angle_rad=run.angle_rad, rate_rps=run.rate_rps, gimbals=GIMBALS)
    return Recording({"array": ImuData(tetrahedron(), run.t_ns, run.output_rps)}, reference, SITE)


def with_data(recording: Recording, **changes: object) -> Recording:
    data = replace(recording.sources["array"], **changes)  # type: ignore[arg-type]
    return replace(recording, sources={"array": data})


def scores(calibration: Calibration, states: np.ndarray = STATES) -> np.ndarray:
    return np.array([(g.states - true) / g.sd for g, true in zip(calibration.gyros, states, strict=True)])


@pytest.fixture(scope="module")
def run() -> Recording:
    return recorded(0)


@pytest.mark.parametrize("seed", range(4))
def test_every_state_is_found_within_four_sigma(seed: int) -> None:
    calibration = calibrate(recorded(seed))
    found = scores(calibration)
    assert np.abs(found).max() < 4
    assert 0.5 < np.sqrt(np.mean(found**2)) < 1.5
    assert calibration.nis_mean == pytest.approx(1.0, abs=0.1)
    assert [note.partition(" for ")[0] for note in calibration.notes] == ["constancy not proved"]
    assert [g.name for g in calibration.gyros] == ["gyro1", "gyro2", "gyro3", "gyro4"]
    np.testing.assert_allclose([g.noise_rps for g in calibration.gyros], NOISE_RPS, rtol=0.05)


def test_sigmas_resolve_what_they_are_to_resolve(run: Recording) -> None:
    sd = np.array([g.sd for g in calibrate(run).gyros])
    assert np.all(sd[:, 0] < 100e-6)
    assert np.all(sd[:, 1] < 10 * DEG / 3600)
    assert np.all(sd[:, 2:] < 100e-6)


def test_without_the_site_earth_rate_turns_up_as_an_error(run: Recording) -> None:
    assert np.abs(scores(calibrate(replace(run, site=None)))).max() > np.abs(scores(calibrate(run))).max()


def test_a_faster_source_is_calibrated_alike() -> None:
    assert np.abs(scores(calibrate(recorded(5, rate_hz=1000.0)))).max() < 4.5


def test_a_run_about_one_axis_says_what_it_has_not_seen() -> None:
    calibration = calibrate(recorded(1, axes="z"))
    # The first gyro's axis is z: its tilts put x and y into its output, about which nothing turned.
    unseen = [note for note in calibration.notes if note.startswith("gyro1:")]
    assert len(unseen) == 2
    assert any("misalignment sigma_j is not determined by this run" in note for note in unseen)
    assert any("misalignment sigma_k is not determined by this run" in note for note in unseen)
    assert all("% of the data sheet value" in note for note in unseen)
    assert np.abs(scores(calibration)[0, :2]).max() < 4


def test_a_run_at_rest_sees_no_scale_factor() -> None:
    calibration = calibrate(recorded(2, axes=""))
    for gyro in calibration.gyros:
        assert any(
            note.startswith(f"{gyro.name}: scale factor error k is not determined") for note in calibration.notes
        )
        assert not any(note.startswith(f"{gyro.name}: bias") for note in calibration.notes)


@pytest.mark.parametrize("rate_hz", [10.0, 100.0])  # slow samples make longer blocks
def test_noise_that_is_not_white_is_looked_for_in_a_minute_at_any_rate(rate_hz: float) -> None:
    calibration = calibrate(recorded(3, rate_hz=rate_hz))
    assert all(gyro.noise is not None and gyro.noise.instability_below > 0 for gyro in calibration.gyros)


@pytest.mark.parametrize("seconds", [1.5, 2.5, 6.0])
def test_a_second_of_rest_gives_the_noise_and_a_bias_within_its_sigma(run: Recording, seconds: float) -> None:
    data = run.sources["array"]
    n = round(100 * seconds)
    calibration = calibrate(with_data(run, t_ns=data.t_ns[:n], rate_rps=data.rate_rps[:n]))
    found = np.array([gyro.noise.mean.arw for gyro in calibration.gyros if gyro.noise is not None])
    assert found == pytest.approx(NOISE_RPS / 10, rel=0.6)
    assert np.isfinite([gyro.sd for gyro in calibration.gyros]).all()
    assert np.abs(scores(calibration)[:, 1]).max() < 4


def test_samples_that_hold_no_number_are_left_out(run: Recording) -> None:
    data = run.sources["array"]
    rate, bad = data.rate_rps.copy(), np.arange(100, 4000, 13)
    rate[bad, np.arange(len(bad)) % 4] = np.nan
    rate[4001, 0] = np.inf
    keep = np.ones(len(rate), dtype=bool)
    keep[[*bad, 4001]] = False
    found = calibrate(with_data(run, rate_rps=rate))
    clean = calibrate(with_data(run, t_ns=data.t_ns[keep], rate_rps=data.rate_rps[keep]))
    assert found.samples == clean.samples
    np.testing.assert_allclose(scores(found), scores(clean), atol=1e-9)


def test_samples_in_any_order_give_the_same(run: Recording) -> None:
    data = run.sources["array"]
    order = np.random.default_rng(3).permutation(len(data.t_ns))
    shuffled = calibrate(with_data(run, t_ns=data.t_ns[order], rate_rps=data.rate_rps[order]))
    np.testing.assert_allclose(scores(shuffled), scores(calibrate(run)), atol=1e-9)


def test_only_samples_within_the_reference_count(run: Recording) -> None:
    table = run.reference
    assert isinstance(table, TableReadings)
    until = len(table.t_ns) // 2
    short = replace(table, t_ns=table.t_ns[:until], angle_rad=table.angle_rad[:until], rate_rps=table.rate_rps[:until])
    t_ns = run.sources["array"].t_ns
    inside = (t_ns >= short.t_ns[0]) & (t_ns <= short.t_ns[-1])
    assert calibrate(replace(run, reference=short)).samples == 4 * int(inside.sum())


def test_a_reference_that_does_not_cover_the_samples_is_refused(run: Recording) -> None:
    t_ns = run.sources["array"].t_ns
    with pytest.raises(RecordingError, match=r"source array has \d+ samples, 0 of them with reference data"):
        calibrate(with_data(run, t_ns=t_ns + 10**12))


def test_a_rate_reference_that_covers_nothing_is_refused(run: Recording) -> None:
    t_ns = np.arange(100, dtype=np.int64) * 10**9 + 10**15
    for rate in (np.zeros((100, 3)), np.full((100, 3), np.nan)):
        with pytest.raises(RecordingError, match="0 of them with reference data"):
            calibrate(replace(run, reference=RateReadings(t_ns, rate)))


def test_a_source_without_numbers_is_refused(run: Recording) -> None:
    data = run.sources["array"]
    with pytest.raises(RecordingError, match="gyro1: no sample is a valid number"):
        calibrate(with_data(run, rate_rps=np.full_like(data.rate_rps, np.nan)))


def test_lost_samples_are_counted_by_gyro(run: Recording) -> None:
    calibration = calibrate(with_data(run, lost=5))
    assert calibration.lost == 5 * 4
    assert calibration.samples == 4 * len(run.sources["array"].t_ns)


def test_gyros_on_sources_of_their_own_are_calibrated_as_one_array(run: Recording) -> None:
    data = run.sources["array"]
    singles = {f"node{i}": ImuData(data.array.select([i]), data.t_ns, data.rate_rps[:, i : i + 1]) for i in range(4)}
    own = replace(run, attributes={"bench": ""})  # of the station's own, else errors of the reference may hang together
    apart = calibrate(replace(own, sources=singles))
    # Each source has an offset in time of its own.
    np.testing.assert_allclose(scores(apart), scores(calibrate(own)), atol=0.01)
    assert [g.source for g in apart.gyros] == list(singles)


def test_a_rate_reference_calibrates_too() -> None:
    rng = np.random.default_rng(4)
    t_ns = np.arange(20_000, dtype=np.int64) * 10_000_000
    w = 0.5 * np.column_stack([np.sin(0.011 * np.arange(20_000) * f) for f in (1.0, 1.3, 1.7)])
    y = predicted_output(tetrahedron(), STATES, w) + NOISE_RPS * rng.normal(size=(20_000, 4))
    calibration = calibrate(Recording({"array": ImuData(tetrahedron(), t_ns, y)}, RateReadings(t_ns, w)))
    assert np.abs(scores(calibration)).max() < 4
    assert calibration.nis_mean == pytest.approx(1.0, abs=0.1)
