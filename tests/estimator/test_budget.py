"""The table's own uncertainty in the states: what an imperfect table does to a calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support import direct_recording

from estimator.estimation.calibrate import calibrate
from estimator.recordings.recording import Recording
from estimator.recordings.reference import TableReadings, TableUncertainty


@pytest.fixture(scope="module")
def run() -> Recording:
    return direct_recording(0, arw_dps=1e-6)


def stated(run: Recording, **uncertainty: float) -> Recording:
    assert isinstance(run.reference, TableReadings)
    return replace(run, reference=replace(run.reference, uncertainty=TableUncertainty(**uncertainty)))


def part(recording: Recording, name: str) -> np.ndarray:
    """Return a contribution to each state of each gyro, (n, 4)."""
    return np.array([next(c.u for c in g.budget if c.name == name) for g in calibrate(recording).gyros])


def test_a_wrong_time_base_is_a_wrong_scale_factor(run: Recording) -> None:
    u = part(stated(run, rate=1e-4), "rate")
    assert isinstance(run.reference, TableReadings)
    table, data = run.reference, run.sources["array"]
    fast = replace(table, t_ns=np.round(table.t_ns / 1.0001).astype(np.int64), rate_rps=table.rate_rps * 1.0001)
    samples = replace(data, t_ns=np.round(data.t_ns / 1.0001).astype(np.int64))
    moved = np.array([g.states for g in calibrate(replace(run, reference=fast, sources={"array": samples})).gyros])
    shift = moved - np.array([g.states for g in calibrate(run).gyros])
    # One common error moves k by all of it; of independent ones of three axes a gyro sees its share of each.
    np.testing.assert_allclose(shift[:, 0], 1e-4, rtol=0.02)
    assert np.all(u[:, 0] <= 1.01e-4)
    assert np.all(u[:, 0] >= 0.57e-4)
    np.testing.assert_allclose(u[0, 0], 1e-4, rtol=0.02)  # gyro 1 lies along z: one axis is all it sees


def test_axes_that_are_not_square_tilt_the_gyros(run: Recording) -> None:
    u = part(stated(run, orthogonality_rad=1e-5), "orthogonality")
    assert np.all(u[:, 2:] > 0.5e-5)
    assert np.all(u[:, 2:] < 2e-5)
    assert np.all(u[:, 1] < 1e-8)


def test_wobble_and_timing_average_out_over_whole_turns_and_equal_ramps(run: Recording) -> None:
    both = stated(run, wobble_rad=1e-5, timing_s=1e-3)
    assert np.all(part(both, "wobble")[:, 2:] < 1e-6)
    assert np.all(part(both, "timing")[:, 0] < 1e-6)


def test_the_sigma_is_the_root_of_the_squares_of_the_budget(run: Recording) -> None:
    for gyro in calibrate(stated(run, rate=1e-4, orthogonality_rad=1e-4)).gyros:
        total = np.sqrt(np.sum([c.u**2 for c in gyro.budget], axis=0))
        np.testing.assert_allclose(gyro.sd, total, rtol=1e-9)


def test_a_table_that_states_nothing_adds_nothing(run: Recording) -> None:
    assert [[c.name for c in g.budget] for g in calibrate(run).gyros] == [["noise"]] * 4
