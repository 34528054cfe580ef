"""One run from first contact to verdict: everything opened, the script driven, all recorded, the table at rest."""

import asyncio
import hashlib
import importlib.metadata
import logging
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from drivers.errors import DeviceError
from drivers.tables.halting import first_look
from drivers.types import LinkCounts
from estimator.calibration.error_model import ErrorModel
from estimator.calibration.values import Calibration
from estimator.errors import EstimatorError, RecordingError
from estimator.estimation.live.source import model_sha256
from estimator.recordings.recording import IDENTITY
from estimator.recordings.writing import TEXT_BYTES, RecordingWriter, site_attributes, write_attributes
from station.errors import UsageError, sentence
from station.opening import OpenBench
from station.opening.reopening import Reopening
from station.run.acquisition import Acquisition, identity_attributes
from station.run.early_end import EarlyEnd
from station.run.event_loop.loops import is_virtual
from station.run.event_loop.services import leaves, serve
from station.run.event_loop.signals import heeded_signals
from station.run.final_estimate import final_estimate
from station.run.guard.guard import Guard
from station.run.guard.way_out import WayOut
from station.run.manual import ManualSequencer
from station.run.outcome import MANUAL_VERDICT, Outcome, Verdict, judge
from station.run.sequencer import Sequencer
from station.run.snapshot import EventKind, Phase, Snapshot
from station.run.source_report import SourceReport
from station.run.table_watch import TableRow, watch_table
from station.run.uncommanded import UntrueReadings, check_axes, watch_homing
from station.scripts.polling import too_steep
from station.scripts.script import Script

_log = logging.getLogger(__name__)

_STOP_LIMIT_S = 15.0
_MOST_INTERRUPTIONS = 10  # of the way to rest, which is continued after each
_UNFINISHED = "the run did not end: the station stopped without closing the file"
_NOTE = "note: "
_TERMINAL_GONE = "the terminal is gone (SIGHUP): the run continues"


@dataclass(kw_only=True, frozen=True, slots=True)
class Result:
    """The result of a run, and its calibration if there is one."""

    verdict: Verdict
    recording: Path
    calibration: Calibration | None
    agreement: float
    """Largest difference between the live filter and the batch estimate, in sigmas, under the same noise."""
    ended_early: str = ""
    """When and why the script was not run to its end."""
    sources: tuple[SourceReport, ...] = ()
    """What was had of each source."""
    links: Mapping[str, LinkCounts] = field(default_factory=dict)
    """What went over the link of each device."""
    notes: tuple[str, ...] = ()
    """What failed beside the run and did not touch what is measured."""


