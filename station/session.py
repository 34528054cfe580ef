"""One run from first contact to verdict: everything opened, the script driven, all recorded, the table at rest."""

from __future__ import annotations

import asyncio
import hashlib
import importlib.metadata
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import DeviceError, LinkLost
from drivers.seams import Identity, ImuBlock
from estimator.calibrate import calibrate
from estimator.calibration import Calibration
from estimator.error_model import ErrorModel
from estimator.errors import EstimatorError
from estimator.gram import solve
from estimator.recording import (
    Recording,
    RecordingWriter,
    read_recording,
    write_attributes,
    write_results,
    write_source_attributes,
)
from estimator.results import write_calibration
from estimator.rows import gram_of
from estimator.sample_columns import SampleColumns, white_solution
from estimator.timing import time_offset
from station.early_end import EarlyEnd
from station.live import LiveEstimate, LiveSource
from station.loops import is_virtual
from station.open_bench import OpenBench, OpenImu
from station.outcome import Outcome, Verdict, judge
from station.reopening import Reopening
from station.script import Script
from station.sequencer import Sequencer
from station.snapshot import Snapshot
from station.sources import SourceReport
from station.table_watch import check_axes, watch_table

Floats = NDArray[np.float64]

_log = logging.getLogger(__name__)

_FLUSH_S = 0.2  # what a killed station loses, at most, beyond what was on its way
_FLUSH_SIMULATED_S = 2.0  # a simulated second lasts milliseconds
_SYNC_S = 0.5
_FIRST_SAMPLE_S = 3.0
_SILENCE_S = 1.0
_STOP_LIMIT_S = 15.0
_UNFINISHED = "the run did not end: the station died without closing the file"


@dataclass(frozen=True, slots=True)
class Result:
    """How a run ended, and its calibration if it came to one."""

    verdict: Verdict
    recording: Path
    calibration: Calibration | None
    agreement: float
    """Largest difference between the live filter and the batch estimate, in sigmas, under the same noise."""
    ended_early: str = ""
    """When and why the script was not run to its end."""
    sources: tuple[SourceReport, ...] = ()
    """What was had of each source."""


