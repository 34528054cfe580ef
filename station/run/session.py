"""One run from first contact to verdict: everything opened, the script driven, all recorded, the table at rest."""

from __future__ import annotations

import asyncio
import hashlib
import importlib.metadata
import logging
import os
import time
import traceback
from collections.abc import Callable, Coroutine, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from drivers.errors import DeviceError, LinkLost
from drivers.tables.halting import first_look
from drivers.types import Floats, Identity, ImuBlock
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError
from estimator.estimation.sample_columns import SampleColumns
from estimator.recordings.writing import TEXT_BYTES, RecordingWriter, write_attributes
from station.errors import UsageError
from station.opening import OpenBench, OpenImu
from station.opening.reopening import Reopening
from station.run.early_end import EarlyEnd
from station.run.event_loop.loops import is_virtual
from station.run.event_loop.signals import heeded_signals
from station.run.final_estimate import final_estimate
from station.run.live import LiveEstimate, LiveSource
from station.run.monitor import Monitor
from station.run.outcome import Outcome, Verdict, judge
from station.run.sequencer import Sequencer
from station.run.snapshot import EventKind, Phase, Snapshot
from station.run.sources import SourceReport
from station.run.table_watch import TableRow, check_axes, watch_table
from station.run.uncommanded import MotionGuard, watch_homing
from station.scripts.polling import too_steep
from station.scripts.script import Script

_log = logging.getLogger(__name__)

_FLUSH_S = 0.2  # what a killed station loses, at most, beyond what was on its way
_FLUSH_SIMULATED_S = 2.0  # a simulated second lasts milliseconds
_SYNC_S = 0.5
_SLOW_S = 0.02  # of the table, after which its answers may be why a run fails
_LATE_S = 0.03  # of the host, after which a computer may be why a run fails
_FIRST_SAMPLE_S = 3.0
_SILENCE_S = 1.0
_STOP_LIMIT_S = 15.0
_MOST_INTERRUPTIONS = 10  # of the way out, which is gone again after each
_UNFINISHED = "the run did not end: the station died without closing the file"
_NOTE = "note: "
_TERMINAL_GONE = "the terminal is gone (SIGHUP): the run goes on"


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


@dataclass(frozen=True, slots=True)
class RunOptions:
    """How a run is made.

    ``model``: effects to estimate beside the states; it must fit the table. ``operator`` and ``device_serial`` are
    recorded; without the latter, what the device under test says if there is one. ``outlives_terminal``: SIGHUP does
    not end the run. ``time_scale`` is how fast the loop's clock runs.
    """

    reset_fault: bool = False
    end_early: bool = False
    model: ErrorModel | None = None
    operator: str = ""
    device_serial: str = ""
    outlives_terminal: bool = False
    time_scale: float = 1.0