@dataclass(kw_only=True, frozen=True, slots=True)
class RunOptions:
    """Options of a run.

    ``model``: effects to estimate with the states; it must fit the table. ``operator`` and ``device_serial`` are
    recorded; by default the serial number is that of the device under test. A device with another number ends the run,
    unless ``serial_reason`` explains it. ``outlives_terminal``: SIGHUP does not end the run. ``time_scale`` is how fast
    the loop's clock runs. ``manual``: commands drive the table, and the script is empty.
    """

    reset_fault: bool = False
    end_early: bool = False
    model: ErrorModel | None = None
    operator: str = ""
    device_serial: str = ""
    serial_reason: str = ""
    outlives_terminal: bool = False
    time_scale: float = 1.0
    manual: bool = False


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
        """Create the recording ``path`` and its journal, on a running loop; RecordingError if it exists or cannot be.

        No device is opened. ``on_event(t_s, kind, text)`` is called for every event, at ``t_s`` seconds of the loop's
        clock. ``on_progress`` is called with every row of table readings; its argument is a function that returns a
        brief snapshot. An exception of either is reported once and does not end the run.
        """
        config, time_scale = bench.bench, options.time_scale
        self._model = options.model if options.model is not None and not options.model.is_empty else None
        self._open, self._bench, self._script = bench, config, script
        self._options, self._time_scale = options, max(time_scale, 1.0)  # below 1 devices are slow, too
        self._on_progress = on_progress
        self._reason = ""
        self._running: asyncio.Task[None] | None = None
        self._verdict: Verdict | None = None
        self._connected = self._rested = self._terminal_gone = False
        self._untrue = False  # readings of the table: they do not show whether it stands
        self._reopening = Reopening(self._moving, lambda text: self._event(EventKind.LINK, text), self._time_scale)
        self._acquisition = Acquisition(
            opened=bench,
            writer=RecordingWriter(path, _attributes(bench, script, options), journal=True),
            model=self._model,
            time_scale=time_scale,
            reopening=self._reopening,
            on_event=on_event,
        )
        self._writer, self._event = self._acquisition.writer, self._acquisition.event
        self._live, self._monitor = self._acquisition.live, self._acquisition.monitor
        self._monitor.planned = script.span
        self._way_out = WayOut(bench, self._time_scale, self._event)
        self._guard = Guard(bench.guarded, path, time_scale, self._tell_of_guard)
        self._ended_early = ""
        script_event = partial(self._event, EventKind.SCRIPT)
        self._early_end = EarlyEnd(bench, self._live, time_scale, script_event) if options.end_early else None

    async def run(self) -> Result:
        """Run to the end, bring the table to rest, close the recording and return the result; nothing is raised.

        Whatever interrupts the run, a KeyboardInterrupt, a cancel or an error, becomes its verdict, and the remaining
        steps of the script are skipped; of several the first counts. After ``_MOST_INTERRUPTIONS`` of them, the way out
        included, only the recording is closed; the reason of the verdict then says whether the table may still move.
        Signals that ask for an end call ``stop``.
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
            return self._unended()

    def _unended(self) -> Result:
        """Close the recording of a run whose way out failed or was interrupted too often; return the result so far.

        There is no calibration, and the agreement is NaN. The reason of the verdict, "cancelled" without an earlier
        one, also says whether the table may still move. Outcome and reason are written into the recording; one that
        cannot be closed is ignored.
        """
        verdict = self._verdict or Verdict(Outcome.ABORTED, "cancelled")
        safe = self._rested or not self._connected
        look = sentence("run.unended") if safe else sentence("run.unended_in_motion")
        verdict = replace(verdict, reason=f"{verdict.reason}; {look}")
        with suppress(Exception):  # one of these may be the part that failed
            self._writer.close()
            write_attributes(self._writer.path, {"outcome": str(verdict.outcome), "reason": verdict.reason})
        return Result(
            verdict=verdict,
            recording=self._writer.path,
            calibration=None,
            agreement=float("nan"),
            ended_early=self._ended_early,
        )

    async def _go_through(self) -> Result:
        """Work, make the devices safe, dismiss the guard, conclude; return the result. Errors of each part are raised.

        Called again after an interruption, it cancels the work, waits at most ``_STOP_LIMIT_S`` for its end, and
        continues with the next part; devices that are safe are left alone. A stop that came before the work cancels
        that, too.
        """
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
            self._guard.dismiss()
            self._rested = True
        return await self._conclude()

    def snapshot(self) -> Snapshot:
        """Return the complete state of the run; meant for ten calls a second. An error is reported once, and raised."""
        try:
            return self._monitor.full()
        except Exception as error:
            self._acquisition.task_guard.failed("the snapshot", error)
            raise

    @property
    def gyros(self) -> tuple[str, ...]:
        """Names of the gyros, as snapshots have them."""
        return tuple(name for source in self._live.sources.values() for name in source.array.names)

    def stop(self, who: str = "the operator") -> None:
        """Have the table brought to rest by a controlled stop and the run ended, in any phase; return at once."""
        if not self._reason:
            self._reason = self._stopped_by(who)
        if self._running is not None:
            self._running.cancel()

    def pause(self) -> None:
        """Pause after the current step; UsageError if there is nothing to pause."""
        self._script_under_way().pause()

    def resume(self) -> None:
        """Go on after a pause, or take it back; UsageError if there is none."""
        self._script_under_way().resume()

    def drive(self, action: str, given: Mapping[str, Any]) -> None:
        """Have a word of manual mode obeyed; UsageError if it cannot be, or not now."""
        self._script_under_way().obey(action, given)

    def note(self, text: str) -> None:
        """Add a note of the operator to the recording; UsageError if it is empty, too long, or the recording is closed.

        A run of white space becomes one space; control characters are dropped. The length limit is one of UTF-8 bytes.
        """
        kept = "".join(c for c in " ".join(text.split()) if c.isprintable())
        size, most = len(kept.encode()), TEXT_BYTES - len(_NOTE)
        if not kept or size > most:
            raise UsageError(f"a note has 1 to {most} bytes, but this one has {size}")
        if self._acquisition.closed:
            raise UsageError("the recording is closed already: the note was not saved")
        self._event(EventKind.NOTE, _NOTE + kept)

    def _stopped_by(self, who: str) -> str:
        monitor = self._monitor
        return f"stopped by {who} in {f'step {monitor.label!r}' if monitor.label else f'phase {monitor.phase.value!r}'}"

    def _script_under_way(self) -> Sequencer:
        """Return the sequencer; UsageError if there is no script under way."""
        if self._monitor.sequencer is None:
            raise UsageError("the script has not begun")
        if self._monitor.phase is not Phase.RUNNING:
            raise UsageError("the script has ended")
        return self._monitor.sequencer

    async def _work(self) -> None:
        """Open and ready all devices, run the script while services record and watch, then end the services.

        The table is opened last, its fault reset if asked for, and homed before the script. In manual mode commands
        take the place of the script; an early end may break it off with the table still turning. Any error of a device
        or service ends the work, in an exception group; stopping the table is left to the caller.
        """
        table = self._open.table
        axes = self._bench.table.gimbals
        monitor, acquisition = self._monitor, self._acquisition
        async with asyncio.TaskGroup() as group:
            self._guard.start()
            services = [serve(group, acquisition.keep_flushing()), serve(group, acquisition.keep_estimating())]
            for imu in self._open.imus:
                self._check_serial(imu.config.name, (await acquisition.open(imu)).serial)
                services.append(serve(group, acquisition.acquire(imu)))
            await acquisition.open_others()
            await table.open()  # the last: missing devices are known before the table is touched
            await first_look(table, take_over=self._options.reset_fault)
            self._connected = True  # from here on it is ours to stop
            await self._guard.arm()
            services.append(serve(group, self._guard.watch()))
            self._writer.set_attributes(identity_attributes("table_", await self._reopening.identify("table", table)))
            await acquisition.first_samples()
            services.append(serve(group, acquisition.watch_silence()))
            if self._options.reset_fault:
                await table.reset_fault()
            services += [serve(group, acquisition.follow(device)) for device in acquisition.appending()]
            if await acquisition.prepare_others():  # which may have taken hours
                await first_look(table, take_over=False)
            watch_home = serve(group, watch_homing(table))
            monitor.phase = Phase.ENABLING
            await table.enable()
            monitor.phase = Phase.HOMING
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
            end_step, scale = acquisition.end_step, self._options.time_scale
            sequencer = monitor.sequencer = Sequencer(table, self._script, end_step, tell, monitor.newest)
            if self._options.manual:
                sequencer = monitor.sequencer = ManualSequencer(table, end_step, tell, scale)
            monitor.phase = Phase.RUNNING
            rate_hz, restore = self._bench.table.poll_rate_hz, partial(self._reopening.restore, "table", table)
            services.append(serve(group, watch_table(table, axes, rate_hz, sequencer, self._take_row, restore)))
            tell("manual mode begins" if self._options.manual else "script begins")
            if self._early_end is None:
                await sequencer.run()
            else:
                await self._run_until_enough(group, sequencer, self._early_end)
            monitor.phase = Phase.STOPPING
            for service in services:
                service.cancel()

    def _check_serial(self, device: str, serial: str) -> None:
        """Record ``serial``, which the only device under test has told, if no serial number or another one was stated.

        DeviceError if another one was stated without a reason; with a reason both are recorded. Nothing is done if
        ``serial`` is empty, is the stated one, or there are several devices.
        """
        options, attributes = self._options, {}
        if not serial or len(self._open.imus) != 1:
            return
        if not options.device_serial:
            attributes = {"device_serial": serial}
        elif serial != options.device_serial:
            if not options.serial_reason:
                raise DeviceError(device, sentence("run.other_serial", told=serial, meant=options.device_serial))
            attributes = {"device_serial_told": serial, "serial_reason": options.serial_reason}
        self._writer.set_attributes(attributes)

    def _take_row(self, row: TableRow) -> None:
        self._acquisition.take_row(row)
        self._acquisition.task_guard.attempt("progress", lambda: self._on_progress(self._monitor.brief), None)

    async def _run_until_enough(self, group: asyncio.TaskGroup, sequencer: Sequencer, early_end: EarlyEnd) -> None:
        """Run the script to its end, or until ``early_end`` has seen enough; the table may then still turn.

        A pause under way is waited out before the script is broken off, which is recorded as an event and set as
        ``_ended_early``. An error of the script or of ``early_end`` ends all tasks of ``group``, which raises it.
        """

        async def enough_seen() -> str:
            reason = await early_end.wait()
            await sequencer.going_on()
            return reason

        script, enough = group.create_task(sequencer.run()), group.create_task(enough_seen())
        await asyncio.wait((script, enough), return_when=asyncio.FIRST_COMPLETED)
        if not script.done() and enough.done() and not enough.cancelled() and enough.exception() is None:
            now_s = asyncio.get_running_loop().time()
            where = sequencer.where(now_s)
            self._ended_early = f"{where}: {enough.result()}"
            self._event(EventKind.SCRIPT, f"ended early {where}: the required sigmas are reached")
        script.cancel()
        enough.cancel()

    def _moving(self) -> bool:
        """Return whether an axis is driven: then a lost link ends the run."""
        return self._monitor.sequencer is not None and self._monitor.sequencer.driven_axis is not None

    async def _rest(self) -> None:
        """Set the phase to STOPPING and make all devices safe, the table first; none if the table was never connected.

        Troubles become part of the verdict's reason; without a verdict the first makes it FAULT. An exception of the
        table's driver is raised; devices after it are then left for another call.
        """
        self._monitor.phase = Phase.STOPPING
        if not self._connected:
            return
        for trouble in await self._way_out.go(untrue_readings=bool(self._untrue)):
            verdict = self._verdict or Verdict(Outcome.FAULT, trouble)
            self._verdict = replace(verdict, reason="; ".join(dict.fromkeys((verdict.reason, trouble))))

    def _tell_of_guard(self, text: str) -> None:
        _log.warning("station: %s", text)
        self._event(EventKind.NOTE, text)

    async def _conclude(self) -> Result:
        """Close table and recording, calibrate a run without a verdict, judge it, store the outcome, return the result.

        A run by hand is judged MANUAL and not calibrated; one that cannot be calibrated is a FAIL. Then, and after any
        earlier verdict, there is no calibration and the agreement is NaN. The result also has the reports of sources,
        the counts of links and notes on work that failed. Doubts on reopened devices, and that the outcome cannot be
        stored, become parts of the reason. Errors of closing are raised; a recording that is closed is not closed
        again.
        """
        acquisition = self._acquisition
        if not acquisition.closed:
            self._open.table.close()
            attributes = {"ended_early": self._ended_early} if self._ended_early else {}
            await acquisition.close(attributes, undisturbed=self._verdict is None)
        calibration, agreement = None, float("nan")
        verdict = self._verdict or (MANUAL_VERDICT if self._options.manual else None)
        if verdict is None:
            self._monitor.phase = Phase.ESTIMATING
            try:
                # In a thread, so that the session does not seem to hang.
                about = (self._writer.path, self._live, self._model, self._bench.excluded, dict(acquisition.reports))
                work = partial(final_estimate, *about)
                found = await asyncio.get_running_loop().run_in_executor(None, work)
                calibration, agreement, acquisition.reports = found
                verdict = judge(calibration, self._bench.limits, acquisition.causes())
                doubts = self._reopening.doubts()
                reason, because = "; but ".join((verdict.reason, *doubts)), (*verdict.because, *doubts)
                verdict = replace(verdict, reason=reason, because=because)
            except EstimatorError as error:
                verdict = Verdict(Outcome.FAIL, str(error))
        try:
            write_attributes(self._writer.path, {"outcome": str(verdict.outcome), "reason": verdict.reason})
            loop = asyncio.get_running_loop()
            await loop.run_in_executor(None, partial(self._writer.finish, synced=not is_virtual(loop)))
        except RecordingError as error:
            verdict = replace(verdict, reason=f"{verdict.reason}; the recording lacks the outcome: {error}")
        reports = tuple(acquisition.reports.values())
        links, notes = self._monitor.link_counts(), tuple(acquisition.task_guard.notes)
        return Result(
            verdict=verdict,
            recording=self._writer.path,
            calibration=calibration,
            agreement=agreement,
            ended_early=self._ended_early,
            sources=reports,
            links=links,
            notes=notes,
        )

    def _verdict_of(self, error: BaseException) -> Verdict:
        """Return the verdict for an error or a group of errors: FAULT by a device or the estimator, else ABORTED.

        The first error of a device in a group goes before all others, else the first of all counts. The reason of a
        lost link or a late arrival may be that this computer was too slow. ABORTED are a stop, a failure of this
        computer and a defect of the station. A fault of the table is set as the state that the monitor shows, and
        untrue readings are remembered.
        """
        errors = list(leaves(error))
        for device_error in errors:
            if isinstance(device_error, DeviceError):
                self._untrue |= isinstance(device_error, UntrueReadings)
                fault = self._acquisition.blamed(device_error)
                if fault.device == "table":
                    self._monitor.table_fault = fault.message
                return Verdict(Outcome.FAULT, str(fault))
        first = errors[0]
        if isinstance(first, EstimatorError):
            return Verdict(Outcome.FAULT, str(first))
        if isinstance(first, KeyboardInterrupt):
            return Verdict(Outcome.ABORTED, self._reason or self._stopped_by("Ctrl-C"))
        if isinstance(first, asyncio.CancelledError):
            return Verdict(Outcome.ABORTED, self._reason or "cancelled")
        _log.debug("the run ended by what no device did", exc_info=first)
        reason = f"{type(first).__name__}: {first}"
        if isinstance(first, MemoryError | OSError):
            need = "more memory" if isinstance(first, MemoryError) else "its disk and its ports checked"
            return Verdict(Outcome.ABORTED, f"this computer failed and needs {need} ({reason})")
        at = traceback.extract_tb(first.__traceback__)[-1:]
        where = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in at)
        return Verdict(Outcome.ABORTED, f"defect of the station, please report it: {reason}{where}")

    def _outlive(self) -> None:
        if not self._terminal_gone and not self._acquisition.closed:
            self._terminal_gone = True
            self._event(EventKind.TERMINAL, _TERMINAL_GONE)


def _attributes(bench: OpenBench, script: Script, options: RunOptions) -> dict[str, Any]:
    """Return the attributes of the recording: station, software, bench, script, devices, table link, site, seed,
    operator, serial number, plug-ins, model, clock.

    Operator, serial number, plug-ins and model are left out if empty, and the site if there is none. The outcome is
    ABORTED so far. In virtual time an identity made of all that takes the place of the clock, so that equal runs are
    equal.
    """
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
    if config.site is not None:
        attributes |= site_attributes(config.site)
    found: dict[str, Any] = {"operator": options.operator, "device_serial": options.device_serial}
    found |= {"plugins": sorted({*config.plugins, *script.plugins}), "model_sha256": model_sha256(options.model)}
    attributes |= {key: value for key, value in found.items() if value}
    loop = asyncio.get_running_loop()
    if is_virtual(loop):  # runs that begin alike are alike, to the last byte; a simulated clock has no place in the day
        begun = repr((attributes, script, options.reset_fault, options.end_early))
        return attributes | {IDENTITY: hashlib.sha256(begun.encode()).hexdigest()[:32]}
    zero_utc_s = time.time() - loop.time() / options.time_scale
    return attributes | {"clock_zero_utc_s": zero_utc_s, "time_scale": options.time_scale}