class Session:
    """Runs one script on one open bench into one recording."""

    def __init__(
        self,
        bench: OpenBench,
        script: Script,
        path: Path,
        *,
        seed: int = 0,
        reset_fault: bool = False,
        end_early: bool = False,
        model: ErrorModel | None = None,
        time_scale: float = 1.0,
        on_progress: Callable[[Callable[[], Snapshot]], None] = lambda look: None,
    ) -> None:
        """Create the recording; nothing is opened yet.

        ``model``: effects to estimate beside the states; it must fit the table. RecordingError if the file cannot be
        created.
        """
        config = bench.bench
        self._model = model if model is not None and model.effects else None
        self._open, self._bench, self._script = bench, config, script
        self._reset_fault, self._time_scale, self._on_progress = reset_fault, time_scale, on_progress
        self._phase = "connecting"
        self._reason = ""
        self._sequencer: Sequencer | None = None
        self._last_seen_s: dict[str, float] = {}
        self._reports: dict[str, SourceReport] = {}
        self._reopening = Reopening(self._moving, self._event, time_scale)
        self._half_width_ns = 0
        self._connected = False
        self._sync: asyncio.Future[Any] | None = None
        self._live = LiveEstimate(config.table.gimbals, config.site)
        self._writer = RecordingWriter(path, _attributes(bench, script, seed))
        loop = asyncio.get_running_loop()
        if not is_virtual(loop):  # a simulated clock has no place in the day
            self._writer.set_attributes({"clock_zero_utc_s": time.time() - loop.time() / time_scale})
        self._writer.add_table(config.table.gimbals, config.table.uncertainty)
        for imu in bench.imus:
            self._add_sources(imu)
        for source in self._live.sources.values():
            source.keep_blocks()
        self._ended_early = ""
        self._early_end: EarlyEnd | None = None
        if end_early:
            configs = {name: imu.config for imu in bench.imus for name in imu.source.names}
            self._early_end = EarlyEnd(config, configs, self._live, time_scale)

    async def run(self) -> Result:
        """Run to the end. Whatever happens, the table is brought to rest and the recording is closed."""
        loop = asyncio.get_running_loop()
        work = loop.create_task(self._work())
        verdict: Verdict | None = None
        with _signals(self._abort, work):
            try:
                await work
            except asyncio.CancelledError:
                verdict = Verdict(Outcome.ABORTED, self._reason or "cancelled")
            except DeviceError as error:
                verdict = Verdict(Outcome.FAULT, str(error))
            except BaseExceptionGroup as group:
                verdict = _verdict_of(group)
            finally:
                stop_error = await self._rest()
        if stop_error:
            verdict = verdict or Verdict(Outcome.FAULT, stop_error)
            if stop_error not in verdict.reason:
                verdict = replace(verdict, reason=f"{verdict.reason}; {stop_error}")
        return await self._conclude(verdict)

    def snapshot(self) -> Snapshot:
        """Return the state of the run now."""
        now = asyncio.get_running_loop().time()
        elapsed, remaining = self._sequencer.times_s(now) if self._sequencer else (0.0, self._script.duration_s)
        counts = [imu.source.counts(name) for imu in self._open.imus for name in imu.source.names]
        return Snapshot(
            self._phase,
            elapsed,
            remaining,
            sum(c.samples for c in counts),
            sum(c.lost for c in counts),
            self._live.nis_mean,
        )

    def _add_sources(self, imu: OpenImu) -> None:
        config = imu.config
        noise_rps = config.arw_rps_rthz * np.sqrt(config.rate_hz)
        for name, gyros in config.gyros_of(imu.source.names).items():
            array = config.array.select(gyros)
            noise = [config.noise.arw, config.noise.instability, config.noise.walk]
            stated = {"device": config.name, "rate_hz": config.rate_hz, "lost": 0, "noise": noise}
            self._writer.add_source(name, array, config.prior, stated)
            effects = None
            if self._model is not None:
                effects = SampleColumns(self._model, self._bench.table.gimbals, self._bench.site, array)
            self._live.sources[name] = LiveSource(array, config.rate_hz, float(noise_rps), config.prior, effects)

    async def _work(self) -> None:
        table = self._open.table
        axes = self._bench.table.gimbals
        async with asyncio.TaskGroup() as group:
            services = [group.create_task(self._keep_flushing())]
            await table.open()
            self._connected = True
            self._writer.set_attributes(_identity("table_", await table.identify()))
            for imu in self._open.imus:
                await imu.source.open()
                told = _identity("", await imu.source.identify())
                for name in imu.source.names:
                    self._writer.set_source(name, told)
                services.append(group.create_task(self._acquire(imu)))
            await self._first_samples()
            services.append(group.create_task(self._watch_silence()))
            if self._reset_fault:
                await table.reset_fault()
            self._phase = "enabling"
            await table.enable()
            self._phase = "homing"
            await table.home()
            await check_axes(table, axes)
            sequencer = self._sequencer = Sequencer(table, self._script, self._end_step)
            watch = watch_table(
                table,
                axes,
                self._bench.table.poll_rate_hz,
                lambda: sequencer.driven_axis,
                self._take_row,
                self._take_half_width,
                lambda error: self._reopening.restore(table, error),
            )
            services.append(group.create_task(watch))
            self._event("script begins")
            if self._early_end is None:
                await sequencer.run()
            else:
                await self._run_until_enough(group, sequencer, self._early_end)
            self._phase = "finishing"
            for service in services:
                service.cancel()

    async def _run_until_enough(self, group: asyncio.TaskGroup, sequencer: Sequencer, early_end: EarlyEnd) -> None:
        """Run the script to its end, or until enough has been seen: the table is then still to be stopped."""
        script, enough = group.create_task(sequencer.run()), group.create_task(early_end.wait())
        await asyncio.wait((script, enough), return_when=asyncio.FIRST_COMPLETED)
        if not script.done() and enough.done() and not enough.cancelled() and enough.exception() is None:
            now_s = asyncio.get_running_loop().time()
            done_s, left_s = sequencer.times_s(now_s)
            where = f"after {done_s:.1f} s of {done_s + left_s:.1f} s, in step {sequencer.label!r}"
            self._ended_early = f"{where}: {enough.result()}"
            self._event(f"ended early {where}: enough seen")
        script.cancel()
        enough.cancel()

    async def _acquire(self, imu: OpenImu) -> None:
        while True:
            try:
                async for name, block in imu.source.blocks():
                    self._take_block(name, block)
            except LinkLost as error:
                await self._reopening.restore(imu.source, error)
                now_s = asyncio.get_running_loop().time()
                self._last_seen_s |= {name: now_s for name in imu.source.names if name in self._last_seen_s}

    def _moving(self) -> bool:
        """Return whether an axis is driven: then a lost link ends the run."""
        return self._sequencer is not None and self._sequencer.driven_axis is not None

    def _take_block(self, name: str, block: ImuBlock) -> None:
        self._last_seen_s[name] = asyncio.get_running_loop().time()
        where = f"imu/{name}"
        self._writer.append(f"{where}/t_ns", block.t_ns)
        self._writer.append(f"{where}/arrival_ns", block.arrival_ns)
        self._writer.append(f"{where}/rate_rps", block.rate_rps)
        self._writer.append(f"{where}/temperature_c", block.temperature_c)
        if block.counter is not None:
            self._writer.append(f"{where}/counter", block.counter)
        if block.accel_mps2 is not None:
            self._writer.append(f"{where}/accel_mps2", self._in_body_axes(name, block.accel_mps2))
        self._live.sources[name].add(block)

    def _in_body_axes(self, name: str, accel_mps2: Floats) -> Floats:
        """Return specific force (n, 3) along the body's axes; a device tells it along those of its three gyros."""
        p = self._live.sources[name].array.p
        return np.asarray(np.linalg.solve(p, accel_mps2.T).T) if p.shape == (3, 3) else accel_mps2

    def _take_row(self, row: tuple[int, Any, Any]) -> None:
        t_ns, angle_rad, rate_rps = row
        self._writer.append("table/t_ns", np.array([t_ns], dtype=np.int64))
        self._writer.append("table/angle_rad", angle_rad[None])
        self._writer.append("table/rate_rps", rate_rps[None])
        self._live.add_row(t_ns, angle_rad, rate_rps)
        if self._sequencer is not None and self._phase != "finishing":
            self._phase = self._sequencer.label
        self._on_progress(self.snapshot)

    def _take_half_width(self, half_width_ns: int) -> None:
        self._half_width_ns = max(self._half_width_ns, half_width_ns)

    async def _first_samples(self) -> None:
        limit_s = _FIRST_SAMPLE_S * self._time_scale
        names = {name for imu in self._open.imus for name in imu.source.names}
        deadline = asyncio.get_running_loop().time() + limit_s
        while missing := sorted(names - set(self._last_seen_s)):
            if asyncio.get_running_loop().time() > deadline:
                raise LinkLost(
                    self._device_of(missing[0]),
                    f"no samples from {', '.join(missing)} within {limit_s:g} s; is it powered, the link right, "
                    "the rate as in the bench file?",
                )
            await asyncio.sleep(0.05)

    async def _watch_silence(self) -> None:
        limit_s = _SILENCE_S * self._time_scale
        while True:
            await asyncio.sleep(limit_s / 4)
            now = asyncio.get_running_loop().time()
            silent = [
                name
                for name, seen in self._last_seen_s.items()
                if now - seen > limit_s and self._device_of(name) not in self._reopening.under_way
            ]
            if silent:
                raise LinkLost(self._device_of(silent[0]), f"{', '.join(silent)} fell silent for {limit_s:g} s")

    async def _keep_flushing(self) -> None:
        """Hand rows to the operating system five times a second, and have it write them out twice a second.

        A simulated run needs no protection from a power cut and is flushed less often. An fsync holds up whoever
        writes to the file, so it keeps to the host's time, however fast the loop's clock runs.
        """
        loop = asyncio.get_running_loop()
        sync_due_s = loop.time()
        every_s = _FLUSH_SIMULATED_S if is_virtual(loop) else _FLUSH_S
        while True:
            await asyncio.sleep(every_s)
            self._writer.flush()
            synced = self._sync is None or self._sync.done()
            if not is_virtual(loop) and synced and loop.time() >= sync_due_s:
                sync_due_s = loop.time() + _SYNC_S * self._time_scale
                self._sync = loop.run_in_executor(None, os.fsync, self._writer.descriptor)

    async def _rest(self) -> str:
        """Bring the table to rest; return what went wrong with that, in words."""
        table = self._open.table
        try:
            if self._connected:
                async with asyncio.timeout(_STOP_LIMIT_S * self._time_scale):
                    await table.stop()
                    await table.disable()
                self._event("table at rest")
        except (DeviceError, TimeoutError) as error:
            reason = str(error) or "no answer in time"
            self._event(f"controlled stop not confirmed: {reason}")
            return f"the stop could not be confirmed ({reason}): the table's own watchdog must stop it"
        finally:
            table.close()
            for imu in self._open.imus:
                imu.source.close()
        return ""

    async def _conclude(self, verdict: Verdict | None) -> Result:
        for imu in self._open.imus:
            for name, block in imu.source.flush():
                self._take_block(name, block)
            for name in imu.source.names:
                self._reports[name] = SourceReport(name, imu.source.counts(name), imu.source.alignment(name))
                self._writer.set_source(name, self._reports[name].attributes())
        self._writer.set_attributes({"table_read_half_width_ns": self._half_width_ns})
        if self._ended_early:
            self._writer.set_attributes({"ended_early": self._ended_early})
        if self._sync is not None:
            with suppress(OSError):
                await self._sync
        self._writer.close()
        calibration, agreement = None, float("nan")
        if verdict is None:
            try:
                calibration, agreement = self._estimate()
                verdict = judge(calibration, self._bench.limits)
            except EstimatorError as error:
                verdict = Verdict(Outcome.FAIL, str(error))
        write_attributes(self._writer.path, {"outcome": str(verdict.outcome), "reason": verdict.reason})
        reports = tuple(self._reports.values())
        return Result(verdict, self._writer.path, calibration, agreement, self._ended_early, reports)

    def _estimate(self) -> tuple[Calibration, float]:
        """Return the batch estimate from the recorded samples, and how far the live filter is from it."""
        self._live.finish()
        path = self._writer.path
        recording = read_recording(path, trusted=True)
        found = calibrate(recording, innovations=False, model=self._model)
        calibration = replace(found, nis_mean=self._live.nis_mean, notes=(*found.notes, *self._live.notes))
        agreement = self._agreement(recording)
        for name, source in self._live.sources.items():
            offset = time_offset(source.blocks(), source.array, source.prior)
            self._reports[name] = replace(self._reports[name], offset=offset)
        write_source_attributes(path, {name: report.attributes() for name, report in self._reports.items()})
        write_calibration(path, calibration, {"live_batch_difference_sigma": agreement})
        for name, source in self._live.sources.items():
            h = source.history
            innovation = {"t_ns": h.t_ns, "nis": h.nis, "dof": h.dof, "normalised": h.normalised}
            estimate = {"t_ns": h.state_t_ns, "states": h.states, "sd": h.sd}
            write_results(path, f"innovation/{name}", {k: np.array(v) for k, v in innovation.items()}, {})
            write_results(path, f"estimate/{name}", {k: np.array(v) for k, v in estimate.items()}, {})
        return calibration, agreement

    def _agreement(self, recording: Recording) -> float:
        largest = 0.0
        for name, source in self._live.sources.items():
            data = recording.sources[name]
            if source.effects is None:
                batch = solve(gram_of(recording, name, data), source.array, source.prior, source.noise_rps)
            else:
                batch = white_solution(recording, data, source.effects, source.prior, source.noise_rps)
            x, _ = source.filter.state()
            sd = np.sqrt(np.diagonal(batch.covariance, axis1=1, axis2=2))
            largest = max(largest, float(np.abs((x - batch.x) / sd).max()))
        return largest

    def _abort(self, name: str) -> None:
        if not self._reason:
            self._reason = f"stopped by {name} in phase {self._phase!r}"

    def _end_step(self, label: str, start_ns: int, end_ns: int) -> None:
        self._writer.append_text("steps", {"t_start_ns": start_ns, "t_end_ns": end_ns}, "label", label)

    def _event(self, text: str) -> None:
        now_ns = round(asyncio.get_running_loop().time() * 1e9)
        self._writer.append_text("events", {"t_ns": now_ns}, "text", text)

    def _device_of(self, source: str) -> str:
        return next(imu.config.name for imu in self._open.imus if source in imu.source.names)


