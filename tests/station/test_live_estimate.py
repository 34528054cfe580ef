"""The live estimate works in a thread of its own: whoever looks on meanwhile sees whole blocks, and nothing is lost."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from drivers.types import ImuBlock
from estimator.estimation.live.source import LiveSource
from estimator.geometry.array import triad
from estimator.geometry.model import Prior
from station.run.live import LiveEstimate
from station.run.table_watch import TableRow

SECONDS, ROW_NS, SAMPLE_NS = 20, 50_000_000, 20_000_000
RATE_RPS = 0.1
HELD_FROM_NS = 10_000_000_000
"""What comes later is left for the end."""


@pytest.fixture
def threads_that_take_turns_often() -> Iterator[None]:
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def new_estimate() -> LiveEstimate:
    live = LiveEstimate(("z",), None)
    live.sources["imu"] = LiveSource(array=triad(), rate_hz=1e9 / SAMPLE_NS, noise_rps=1e-3, prior=Prior())
    live.keep_blocks()
    return live


def rows_and_blocks() -> Iterator[tuple[TableRow, ImuBlock]]:
    """Yield what a table and three gyros tell, in the order in which it comes."""
    noise = np.random.default_rng(1)
    for row_ns in range(0, SECONDS * 1_000_000_000, ROW_NS):
        row = TableRow(row_ns, np.array([RATE_RPS * 1e-9 * row_ns]), np.array([RATE_RPS]), 0)
        t_ns = np.arange(row_ns, row_ns + ROW_NS, SAMPLE_NS)
        rate = 1e-3 * noise.normal(size=(len(t_ns), 3))
        rate[:, 2] += RATE_RPS
        yield row, ImuBlock(t_ns=t_ns, arrival_ns=t_ns, rate_rps=rate, temperature_c=np.full(len(t_ns), 25.0))


@pytest.mark.usefixtures("threads_that_take_turns_often")
def test_who_looks_on_while_a_thread_estimates_sees_whole_blocks_and_nothing_is_lost() -> None:
    alone, live = new_estimate(), new_estimate()
    for row, block in rows_and_blocks():
        alone.sources["imu"].add(block)
        if alone.add_row(row):
            alone.advance()
    alone.finish()

    source, told_ns = live.sources["imu"], []
    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(live.advance)
        for row, block in rows_and_blocks():
            source.add(block)
            if live.add_row(row) and row.t_ns < HELD_FROM_NS and working.done():
                working.result()
                working = pool.submit(live.advance)
            normalised, states, sd = source.recent()
            assert len(normalised) <= len(source.recent_innovations())
            assert np.isfinite(states).all()
            assert (sd > 0).all()
            assert live.recent >= 0
            assert np.isnan(live.nis_recent) or live.nis_recent > 0
            assert np.isnan(live.whiteness) or abs(live.whiteness) <= 1
            assert len(source.blocks().rows) <= 20 * len(live.readings(None).t_ns)
            told_ns += source.take_history(1).get("innovation", {"t_ns": np.empty(0)})["t_ns"].tolist()
        working = pool.submit(live.advance)
        live.finish()  # as a run that ends meanwhile
        working.result()
    told_ns += source.take_history()["innovation"]["t_ns"].tolist()
    assert told_ns == alone.sources["imu"].take_history()["innovation"]["t_ns"].tolist()
    np.testing.assert_allclose(source.decoded(), alone.sources["imu"].decoded(), rtol=1e-12)
    np.testing.assert_array_equal(source.blocks().rows, alone.sources["imu"].blocks().rows)