class Session:
    """Runs one script on one open bench into one recording."""

    def __init__(
        self,
        bench: OpenBench,
        script: Script,
        path: Path,
        options: RunOptions = RunOptions(),
        *,
        on_progress: Callable[[Callable[[], Snapshot]], None] = lambda look: None,
        on_event: Callable[[float, EventKind, str], None] | None = None,
    ) -> None:
        """Create the recording; nothing is opened yet. RecordingError if the file cannot be created.

        ``on_event(t_s, kind, text)`` is told of every event.
        """
        config, time_scale = bench.bench, options.time_scale
        self._model = options.model if options.model is not None and options.model.effects else None
        self._open, self._bench, self._script = bench, config, script
        self._options, self._time_scale = options, max(time_scale, 1.0)  # below 1 devices are slow, too
        self._on_progress, self._on_event = on_progress, on_event
        self._phase = Phase.CONNECTING
        self._reason = ""
        self._running: asyncio.Task[None] | None = None
        self._verdict: Verdict | None = None
        self._rested = self._closed = False
        self._terminal_gone = False
        self._sequencer: Sequencer | None = None
        self._last_seen_s: dict[str, float] = {}
        self._reports: dict[str, SourceReport] = {}
        self._reopening = Reopening(self._moving, partial(self._event, EventKind.LINK), self._time_scale)
        self._half_width_ns, self._rate_window_ns, self._late_s, self._late_at_s = 0, 0, 0.0, -np.inf
        self._connected = False
        self._sync: asyncio.Future[Any] | None = None
        self._live = LiveEstimate(config.table.gimbals, config.site)
        told = {"operator": options.operator, "device_serial": options.device_serial}
        self._writer = RecordingWriter(path, _attributes(bench, script) | {k: v for k, v in told.items() if v})
        loop = asyncio.get_running_loop()
        if not is_virtual(loop):  # a simulated clock has no place in the day
            zero_utc_s = time.time() - loop.time() / time_scale
            self._writer.set_attributes({"clock_zero_utc_s": zero_utc_s, "time_scale": time_scale})
        self._writer.add_table(config.table.gimbals, config.table.uncertainty)
        for imu in bench.imus:
            self._add_sources(imu)
        self._ended_early = ""
        self._monitor = Monitor(bench, self._live, self._reopening, self._time_scale)
        self._early_end: EarlyEnd | None = None
        if options.end_early:
            configs = {name: imu.config for imu in bench.imus for name in imu.source.names}
            self._early_end = EarlyEnd(config, configs, self._live, time_scale)

    async def run(self) -> Result:
        """Run to the end. Whatever is raised on the way, the table is brought to rest and the recording is closed.

        What interrupts it, a KeyboardInterrupt or a cancel as well as an error, is its verdict, and what is left of the
        way is gone then.
        """
        this = asyncio.current_task()
        with heeded_signals(self.stop, self._outlive if self._options.outlives_terminal else None):
            for _ in range(_MOST_INTERRUPTIONS):
                try:
                    return await self._go_through()
                except BaseException as error:
                    self._verdict = self._verdict or self._verdict_of(error)
                    if this is not None and isinstance(error, asyncio.CancelledError):
                        this.uncancel()
            raise RuntimeError(f"the run could not be ended: {self._verdict}")

    async def _go_through(self) -> Result:
        """Work, bring the table to rest, conclude: from where an interruption left it."""
        if self._running is None:
            self._running = asyncio.get_running_loop().create_task(self._work())
            if self._reason:
                self._running.cancel()
            await self._running
        elif not self._running.done():
            self._running.cancel()
            await asyncio.wait({self._running}, timeout=_STOP_LIMIT_S * self._time_scale)
        if not self._rested:
            await self._rest()
            self._rested = True
        return await self._conclude()

    def snapshot(self) -> Snapshot:
        """Return the state of the run now, as a whole: for ten looks a second, not for each row."""
        return self._monitor.full(self._phase, self._times_s(), self._sequencer)

    @property
    def gyros(self) -> tuple[str, ...]:
        """Names of the gyros, as snapshots have them."""
        return self._monitor.gyros

    def stop(self, who: str = "the operator") -> None:
        """Bring the table to rest by a controlled stop and end the run, in whatever phase it is."""
        if not self._reason:
            self._reason = self._stopped_by(who)
        if self._running is not None:
            self._running.cancel()

    def pause(self) -> None:
        """Hold after the step under way; UsageError where there is nothing to pause."""
        self._script_under_way().pause()

    def resume(self) -> None:
        """Go on after a pause, or take it back; UsageError if there is none."""
        self._script_under_way().resume()

    def note(self, text: str) -> None:
        """Keep a note of the operator in the record; UsageError if it is empty, too long, or too late.

        Control characters are dropped, line ends become spaces.
        """
        kept = "".join(c for c in " ".join(text.split()) if c.isprintable())
        size, most = len(kept.encode()), TEXT_BYTES - len(_NOTE)
        if not kept or size > most:
            raise UsageError(f"a note can have 1 to {most} bytes, this one has {size}")
        if self._closed:
            raise UsageError("the recording is closed: the note was not kept")
        self._event(EventKind.NOTE, _NOTE + kept)

    def _stopped_by(self, who: str) -> str:
        label = self._brief().label
        return f"stopped by {who} in {f'step {label!r}' if label else f'phase {self._phase.value!r}'}"

    def _script_under_way(self) -> Sequencer:
        """Return the sequencer; UsageError if there is no script under way."""
        if self._sequencer is None:
            raise UsageError("the script has not begun")
        if self._phase is not Phase.RUNNING:
            raise UsageError("the script has ended")
        return self._sequencer

    def _brief(self) -> Snapshot:
        return self._monitor.brief(self._phase, self._times_s(), self._sequencer)

    def _times_s(self) -> tuple[float, float]:
        """Return time done and time remaining by plan."""
        if self._sequencer is None:
            return 0.0, self._script.duration_s
        return self._sequencer.times_s(asyncio.get_running_loop().time())

    def _add_sources(self, imu: OpenImu) -> None:
        config = imu.config
        noise_rps = config.noise.arw * np.sqrt(config.rate_hz)
        for name, gyros in config.gyros_of(imu.source.names).items():
            array = config.array.select(gyros)
            noise = [config.noise.arw, config.noise.instability, config.noise.walk]
            about = {"device": config.name, "rate_hz": config.rate_hz, "lost": 0, "noise": noise}
            self._writer.add_source(name, array, config.prior, about)
            effects = None
            if self._model is not None:
                effects = SampleColumns(self._model, self._bench.table.gimbals, self._bench.site, array)
            stated = self._bench.table.uncertainty
            timing_s = stated.timing_s if stated else 0.0
            own = (array, config.rate_hz, float(noise_rps), config.prior, effects, timing_s)
            self._live.sources[name] = LiveSource(*own)

    async def _work(self) -> None:
        table = self._open.table
        axes = self._bench.table.gimbals
        async with asyncio.TaskGroup() as group:
            services = [self._serve(group, self._keep_flushing())]
            for imu in self._open.imus:
                await imu.source.open()
                identity = await imu.source.identify()
                for name in imu.source.names:
                    self._writer.set_source(name, _identity("", identity))
                if identity.serial and not self._options.device_serial and len(self._open.imus) == 1:
                    self._writer.set_attributes({"device_serial": identity.serial})
                services.append(self._serve(group, self._acquire(imu)))
            await table.open()  # the last: what is not there is known before the table is touched
            await first_look(table, take_over=self._options.reset_fault)
            self._connected = True  # from here on it is ours to stop
            self._writer.set_attributes(_identity("table_", await table.identify()))
            await self._first_samples()
            services.append(self._serve(group, self._watch_silence()))
            if self._options.reset_fault:
                await table.reset_fault()
            watch_home = self._serve(group, watch_homing(table))
            self._phase = Phase.ENABLING
            await table.enable()
            self._phase = Phase.HOMING
            await table.home()
            watch_home.cancel()
            await check_axes(table, axes)
            loop = asyncio.get_running_loop()
            began_s = loop.time()
            for axis in axes:
                await table.read(axis)
            tell = partial(self._event, EventKind.SCRIPT)
            for text in too_steep(self._script, (loop.time() - began_s) / len(axes)):
                self._event(EventKind.NOTE, text)
            sequencer = self._sequencer = Sequencer(table, self._script, self._end_step, tell)
            self._phase = Phase.RUNNING
            watch = watch_table(
                table,
                axes,
                lambda: max(self._bench.table.poll_rate_hz, sequencer.wanted_hz(loop.time())),
                lambda: sequencer.driven_axis,
                MotionGuard(table, sequencer.commanded),
                self._take_row,
                lambda error: self._reopening.restore(table, error),
            )
            services.append(self._serve(group, watch))
            tell("script begins")
            if self._early_end is None:
                await sequencer.run()
            else:
                await self._run_until_enough(group, sequencer, self._early_end)
            self._phase = Phase.STOPPING
            for service in services:
                service.cancel()

    @staticmethod
    def _serve(group: asyncio.TaskGroup, service: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Begin what goes on all the run; a task group takes a cancel that nobody asked for as a good end of it."""

        async def serve() -> None:
            task = asyncio.current_task()
            try:
                await service
            except asyncio.CancelledError:
                if task is not None and task.cancelling():
                    raise
            raise RuntimeError(f"{name} has ended by itself")

        name = getattr(service, "__qualname__", "a service")
        return group.create_task(serve())

    async def _run_until_enough(self, group: asyncio.TaskGroup, sequencer: Sequencer, early_end: EarlyEnd) -> None:
        """Run the script to its end, or until enough has been seen: the table is then still to be stopped."""

        async def enough_seen() -> str:
            reason = await early_end.wait()
            await sequencer.going_on()
            return reason

        script, enough = group.create_task(sequencer.run()), group.create_task(enough_seen())
        await asyncio.wait((script, enough), return_when=asyncio.FIRST_COMPLETED)
        if not script.done() and enough.done() and not enough.cancelled() and enough.exception() is None:
            now_s = asyncio.get_running_loop().time()
            done_s, left_s = sequencer.times_s(now_s)
            where = f"after {done_s:.1f} s of {done_s + left_s:.1f} s, in step {sequencer.label!r}"
            self._ended_early = f"{where}: {enough.result()}"
            self._event(EventKind.SCRIPT, f"ended early {where}: enough seen")
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
        self._monitor.take_block(name, block)
        keys = ("t_ns", "arrival_ns", "rate_rps", "temperature_c", "counter")
        columns = {key: values for key in keys if (values := getattr(block, key)) is not None}
        if block.accel_mps2 is not None:
            columns["accel_mps2"] = self._in_body_axes(name, block.accel_mps2)
        self._writer.append_rows(f"imu/{name}", columns)
        self._live.sources[name].add(block)

    def _in_body_axes(self, name: str, accel_mps2: Floats) -> Floats:
        """Return specific force (n, 3) along the body's axes; a device tells it along those of its three gyros."""
        p = self._live.sources[name].array.p
        return np.asarray(np.linalg.solve(p, accel_mps2.T).T) if p.shape == (3, 3) else accel_mps2

    def _take_row(self, row: TableRow) -> None:
        columns = row._asdict()
        if columns.pop("rate_window_ns") != self._rate_window_ns:
            table, self._rate_window_ns = self._bench.table, row.rate_window_ns
            self._writer.add_table(table.gimbals, table.uncertainty, row.rate_window_ns)
        self._writer.append_rows("table", {key: np.array([value]) for key, value in columns.items()})
        self._half_width_ns = max(self._half_width_ns, row.half_width_ns)
        self._live.add_row(row)
        self._monitor.take_row(row)
        self._on_progress(self._brief)

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
            await self._sleep(limit_s / 4)
            now = asyncio.get_running_loop().time()
            silent = [
                name
                for name, seen in self._last_seen_s.items()
                if now - seen > limit_s and self._device_of(name) not in self._reopening.under_way
            ]
            if silent:
                late = f"; {self._late}" * (self._late_at_s > min(self._last_seen_s[name] for name in silent))
                raise LinkLost(self._device_of(silent[0]), f"{', '.join(silent)} fell silent for {limit_s:g} s{late}")

    async def _sleep(self, time_s: float) -> None:
        """Sleep, and keep by how much the computer was late with that (s of the host), and when it was last."""
        loop = asyncio.get_running_loop()
        due_s = loop.time() + time_s
        await asyncio.sleep(time_s)
        late_s = (loop.time() - due_s) / self._options.time_scale
        if late_s > _LATE_S:
            self._late_s, self._late_at_s = max(self._late_s, late_s), loop.time()

    async def _keep_flushing(self) -> None:
        """Hand rows to the operating system five times a second, and have it write them out twice a second.

        By the host's time, however fast the loop's clock runs: it is the host that may die. A simulated run needs no
        protection from a power cut and is flushed less often.
        """
        loop = asyncio.get_running_loop()
        sync_due_s = loop.time()
        every_s = _FLUSH_SIMULATED_S if is_virtual(loop) else _FLUSH_S * self._options.time_scale
        while True:
            await self._sleep(every_s)
            self._monitor.mark()
            if self._sync is not None and not self._sync.done():
                continue  # a write now would wait for the disk, and everything for that write
            self._writer.flush()
            if not is_virtual(loop) and loop.time() >= sync_due_s:
                sync_due_s = loop.time() + _SYNC_S * self._options.time_scale
                self._sync = loop.run_in_executor(None, os.fsync, self._writer.descriptor)

    async def _rest(self) -> None:
        """Bring the table to rest; what goes wrong with that is part of the verdict."""
        self._phase = Phase.STOPPING
        if not self._connected:
            return
        trouble = await self._tried(self._open.table.stop(), None)
        if trouble:
            self._event(EventKind.NOT_AT_REST, f"controlled stop not confirmed: {trouble}")
            aborted = await self._tried(self._open.table.abort(), None)  # as hard as the controller can
            trouble = f"it did not come to rest by a controlled stop ({trouble})"
            if aborted:
                trouble = f"the table was not seen to come to rest ({aborted}): use the emergency stop"
        off = await self._tried(self._open.table.disable())  # also what heeds nothing else: it may then coast
        if not trouble or not aborted:
            trouble = trouble or (off and f"the table is at rest, but its power may be on ({off})")
            self._event(EventKind.AT_REST, "table at rest")
        if trouble:
            verdict = self._verdict or Verdict(Outcome.FAULT, trouble)
            self._verdict = replace(verdict, reason="; ".join(dict.fromkeys((verdict.reason, trouble))))

    async def _tried(self, what: Coroutine[Any, Any, object], limit_s: float | None = _STOP_LIMIT_S) -> str:
        """Do what ends a motion; return in words what went wrong. What watches axes slow down ends by itself."""
        try:
            async with asyncio.timeout(limit_s and limit_s * self._time_scale):
                await what
        except (DeviceError, TimeoutError) as error:
            return str(error) or "no answer in time"
        return ""

    async def _conclude(self) -> Result:
        if not self._closed:
            await self._close()
        calibration, agreement = None, float("nan")
        verdict = self._verdict
        if verdict is None:
            self._phase = Phase.ESTIMATING
            try:
                self._live.finish()
                # In a thread: who looks on is not to think that the session hangs.
                about = (self._writer.path, self._live, self._model, self._bench.excluded, dict(self._reports))
                work = partial(final_estimate, *about)
                calibration, agreement, self._reports = await asyncio.get_running_loop().run_in_executor(None, work)
                verdict = judge(calibration, self._bench.limits, self._causes())
            except EstimatorError as error:
                verdict = Verdict(Outcome.FAIL, str(error))
        try:
            write_attributes(self._writer.path, {"outcome": str(verdict.outcome), "reason": verdict.reason})
        except RecordingError as error:
            verdict = replace(verdict, reason=f"{verdict.reason}; the outcome is not in the recording: {error}")
        reports = tuple(self._reports.values())
        return Result(verdict, self._writer.path, calibration, agreement, self._ended_early, reports)

    @property
    def _late(self) -> str:
        return f"this computer did not keep up: the run waited for it for up to {self._late_s * 1e3:.0f} ms"

    def _causes(self) -> list[str]:
        """Return what may have made a run fail beside its gyros: samples at other instants, a late computer."""
        took_s = 2e-9 * self._half_width_ns
        slow = f"the table took up to {took_s * 1e3:.0f} ms to answer: when it was where is known no better"
        found = [report.mistimed for report in self._reports.values()]
        found += [slow] * (took_s > _SLOW_S) + [self._late] * (self._late_s > 0.0)
        return [cause for cause in found if cause]

    async def _close(self) -> None:
        """Close all links, and the recording."""
        self._monitor.end()
        self._open.table.close()
        for imu in self._open.imus:
            imu.source.close()
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
        self._closed = True

    def _end_step(self, label: str, start_ns: int, end_ns: int) -> None:
        self._writer.append_text("steps", {"t_start_ns": start_ns, "t_end_ns": end_ns}, "label", label)

    def _event(self, kind: EventKind, text: str) -> None:
        now_ns = round(asyncio.get_running_loop().time() * 1e9)
        self._writer.append_text("events", {"t_ns": now_ns}, "text", text, kind=np.array([kind.encode()], dtype="S16"))
        if self._on_event is not None:
            self._on_event(now_ns * 1e-9, kind, text)

    def _device_of(self, source: str) -> str:
        return next(imu.config.name for imu in self._open.imus if source in imu.source.names)

    def _verdict_of(self, error: BaseException) -> Verdict:
        """Return the verdict for what ended the run: a device's error first, a stop, else a defect of the station."""
        errors = list(_leaves(error))
        for device_error in errors:
            if isinstance(device_error, DeviceError):
                if device_error.device == "table":
                    self._monitor.table_fault = device_error.message
                return Verdict(Outcome.FAULT, str(device_error))
        first = errors[0]
        if isinstance(first, EstimatorError):
            return Verdict(Outcome.FAULT, str(first))
        if isinstance(first, KeyboardInterrupt):
            return Verdict(Outcome.ABORTED, self._reason or self._stopped_by("Ctrl-C"))
        if isinstance(first, asyncio.CancelledError):
            return Verdict(Outcome.ABORTED, self._reason or "cancelled")
        _log.debug("the run ended by a defect of the station", exc_info=first)
        at = traceback.extract_tb(first.__traceback__)[-1:]
        where = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in at)
        what = f"defect of the station, please report it: {type(first).__name__}: {first}{where}"
        return Verdict(Outcome.ABORTED, what)

    def _outlive(self) -> None:
        if not self._terminal_gone and not self._closed:
            self._terminal_gone = True
            self._event(EventKind.TERMINAL, _TERMINAL_GONE)


