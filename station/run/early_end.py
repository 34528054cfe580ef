"""When a run has shown enough: every sigma that the bench requires reached, and the residual clean."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from estimator.calibration.budget import table_budget
from estimator.estimation.live.source import RECENT_S, LiveSource
from estimator.estimation.noise_evidence import TooShort, joint_estimate, run_of_blocks
from estimator.geometry.model import decode
from estimator.observations.blocks import Blocks
from estimator.recordings.recording import ImuData
from estimator.recordings.reference import TableReadings, TableUncertainty
from station.bench.bench import Bench
from station.bench.imu import ImuConfig
from station.errors import UsageError, sentence
from station.opening import OpenBench
from station.run.live import LiveEstimate

_LOOK_EVERY_S = 1.0
_CONFIRM_EVERY_S = 5.0  # an estimate under coloured noise takes a host a third of a second
_ENOUGH = 0.9  # of a limit: the samples of the last seconds may raise the estimated noise
_NO_STAMPS = np.empty(0, dtype=np.int64)
_IN_A_ROW = 2  # so many confirmations: a repeated estimate often falls below its limit by chance


def check_early_end(bench: Bench) -> None:
    """Check that the bench states required sigmas; UsageError if not."""
    if not np.isfinite(bench.limits.sds).any():
        raise UsageError(sentence("run.no_sigmas"))


class EarlyEnd:
    """Watches the live estimate; sigmas that seem to suffice are confirmed with coloured noise."""

    def __init__(self, opened: OpenBench, live: LiveEstimate, time_scale: float) -> None:
        """``time_scale`` is how fast the loop's clock runs."""
        self._imus, self._bench, self._live, self._time_scale = opened.imus, opened.bench, live, time_scale
        self._required = np.array(self._bench.limits.sds)
        live.keep_blocks()

    async def wait(self) -> str:
        """Wait until all required sigmas are confirmed twice in a row; return a sentence about it.

        The live filters are looked at every second; only what they find sufficient is confirmed, in a thread, every 5
        s.
        """
        loop = asyncio.get_running_loop()
        confirmed = 0
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            if not self._seems_enough():
                confirmed = 0
                continue
            # In a thread: while a real table turns, its readings must not wait for an estimate.
            share = await loop.run_in_executor(None, self._largest_share())
            confirmed = confirmed + 1 if share <= _ENOUGH else 0
            if confirmed >= _IN_A_ROW:
                nis, recent = self._live.nis_mean, self._live.nis_recent
                return sentence("run.enough", share=share, nis=nis, recent=recent, recent_s=RECENT_S)
            # The host's time counts: it has the same work to do at every scale.
            await asyncio.sleep(_CONFIRM_EVERY_S * self._time_scale)

    def _seems_enough(self) -> bool:
        """Return whether the live filters have reached all sigmas, and NIS is within its limits.

        They assume white noise. False while a source has no block yet.
        """
        sources = self._live.sources.values()
        if not all(source.history.blocks for source in sources):
            return False
        reached = all((source.decoded()[1] <= self._required).all() for source in sources)
        limits = self._bench.limits
        both = (self._live.nis_mean, self._live.nis_recent)
        return reached and all(limits.nis_low <= nis <= limits.nis_high for nis in both)

    def _largest_share(self) -> Callable[[], float]:
        """Return a function that computes the largest sigma as a share of its limit, from a copy of the present
        data.
        """
        devices = []
        for imu in self._imus:
            sources = [self._live.sources[name] for name in imu.source.names]
            devices.append((imu.config, [(s, s.blocks(), s.filter.offset_sd_s) for s in sources]))
        readings = self._live.readings(self._bench.table.uncertainty)
        return lambda: max(self._share(config, own, readings) for config, own in devices)

    def _share(
        self, config: ImuConfig, sources: Sequence[tuple[LiveSource, Blocks, float]], readings: TableReadings
    ) -> float:
        """Return the largest sigma of a device as a share of its limit, computed as by
        ``estimator.estimation.calibrate``.

        ``sources`` are its sources with their blocks and the time offset's sigma known by the live filter; ``readings``
        are those of the table. Infinite if the data do not suffice.
        """
        runs = []
        for number, (source, blocks, _) in enumerate(sources):
            named = replace(source.array, names=tuple(f"{number} {name}" for name in source.array.names))
            data = ImuData(named, _NO_STAMPS, np.empty((0, len(named))), prior=source.prior)
            runs.append(run_of_blocks(config.name, data, blocks, readings))
        try:
            found = joint_estimate(runs, (), config.noise)
        except TooShort:
            return np.inf
        share = 0.0
        for number, run in enumerate(found.runs):
            gyros = found.gyros_of(number)
            arw = found.arw[gyros.start : gyros.stop]
            known = replace(readings.uncertainty or TableUncertainty(), timing_s=sources[number][2])
            timed = replace(readings, uncertainty=known)
            tables = table_budget(timed, self._bench.site, run.array, run.data.prior, arw)
            for g, table in zip(gyros, tables, strict=True):
                whole = found.covariances[g] + sum(line.covariance for line in table)
                sd = np.sqrt(np.diag(decode(found.means[g], whole)[1]))
                share = max(share, float((sd / self._required).max()))
        return share
