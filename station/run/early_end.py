"""When a run has shown enough: every sigma that the bench requires reached, and the residual clean.

Accelerometers count where the bench limits their sigmas, and states a data sheet for them.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.calibration.budget import table_budget
from estimator.estimation.accelerometers.calibrate_forces import calibrate_forces
from estimator.estimation.live.source import RECENT_S, LiveSource
from estimator.estimation.noise_evidence import TooShort, joint_estimate, run_of_blocks
from estimator.geometry.array import accelerometer_axes
from estimator.geometry.model import decode
from estimator.observations.blocks import Blocks
from estimator.recordings.recording import ImuData, Recording
from estimator.recordings.reference import TableReadings, TableUncertainty
from estimator.sensors.accelerometers import ACCELEROMETER
from estimator.types import Floats
from station.bench.bench import Bench, ForceLimits
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
    """Check that the bench states required sigmas, of gyros or of accelerometers that it has; UsageError if not."""
    forces = bench.limits.forces.requires_sigmas and any(imu.used and imu.force_sheet is not None for imu in bench.imus)
    if not forces and not np.isfinite(bench.limits.sds).any():
        raise UsageError(sentence("run.no_sigmas"))


@dataclass(kw_only=True, frozen=True, slots=True)
class _Shares:
    """Sigmas as shares of their limits: the largest of the gyros, and those of accelerometers by their names."""

    gyros: float
    forces: Mapping[str, float]

    @property
    def largest(self) -> float:
        """The largest of all."""
        return max([self.gyros, *self.forces.values()])

    def awaited(self) -> list[str]:
        """Return what is not reached of accelerometers, empty as long as gyros are not reached either."""
        return [name for name, share in self.forces.items() if share > _ENOUGH] if self.gyros <= _ENOUGH else []


class EarlyEnd:
    """Watches the live estimate; sigmas that seem to suffice are confirmed with coloured noise."""

    def __init__(
        self, opened: OpenBench, live: LiveEstimate, time_scale: float, on_wait: Callable[[str], None]
    ) -> None:
        """Prepare, and have ``live`` keep from now on what a confirmation needs.

        ``time_scale`` is how fast the loop's clock runs; ``on_wait`` gets a sentence on what is awaited once the gyros
        suffice.
        """
        self._imus, self._bench, self._live, self._time_scale = opened.imus, opened.bench, live, time_scale
        self._required = np.array(self._bench.limits.sds)
        self._on_wait, self._told_of_wait = on_wait, False
        live.keep_blocks()

    async def wait(self) -> str:
        """Wait until all required sigmas are confirmed twice in a row; return a sentence about it.

        The live filters are looked at every second. Only what they show to be sufficient is confirmed, in a thread,
        every 5 s of the wall's clock; a sigma must be below 90 % of its limit then. If accelerometers alone do not
        suffice, ``on_wait`` is called, once.
        """
        loop = asyncio.get_running_loop()
        confirmed = 0
        while True:
            await asyncio.sleep(_LOOK_EVERY_S)
            if not self._seems_enough():
                confirmed = 0
                continue
            awaited = self._live_forces()
            self._tell_of_wait(awaited)
            if awaited:
                confirmed = 0
                continue
            # In a thread: while a real table turns, its readings must not wait for an estimate.
            found = await loop.run_in_executor(None, self._shares())
            self._tell_of_wait(found.awaited())
            share = found.largest
            confirmed = confirmed + 1 if share <= _ENOUGH else 0
            if confirmed >= _IN_A_ROW:
                nis, recent = self._live.nis_mean, self._live.nis_recent
                return sentence("run.enough", share=share, nis=nis, recent=recent, recent_s=RECENT_S)
            # The host's time counts: it has the same work to do at every scale.
            await asyncio.sleep(_CONFIRM_EVERY_S * self._time_scale)

    def _seems_enough(self) -> bool:
        """Return whether the live filters of gyros have reached all sigmas, and NIS is within its limits.

        The NIS is judged over the whole run and over the last half minute. The filters assume white noise. False while
        a source has no block yet.
        """
        sources = self._live.sources.values()
        if not all(source.history.blocks for source in sources):
            return False
        reached = all((source.decoded()[1] <= self._required).all() for source in sources)
        limits = self._bench.limits
        both = (self._live.nis_mean, self._live.nis_recent)
        return reached and all(limits.nis_low <= nis <= limits.nis_high for nis in both)

    def _tell_of_wait(self, awaited: Sequence[str]) -> None:
        """Say what is awaited, the first time that the gyros suffice and accelerometers do not."""
        if awaited and not self._told_of_wait:
            self._told_of_wait = True
            self._on_wait(sentence("run.waits_for_accelerometers", awaited=", ".join(awaited)))

    def _live_forces(self) -> list[str]:
        """Return the names of the sigmas of accelerometers that the live filters have not reached.

        They are such as "ax b" or "lever arm x", after the device if there are several. Empty if none is limited.
        Devices without a data sheet for accelerometers do not count. An accelerometer that is excluded, by its name
        alone, or a device whose accelerometers have sent nothing ("accelerometers of NAME") stays in the list.
        """
        if not self._bench.limits.forces.requires_sigmas:
            return []
        awaited: list[str] = []
        for imu in self._imus:
            if imu.config.force_sheet is None:
                continue
            filters = [self._live.forces[name] for name in imu.source.names if name in self._live.forces]
            if not any(one.blocks for one in filters):
                awaited.append(f"accelerometers of {imu.config.name}")
            for one in filters:
                shares = _force_shares(one.array.names, one.decoded()[1], one.arm()[1], self._bench.limits.forces)
                shares |= {name: np.inf for name, out in zip(one.array.names, one.excluded, strict=True) if out}
                device = f"{imu.config.name} " if len(self._imus) > 1 else ""
                awaited += [f"{device}{name}" for name, share in shares.items() if share > 1]
        return awaited

    def _shares(self) -> Callable[[], _Shares]:
        """Copy the present data; return a function that computes from the copy the sigmas as shares of their limits.

        It may run in a thread. Its result has the largest share of all gyros, and those of accelerometers by name; no
        accelerometer if none is limited.
        """
        devices = []
        for imu in self._imus:
            sources = [self._live.sources[name] for name in imu.source.names]
            devices.append((imu.config, [(s, s.blocks(), s.filter.offset_sd_s) for s in sources]))
        readings = self._live.readings(self._bench.table.uncertainty)
        samples: list[ImuData] = []
        if self._bench.limits.forces.requires_sigmas:
            samples = [
                self._force_data(name, imu.config)
                for imu in self._imus
                for name in imu.source.names
                if name in self._live.forces
            ]
        return lambda: _Shares(
            gyros=max(self._share(config, own, readings) for config, own in devices),
            forces=self._confirmed_forces(samples, readings),
        )

    def _force_data(self, name: str, config: ImuConfig) -> ImuData:
        """Return the accelerometers' samples of a source since ``keep_blocks``, with NaN as the rates of its gyros."""
        t_ns, outputs = self._live.kept_forces(name)
        source = self._live.sources[name]
        return ImuData(
            source.array,
            t_ns,
            np.full((len(t_ns), len(source.array)), np.nan),
            accel_mps2=outputs,
            accel_axes=accelerometer_axes(source.array, config.mounting.axes),
            accel_sheet=config.force_sheet,
            prior=source.prior,
            device=config.name,
            rate_hz=config.rate_hz,
        )

    def _confirmed_forces(self, samples: Sequence[ImuData], readings: TableReadings) -> dict[str, float]:
        """Return the sigmas of accelerometers as shares of their limits, by the estimate at the end of a run.

        Keys are those of ``_force_shares``, or the name alone of an accelerometer that cannot be estimated, whose share
        is infinite. Of several devices with the same names the largest share counts.
        """
        sources = {str(number): data for number, data in enumerate(samples)}
        found, _ = calibrate_forces(Recording(sources, readings, site=self._bench.site))
        shares: dict[str, float] = {}
        for one in found:
            names = [each.name for each in one.accelerometers]
            sds = np.array([each.sd for each in one.accelerometers]).reshape(-1, 4)
            own = _force_shares(names, sds, one.arm_sd_m, self._bench.limits.forces)
            own |= {each.name: np.inf for each in one.excluded}
            for name, share in own.items():
                shares[name] = max(share, shares.get(name, 0.0))
        return shares

    def _share(
        self, config: ImuConfig, sources: Sequence[tuple[LiveSource, Blocks, float]], readings: TableReadings
    ) -> float:
        """Return the largest sigma of a device's gyros as a share of its limit, by the estimate at the end of a run.

        ``sources`` are its sources with their blocks and the live filter's sigma of the time offset (s); ``readings``
        are those of the table, whose uncertainty counts. Infinite if the data do not suffice.
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


def _force_shares(names: Sequence[str], sds: Floats, arm_sd_m: Floats, limits: ForceLimits) -> dict[str, float]:
    """Return the sigmas (a, 4) of accelerometers, and those of their lever arm (3,) in m, as shares of their limits.

    Keys are name and state, such as "ax b", or "lever arm x". Sigmas without a limit are left out, and the lever arm if
    there are no ``names``.
    """
    shares = {
        f"{name} {state.symbol}": float(sd / most)
        for name, own in zip(names, sds, strict=True)
        for state, sd, most in zip(ACCELEROMETER.states, own, limits.sds, strict=True)
        if np.isfinite(most)
    }
    if len(names) and np.isfinite(limits.sd_arm_m):
        shares |= {
            f"lever arm {axis}": float(sd_m / limits.sd_arm_m) for axis, sd_m in zip("xyz", arm_sd_m, strict=True)
        }
    return shares
