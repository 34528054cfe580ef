"""The view of a running run: keeps the data for a snapshot, and makes one on request.

What comes with every block and every row is only kept; all work is done for who looks.
"""

import asyncio
import logging
import math
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from typing import TypeVar

import numpy as np

from drivers.protocols import ImuSource
from drivers.types import Alignment, ImuBlock, LinkCounts, SourceCounts
from estimator.geometry.model import predicted_output
from station.errors import sentence
from station.opening import OpenBench
from station.opening.reopening import Reopening
from station.run.live import LiveEstimate
from station.run.sequencer import Sequencer
from station.run.snapshot import (
    AccelerometerSnapshot,
    ArmSnapshot,
    AxisSnapshot,
    GyroSnapshot,
    Phase,
    SeriesSnapshot,
    Snapshot,
    SourceSnapshot,
)
from station.run.table_watch import TableRow
from station.scripts.steps.kind import Span

_log = logging.getLogger(__name__)

T = TypeVar("T")

_OVER_S = 2.0  # of the host's clock: for rates and latencies
_SILENT_S = 0.5
_TURNING_RPS = math.radians(0.02)


@dataclass(frozen=True, slots=True)
class _Mark:
    """The progress of a source at one instant."""

    at_s: float
    rows: int
    newest_ns: int
    latency_s: float


class TaskGuard:
    """Run tasks that only serve observers and must not end a run: counts, snapshots, progress, events."""

    def __init__(self, tell: Callable[[str], None]) -> None:
        """``tell`` gets one sentence for each piece of work that fails, at its first failure."""
        self._tell = tell
        self._failed: set[str] = set()
        self.notes: list[str] = []
        """What has been told."""

    def attempt(self, task: str, work: Callable[[], T], otherwise: T) -> T:
        """Return ``work()``, or ``otherwise`` if it raises; ``task`` is its name for the operator.

        The exception goes to ``failed``. MemoryError is raised: the recording would be the next to fail.
        """
        try:
            return work()
        except MemoryError:
            raise
        except Exception as error:  # drivers, plug-ins and the station itself may fail in any way
            self.failed(task, error)
            return otherwise

    def failed(self, task: str, error: Exception) -> None:
        """Log the failure of ``task``, tell it and keep it in ``notes``; further ones of the same name are ignored."""
        if task in self._failed:
            return
        self._failed.add(task)
        _log.error("%s failed; the run continues", task, exc_info=error)
        note = sentence("run.beside_failed", what=task, error=f"{type(error).__name__}: {error}")
        self.notes.append(note)
        self._tell(note)