def _verdict_of(group: BaseExceptionGroup[BaseException]) -> Verdict:
    """Return the verdict for what ended the tasks: a device's error first, else a defect of the station."""
    errors = list(_leaves(group))
    for error in errors:
        if isinstance(error, DeviceError):
            return Verdict(Outcome.FAULT, str(error))
    first = errors[0]
    if isinstance(first, EstimatorError):
        return Verdict(Outcome.FAULT, str(first))
    _log.error("the run ended by a defect of the station", exc_info=first)
    return Verdict(Outcome.ABORTED, f"defect of the station, please report it: {type(first).__name__}: {first}")


def _leaves(group: BaseExceptionGroup[BaseException]) -> Iterator[BaseException]:
    for error in group.exceptions:
        if isinstance(error, BaseExceptionGroup):
            yield from _leaves(error)
        else:
            yield error


def _attributes(bench: OpenBench, script: Script, seed: int) -> dict[str, Any]:
    config = bench.bench
    attributes: dict[str, Any] = {
        "station": config.name,
        "software_version": importlib.metadata.version("turntable-station"),
        "bench": config.text,
        "bench_sha256": hashlib.sha256(config.text.encode()).hexdigest(),
        "script": script.name,
        "script_steps": [step.label for step in script.steps],
        "devices": [f"{imu.config.name} ({imu.config.protocol}, {imu.config.link})" for imu in bench.imus],
        "seed": seed,
        "outcome": str(Outcome.ABORTED),
        "reason": _UNFINISHED,
    }
    if config.site is not None:
        attributes["site_latitude_rad"] = config.site.latitude_rad
        attributes["site_heading_rad"] = config.site.heading_rad
    return attributes


def _identity(prefix: str, identity: Identity) -> dict[str, Any]:
    """Return as attributes what a device says it is."""
    return {f"{prefix}{key}": value for key, value in asdict(identity).items() if value}


@contextmanager
def _signals(note: Callable[[str], None], work: asyncio.Task[None]) -> Iterator[None]:
    """Let Ctrl-C and the polite signals cancel the work; the stop that follows is not cut short by more of them."""
    loop = asyncio.get_running_loop()
    names = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
    if hasattr(signal, "SIGHUP"):
        names[signal.SIGHUP] = "SIGHUP (the terminal is gone)"

    def handle(number: int, _frame: Any) -> None:
        note(names[signal.Signals(number)])
        loop.call_soon_threadsafe(work.cancel)

    before = {}
    for number in names:
        try:
            before[number] = signal.signal(number, handle)
        except ValueError:  # not the main thread: signals are somebody else's
            break
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)
