"""Long runs: memory does not grow with time, and the last hour is estimated as well as the first."""

from __future__ import annotations

import gc
import time
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
from support import direct_recording

from drivers.types import ImuBlock
from estimator.errors import RecordingError
from estimator.estimation.live.source import LiveSource
from estimator.geometry.array import triad
from estimator.geometry.model import Prior
from estimator.recordings.motion.body_rates import BodyRates
from estimator.recordings.reading import read_recording
from estimator.recordings.writing import write_recording
from station.run.live import LiveEstimate
from station.run.table_watch import TableRow
from station.scripts.script import Rest, Script

TABLE_NS, SAMPLE_NS = 100_000_000, 500_000_000


def fed(live: LiveEstimate, from_s: int, until_s: int) -> None:
    """Let a table turn and three gyros tell of it; what the filters say is taken off as a run does."""
    source, noise = live.sources["imu"], np.random.default_rng(from_s)
    for second in range(from_s, until_s):
        t_ns = second * 1_000_000_000 + np.arange(0, 1_000_000_000, SAMPLE_NS)
        rate = np.zeros((len(t_ns), 3))
        rate[:, 2] = 0.4
        source.add(
            ImuBlock(
                t_ns=t_ns,
                arrival_ns=t_ns,
                rate_rps=rate + 1e-3 * noise.normal(size=rate.shape),
                temperature_c=np.full(len(t_ns), 25.0),
            )
        )
        for row_ns in range(second * 1_000_000_000, (second + 1) * 1_000_000_000, TABLE_NS):
            if live.add_row(TableRow(row_ns, np.array([0.4e-9 * row_ns]), np.array([0.4]), 0)):
                live.advance()
        source.take_history(50)


def test_a_live_estimate_needs_no_more_memory_the_longer_it_runs() -> None:
    live = LiveEstimate(("z",), None)
    live.sources["imu"] = LiveSource(array=triad(), rate_hz=2.0, noise_rps=1e-3, prior=Prior())
    tracemalloc.start()
    try:
        fed(live, 0, 140)
        gc.collect()
        before, _ = tracemalloc.get_traced_memory()
        fed(live, 140, 280)
        gc.collect()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 30_000  # where readings and innovations are kept it is ten times that
    assert 0.9 < live.nis_mean < 1.1


def test_rates_of_the_last_minute_do_not_depend_on_the_hours_before() -> None:
    t_ns = np.arange(0, 3600 * 10**9, 100_000_000, dtype=np.int64)
    rate = 0.35 * 1.0005 + 0.002 * np.random.default_rng(1).normal(size=(len(t_ns), 1))
    angle = 0.35e-9 * t_ns[:, None]

    def found(part: slice) -> BodyRates:
        rates = BodyRates("z", None)
        rates.add(t_ns[part], angle[part], np.asarray(rate[part], dtype=np.float64))
        rates.finish()
        return rates

    last = slice(len(t_ns) - 400, None)
    at_ns = t_ns[last][100:-100]
    whole, alone = found(slice(None)).at(at_ns), found(last).at(at_ns)
    assert np.isfinite(alone).all()
    np.testing.assert_allclose(whole, alone, atol=1e-11, rtol=0)


def test_a_recording_for_which_there_is_no_memory_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "huge.h5"
    write_recording(path, direct_recording(1, script=Script("rest", (Rest(4.0),))))
    with h5py.File(path, "r+") as file:
        for name in ("t_ns", "rate_rps"):
            dataset = file[f"imu/array/{name}"]
            dataset.resize((10_000_000_000, *dataset.shape[1:]))  # HDF5 keeps no room for what was never written
    began = time.monotonic()
    with pytest.raises(RecordingError, match=r"huge.h5 holds 4e\+02 GB of .* needs about 1.2e\+03 GB .* are free; use"):
        read_recording(path, trusted=True)
    assert time.monotonic() - began < 5