class Monitor:
    """Collects the state of one run for observers."""

    def __init__(
        self, opened: OpenBench, live: LiveEstimate, reopening: Reopening, time_scale: float, task_guard: TaskGuard
    ) -> None:
        """Start without data; progress comes from the sequencer once it is set.

        Work of the monitor that fails does not end the run: it goes through ``task_guard``, which notes the failure.
        The time of rates, and that after which a source is silent, are stretched by ``time_scale``, the clock's speed.
        """
        self._task_guard = task_guard
        self._counts: dict[str, SourceCounts] = {}
        self._open, self._live, self._reopening, self._scale = opened, live, reopening, time_scale
        self._axes = opened.bench.table.gimbals
        self._series: dict[str, tuple[SeriesSnapshot, ...]] = {}
        self._rows: Counter[str] = Counter()
        self._last: dict[str, ImuBlock] = {}
        self._marks: defaultdict[str, deque[_Mark]] = defaultdict(deque)
        self.phase = Phase.CONNECTING
        self.planned = Span.exactly(0.0)
        """How long the script takes."""
        self.sequencer: Sequencer | None = None
        """What drives the script, once it has begun."""
        self.row: TableRow | None = None
        """The last row of table readings."""
        self._ended_s: float | None = None
        self.table_fault = ""
        """What the table ended the run with."""

    def take_block(self, name: str, block: ImuBlock) -> None:
        """Keep the last block of a source, and count its samples."""
        if len(block.t_ns):
            self._rows[name] += len(block.t_ns)
            self._last[name] = block

    def take_series(self, device: str, columns: Mapping[str, str], values: Mapping[str, float]) -> None:
        """Keep the newest row of a device's series; ``columns`` are its units."""
        self._series[device] = tuple(
            SeriesSnapshot(device, column, unit, values[column]) for column, unit in columns.items()
        )

    def mark(self) -> None:
        """Record the progress of each source that has sent samples, a few times a second, as the base for rates.

        The latency is the mean of the last block. Marks older than two seconds are dropped, but for the newest of them.
        """
        now_s = asyncio.get_running_loop().time()
        for name, last in self._last.items():
            latency_s = float((last.arrival_ns - last.t_ns).mean()) * 1e-9
            marks = self._marks[name]
            marks.append(_Mark(now_s, self._rows[name], int(last.t_ns[-1]), latency_s))
            while len(marks) > 2 and marks[1].at_s <= now_s - _OVER_S * self._scale:
                marks.popleft()

    def end(self) -> None:
        """Note that no more samples will come, so that a closed link does not count as silent."""
        self._ended_s = asyncio.get_running_loop().time()

    def counts(self, source: ImuSource, name: str) -> SourceCounts:
        """Return the counts of a source; the last ones if its driver fails."""
        last = self._counts.get(name, SourceCounts())
        self._counts[name] = self._task_guard.attempt(f"counts of {name}", lambda: source.counts(name), last)
        return self._counts[name]

    def alignment(self, source: ImuSource, name: str) -> Alignment | None:
        """Return how the clock of a source relates to the loop's; None if its driver does not tell, or fails."""
        return self._task_guard.attempt(f"clock of {name}", lambda: source.alignment(name), None)

    def link_counts(self) -> Mapping[str, LinkCounts]:
        """Return the link counts by device; empty if a link fails to tell."""
        nothing: Mapping[str, LinkCounts] = {}
        return self._task_guard.attempt("counts of links", self._open.link_counts, nothing)

    def newest(self, quantity: str) -> Mapping[str, float]:
        """Return the newest value of a quantity by source; only "temperature_c" is known, others give an empty mapping.

        It is that of the last sample, however old. Sources without a sample, or with NaN in the last, are left out.
        """
        values = {}
        if quantity == "temperature_c":
            for name, block in self._last.items():
                if block.temperature_c is not None and np.isfinite(block.temperature_c[-1]):
                    values[name] = float(block.temperature_c[-1])
        return values

    @property
    def label(self) -> str:
        """Label of the step under way, empty where there is none."""
        return self.sequencer.label if self.sequencer is not None and self.phase is Phase.RUNNING else ""

    def brief(self) -> Snapshot:
        """Return a snapshot for a progress bar: phase, step, times, pause, samples, lost samples and the mean NIS.

        Counts are sums over all sources; all else is empty or NaN. Before the script begins nothing is done and all
        that is planned is left.
        """
        counts = [self.counts(imu.source, name) for imu in self._open.imus for name in imu.source.names]
        sequencer = self.sequencer
        done_s, left = sequencer.times(asyncio.get_running_loop().time()) if sequencer else (0.0, self.planned)
        return Snapshot(
            self.phase,
            self.label,
            done_s,
            left.least_s,
            samples=sum(c.samples for c in counts),
            lost=sum(c.lost for c in counts),
            nis_mean=self._live.nis_mean,
            paused=sequencer.paused if sequencer else "",
            longer_s=left.longer_s,
        )

    def full(self) -> Snapshot:
        """Return a complete snapshot, after the end as of then; meant for ten calls a second, not for each row."""
        now_s = asyncio.get_running_loop().time() if self._ended_s is None else self._ended_s
        return replace(
            self.brief(),
            nis_recent=self._live.nis_recent,
            whiteness=self._live.whiteness,
            recent=self._live.recent,
            axes=tuple(self._axis_snapshots(now_s)),
            sources=tuple(self._source_snapshots(now_s)),
            gyros=tuple(self._gyro_snapshots()),
            accelerometers=tuple(self._accelerometer_snapshots()),
            arms=tuple(self._arm_snapshots()),
            links=tuple(f"link of {name}: {counts.text}" for name, counts in self.link_counts().items()),
            series=tuple(column for columns in self._series.values() for column in columns),
        )

    def _axis_snapshots(self, now_s: float) -> Iterator[AxisSnapshot]:
        """Yield the state of each axis at ``now_s`` (loop time), outermost first.

        ``state`` is the fault of the table if there is one, the phase before the script, else whether the axis turns,
        faster than 0.02 deg/s. Angle and rate are NaN before a reading. The setpoint, a rate, is 0 and the target NaN
        before the script, and for an axis that is not driven.
        """
        nothing = np.full(len(self._axes), np.nan)
        angles, rates = (self.row.angle_rad, self.row.rate_rps) if self.row else (nothing, nothing)
        for axis, angle, rate in zip(self._axes, angles.tolist(), rates.tolist(), strict=True):
            state = "turning" if abs(rate) > _TURNING_RPS else "at rest"
            if self.sequencer is None:
                state = self.phase
            setpoint, target = 0.0, math.nan
            if self.sequencer is not None:
                setpoint = self.sequencer.setpoint_rps(axis, now_s)
                target = self.sequencer.target_rad(axis)
            yield AxisSnapshot(
                name=axis,
                angle_rad=angle,
                rate_rps=rate,
                setpoint_rps=setpoint,
                state=self.table_fault or state,
                target_rad=target,
            )

    def _source_snapshots(self, now_s: float) -> Iterator[SourceSnapshot]:
        """Yield the state of each source at ``now_s`` (loop time): rate, counts, latency, jitter, temperature, link.

        NaN where nothing is known yet. The latency is the mean over the marks of the last two seconds.
        """
        for imu in self._open.imus:
            for name in imu.source.names:
                counts = self.counts(imu.source, name)
                alignment = self.alignment(imu.source, name)
                last, marks = self._last.get(name), self._marks[name]
                link = self._link(imu.config.name, last, now_s)
                yield SourceSnapshot(
                    name,
                    imu.config.name,
                    self._rate_hz(name, link, now_s),
                    **asdict(counts),
                    latency_s=sum(m.latency_s for m in marks) / len(marks) if marks else math.nan,
                    jitter_s=alignment.jitter_rms_s if alignment else math.nan,
                    temperature_c=math.nan if last is None else float(last.temperature_c[-1]),
                    link=link,
                )

    def _link(self, device: str, last: ImuBlock | None, now_s: float) -> str:
        if device in self._reopening.under_way:
            return "reopening"
        heard = last is not None and now_s - last.arrival_ns[-1] * 1e-9 <= _SILENT_S * self._scale
        return "ok" if heard else "silent"

    def _rate_hz(self, name: str, link: str, now_s: float) -> float:
        """Return the samples per second of a source since its oldest mark, of two seconds ago, or less at first.

        ``link`` is the state of its link. The time ends with the newest sample if that is "ok", else at ``now_s``, so
        that the rate of a silent source falls. NaN while there is no mark, or no time has passed.
        """
        marks = self._marks[name]
        if not marks:
            return math.nan
        until_s = self._last[name].t_ns[-1] * 1e-9 if link == "ok" else now_s
        span_s = float(until_s) - marks[0].newest_ns * 1e-9
        return (self._rows[name] - marks[0].rows) / span_s if span_s > 0 else math.nan

    def _gyro_snapshots(self) -> Iterator[GyroSnapshot]:
        """Yield the state of each gyro by the live filter, with its latest rate and the rate expected of it (rad/s).

        The expected rate is that of a gyro with the present estimates at the last row of table readings. NaN where
        nothing is known yet: ``nis`` and ``residual`` without innovations, rates without samples or rows.
        """
        w_rps = self._live.body_rate(self.row) if self.row else np.full((1, 3), np.nan)
        for name, source in self._live.sources.items():
            x, states, sd = source.recent()
            nothing, last = np.full(len(source.array), np.nan), self._last.get(name)
            nis, residual = ((x**2).mean(axis=0), x[-1]) if len(x) else (nothing, nothing)
            rate = nothing if last is None else last.rate_rps[-1]
            expected = predicted_output(source.array, states, w_rps)[0]
            columns = (states, sd, nis, rate, residual, expected)
            rows = zip(source.array.names, *(c.tolist() for c in columns), strict=True)
            for gyro, values, sds, own_nis, measured, own_residual, predicted in rows:
                yield GyroSnapshot(
                    name=gyro,
                    source=name,
                    values=tuple(values),
                    sds=tuple(sds),
                    nis=own_nis,
                    residual=own_residual,
                    rate_rps=measured,
                    expected_rps=predicted,
                )

    def _accelerometer_snapshots(self) -> Iterator[AccelerometerSnapshot]:
        """Yield the state of each accelerometer by the live filter, with its latest output and the one expected of it.

        The expected output, in m/s2, is that at rest in the last row of table readings. NaN where nothing is known yet;
        an accelerometer that the filter excludes has NaN in the place of its values and sigmas.
        """
        for name, forces in tuple(self._live.forces.items()):
            states, sd = forces.decoded()
            states[np.array(forces.excluded)] = sd[np.array(forces.excluded)] = np.nan
            x = np.array([one.normalised for one in forces.recent_innovations()]).reshape(-1, len(forces.array))
            nothing, last = np.full(len(forces.array), np.nan), self._last.get(name)
            nis = [float(np.mean(own[np.isfinite(own)] ** 2)) if np.isfinite(own).any() else math.nan for own in x.T]
            outputs = nothing if last is None or last.accel_mps2 is None else last.accel_mps2[-1]
            expected = nothing
            if self.row is not None:
                expected = predicted_output(forces.array, states, self._live.gravity(self.row, forces.gravity_mps2))[0]
            for place, accelerometer in enumerate(forces.array.names):
                yield AccelerometerSnapshot(
                    name=accelerometer,
                    source=name,
                    values=tuple(states[place].tolist()),
                    sds=tuple(sd[place].tolist()),
                    nis=nis[place],
                    force_mps2=float(outputs[place]),
                    residual=float(x[-1, place]) if len(x) else math.nan,
                    expected_mps2=float(expected[place]),
                    left_out=forces.left_out[place],
                )

    def _arm_snapshots(self) -> Iterator[ArmSnapshot]:
        """Yield lever arm, delay and recent NIS of the accelerometers of each source that has a live filter for them.

        The NIS is NaN without innovations.
        """
        for name, forces in tuple(self._live.forces.items()):
            arm_m, arm_sd_m = forces.arm()
            delay, recent = forces.delay, forces.recent_innovations()
            count = sum(one.dof for one in recent)
            yield ArmSnapshot(
                source=name,
                arm_m=tuple(arm_m.tolist()),
                arm_sd_m=tuple(arm_sd_m.tolist()),
                delay_s=delay.offset_s,
                delay_sd_s=delay.sd_s,
                nis_recent=sum(one.nis for one in recent) / count if count else math.nan,
                recent=count,
            )