def _leaves(error: BaseException) -> Iterator[BaseException]:
    """Yield what is in groups, and what a cancel was for."""
    if isinstance(error, BaseExceptionGroup):
        for one in error.exceptions:
            yield from _leaves(one)
    elif isinstance(error, asyncio.CancelledError) and error.args and isinstance(error.args[0], BaseException):
        yield from _leaves(error.args[0])
    else:
        yield error


def _attributes(bench: OpenBench, script: Script) -> dict[str, Any]:
    config = bench.bench
    links = [axis.link or config.table.link for axis in config.table.axes.values()]
    attributes: dict[str, Any] = {
        "station": config.station,
        "software_version": importlib.metadata.version("turntable-station"),
        "bench": config.text,
        "bench_sha256": hashlib.sha256(config.text.encode()).hexdigest(),
        "script": script.name,
        "script_steps": [step.label for step in script.steps],
        "devices": [f"{imu.config.name} ({imu.config.protocol}, {imu.config.link})" for imu in bench.imus],
        "table_link": f"{config.table.protocol}, {', '.join(dict.fromkeys(links))}",
        "seed": config.twin.seed,
        "outcome": str(Outcome.ABORTED),
        "reason": _UNFINISHED,
    }
    if config.plugins:
        attributes["plugins"] = list(config.plugins)
    if config.site is not None:
        attributes["site_latitude_rad"] = config.site.latitude_rad
        attributes["site_heading_rad"] = config.site.heading_rad
    return attributes


def _identity(prefix: str, identity: Identity) -> dict[str, Any]:
    """Return as attributes what a device says it is."""
    return {f"{prefix}{key}": value for key, value in asdict(identity).items() if value}
