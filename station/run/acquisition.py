"""Data of the devices of a run: written to the recording, passed to live filters and to the monitor."""

import asyncio
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, astuple
from typing import Any

import numpy as np

from drivers.errors import DeviceError, DeviceFault, DeviceRefused, LinkLost
from drivers.protocols import AppendsSeries, EarlySource
from drivers.types import Identity, ImuBlock, LinkCounts
from estimator.calibration.error_model import ErrorModel
from estimator.errors import EstimatorError
from estimator.estimation.live.sample_columns import SampleColumns
from estimator.estimation.live.source import LiveSource
from estimator.geometry.array import accelerometer_axes
from estimator.recordings.recording import DEVICES
from estimator.recordings.writing import RecordingWriter
from station.bench.imu import ImuConfig
from station.errors import sentence
from station.opening import OpenBench, OpenDevice, OpenImu
from station.opening.links import ends_here
from station.opening.reopening import Reopening
from station.run.event_loop.host import HostWatch
from station.run.event_loop.loops import is_virtual
from station.run.live import LiveEstimate
from station.run.monitor import Monitor, TaskGuard
from station.run.snapshot import EventKind, Phase
from station.run.source_report import SourceReport
from station.run.table_watch import TableRow

_JOURNAL_S = 0.006  # the most that a killed station loses, besides data on their way
_LOOK_S = 0.2  # between readings of counts, which go into the journal
_FLUSH_S = 2.0
_HISTORY_BLOCKS = 50  # of the live filter, which are written together
_SLOW_S = 0.02  # of the table, after which its answers may be why a run fails
_FIRST_SAMPLE_S = 3.0
_SILENCE_S = 1.0
_LOST_WHILE_READIED = 5  # times that a link may be lost while its device is readied


class Acquisition:
    """The recording of one run, and all that is written into it until it is closed."""

    def __init__(
        self,
        *,
        opened: OpenBench,
        writer: RecordingWriter,
        model: ErrorModel | None,
        time_scale: float,
        reopening: Reopening,
        on_event: Callable[[float, EventKind, str], None] | None,
    ) -> None:
        """Describe table and devices under test in the file of ``writer``; no device is opened.

        ``model`` is for the live estimate; ``time_scale`` is how fast the loop's clock runs; ``reopening`` opens lost
        devices anew. ``on_event(t_s, kind, text)`` gets every event, at ``t_s`` seconds of the loop's clock.
        """
        self._imus, self._others, self._bench = opened.imus, opened.others, opened.bench
        self._devices = tuple(opened.devices.values())
        self._restoring: defaultdict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._described: set[str] = set()  # devices of other kinds that the recording has a group of
        self.writer, self._model, self._reopening, self._on_event = writer, model, reopening, on_event
        self._host_scale, self._scale = time_scale, max(time_scale, 1.0)  # below 1 devices are slow, too
        self.live = LiveEstimate(self._bench.table.gimbals, self._bench.site)
        self.task_guard = TaskGuard(lambda text: self.event(EventKind.NOTE, text))
        self.monitor = Monitor(opened, self.live, reopening, self._scale, self.task_guard)
        self.reports: dict[str, SourceReport] = {}
        """What was had of each source, once all is closed."""
        self.closed = False
        self._last_seen_s: dict[str, float] = {}
        self._accelerometers: set[str] = set()  # sources whose accelerometers the recording has the axes of
        self._configs: dict[str, ImuConfig] = {}  # of the device of each source
        self._noted: dict[str, dict[str, float | int]] = {}
        self._half_width_ns, self._rate_window_ns = 0, 0
        self.host = HostWatch(time_scale)
        self._sync: asyncio.Future[Any] | None = None
        self._enough_rows = asyncio.Event()
        writer.add_table(self._bench.table.gimbals, self._bench.table.uncertainty)
        for imu in self._imus:
            self._add_sources(imu)

    def _add_sources(self, imu: OpenImu) -> None:
        """Describe the sources of a device in the recording, and create their filters in the live estimate.

        The filters estimate the effects of the model, too, if it has any.
        """
        config, table = imu.config, self._bench.table
        noise_rps = float(config.noise.arw * np.sqrt(config.rate_hz))
        timing_s = table.uncertainty.timing_s if table.uncertainty else 0.0
        for name, gyros in config.gyros_of(imu.source.names).items():
            array = config.array.select(gyros)
            about = {"device": config.name, "rate_hz": config.rate_hz, "lost": 0, "noise": astuple(config.noise)}
            self.writer.add_source(name, array, config.prior, about | config.attributes)
            self._configs[name] = config
            effects = None
            if self._model is not None and self._model.effects:
                effects = SampleColumns(self._model, table.gimbals, self._bench.site, array)
            self.live.sources[name] = LiveSource(
                array=array,
                rate_hz=config.rate_hz,
                noise_rps=noise_rps,
                prior=config.prior,
                effects=effects,
                timing_s=timing_s,
            )

    async def open(self, imu: OpenImu) -> Identity:
        """Open a device under test, record and return its identity."""
        await imu.source.open()
        identity = await self._reopening.identify(imu.config.name, imu.source)
        for name in imu.source.names:
            self.writer.set_source(name, identity_attributes("", identity))
        return identity

    async def open_others(self) -> None:
        """Open, identify and record the devices other than the table and those under test, in order.

        DeviceRefused for the first that would refuse its set point; errors of drivers pass through.
        """
        for device in self._others:
            config, driver = device.config, device.driver
            await driver.open()
            identity = await self._reopening.identify(device.name, driver)
            if refused := await config.kind.refusal(driver, config.settings):
                raise DeviceRefused(device.name, refused)
            about = {"kind": config.kind.name, "protocol": config.spec.name, "link": ", ".join(config.links)}
            self.writer.add_device(device.name, {}, about | identity_attributes("", identity))
            self._described.add(device.name)

    def appending(self) -> list[OpenDevice]:
        """Return the devices of any kind that append a series, whose columns are recorded from now on."""
        found = [device for device in self._devices if isinstance(device.driver, AppendsSeries)]
        for device in found:
            assert isinstance(device.driver, AppendsSeries)
            self.writer.add_device(device.name, device.driver.columns, {})
        return found

    async def prepare_others(self) -> bool:
        """Bring the devices of other kinds to their set points, in order; return whether there are any.

        A lost link is reopened up to five times for each device; after that LinkLost. With such devices the phase
        becomes PREPARING.
        """
        for device in self._others:
            self.monitor.phase = Phase.PREPARING
            for lost in range(_LOST_WHILE_READIED + 1):
                opened = self._reopening.times.get(device.name, 0)
                try:
                    await device.config.kind.ready(device.driver, device.config.settings)
                    break
                except LinkLost as error:
                    if lost == _LOST_WHILE_READIED:
                        raise
                    await self._restore(device, error, opened)
        return bool(self._others)

    async def _restore(self, device: OpenDevice, error: LinkLost, opened: int) -> None:
        """Open the link of a device again, unless another task has since it had been ``opened`` so often."""
        async with self._restoring[device.name]:
            if self._reopening.times.get(device.name, 0) == opened:
                await self._reopening.restore(device.name, device.driver, error)

    async def follow(self, device: OpenDevice) -> None:
        """Record the series of a device and pass it to the monitor, until cancelled; a lost link is reopened while
        nothing turns.

        Links of the table and of tested devices are reopened elsewhere: the series is then tried again every 0.2 s.
        DeviceFault for an incomplete row, the end of the series, or an unexpected exception; LinkLost from the
        reopening.
        """
        driver = device.driver
        assert isinstance(driver, AppendsSeries)
        columns = driver.columns
        while True:
            opened = self._reopening.times.get(device.name, 0)
            try:
                async for t_ns, row in driver.rows():
                    if len(row) != len(columns):
                        raise DeviceFault(device.name, f"a row of its series has {len(row)} of {len(columns)} values")
                    values = dict(zip(columns, row, strict=True))
                    self.writer.append_series(device.name, t_ns, values)
                    self.monitor.take_series(device.name, columns, values)
                raise DeviceFault(device.name, "its driver ended its series in mid-run")
            except LinkLost as error:
                if device in self._others:
                    await self._restore(device, error, opened)
                else:
                    await asyncio.sleep(_LOOK_S * self._scale)
            except DeviceError:
                raise
            except Exception as error:  # a driver from outside may raise anything
                reason = f"the series of its driver failed ({type(error).__name__}: {error})"
                raise DeviceFault(device.name, reason) from error

    async def acquire(self, imu: OpenImu) -> None:
        """Record the samples of a device until cancelled; a lost link is reopened while nothing turns, else LinkLost.

        The silence of its sources counts from the reopening. DeviceFault if its driver ends the samples.
        """
        while True:
            try:
                async for name, block in imu.source.blocks():
                    self._take_block(name, block)
                raise DeviceFault(imu.config.name, "its driver ended its samples in mid-run")
            except LinkLost as error:
                await self._reopening.restore(imu.config.name, imu.source, error)
                now_s = asyncio.get_running_loop().time()
                self._last_seen_s |= {name: now_s for name in imu.source.names if name in self._last_seen_s}

    def _take_block(self, name: str, block: ImuBlock) -> None:
        """Record a block of samples of the source ``name`` and pass it to the live estimate and the monitor.

        Notes when it came, for ``watch_silence``. The first with accelerometers adds their axes to the recording, and,
        if the bench has a data sheet for them and their number is right, a live filter; they are recorded in any case.
        An error of the monitor is only reported.
        """
        self._last_seen_s[name] = asyncio.get_running_loop().time()
        self.task_guard.attempt("the monitor", lambda: self.monitor.take_block(name, block), None)
        keys = ("t_ns", "arrival_ns", "rate_rps", "temperature_c", "counter", "accel_mps2")
        columns = {key: values for key in keys if (values := getattr(block, key)) is not None}
        if block.accel_mps2 is not None and name not in self._accelerometers:
            self._accelerometers.add(name)
            config = self._configs[name]
            axes = accelerometer_axes(self.live.sources[name].array, config.mounting.axes)
            self.writer.add_accelerometers(name, axes)
            if config.force_sheet is not None and block.accel_mps2.shape[1] == len(axes):
                table = self._bench.table
                self.live.add_accelerometers(name, axes, config.rate_hz, config.force_sheet, table.uncertainty)
        self.writer.append_rows(f"imu/{name}", columns)
        self.live.add(name, block)

    def take_row(self, row: TableRow) -> None:
        """Record a row of table readings and pass it to live estimate and monitor; note the largest ``half_width_ns``.

        A new rate window is recorded first. Whoever waits for rows is woken once the live estimate has enough of them.
        """
        columns = row._asdict()
        if columns.pop("rate_window_ns") != self._rate_window_ns:
            table, self._rate_window_ns = self._bench.table, row.rate_window_ns
            self.writer.add_table(table.gimbals, table.uncertainty, row.rate_window_ns)
        self.writer.append_rows("table", {key: np.array([value]) for key, value in columns.items()})
        self._half_width_ns = max(self._half_width_ns, row.half_width_ns)
        if self.live.add_row(row):
            self._enough_rows.set()
        self.monitor.row = row

    async def keep_estimating(self) -> None:
        """Feed the live filters until cancelled, in a thread."""
        loop = asyncio.get_running_loop()
        while True:
            await self._enough_rows.wait()
            self._enough_rows.clear()
            await loop.run_in_executor(None, self.live.advance)

    def end_step(self, label: str, start_ns: int, end_ns: int) -> None:
        self.writer.append_text("steps", {"t_start_ns": start_ns, "t_end_ns": end_ns}, "label", label)

    def event(self, kind: EventKind, text: str) -> None:
        """Record an event, and pass it to the listener."""
        now_ns = round(asyncio.get_running_loop().time() * 1e9)
        self.writer.append_text("events", {"t_ns": now_ns}, "text", text, kind=np.array([kind.encode()], dtype="S16"))
        on_event = self._on_event
        if on_event is not None:
            self.task_guard.attempt("telling of events", lambda: on_event(now_ns * 1e-9, kind, text), None)

    async def first_samples(self) -> None:
        """Wait until every source of the devices under test has sent samples; LinkLost after 3 s.

        The error names the missing sources, and the device of the first. The limit stretches with a clock that runs
        fast.
        """
        limit_s = _FIRST_SAMPLE_S * self._scale
        names = {name for imu in self._imus for name in imu.source.names}
        deadline = asyncio.get_running_loop().time() + limit_s
        while missing := sorted(names - set(self._last_seen_s)):
            if asyncio.get_running_loop().time() > deadline:
                raise LinkLost(
                    self._device_of(missing[0]), sentence("run.no_samples", sources=", ".join(missing), limit_s=limit_s)
                )
            await asyncio.sleep(0.05)

    async def watch_silence(self) -> None:
        """Check until cancelled that samples keep coming; LinkLost if a source is silent for 1 s.

        A source counts from its first sample on, and not while its link is reopened. The limit stretches with a clock
        that runs fast. Nothing is concluded after a sleep that took too long, as samples may still be unread.
        """
        limit_s = _SILENCE_S * self._scale
        while True:
            if await self._slept_late(limit_s / 4):
                continue  # samples that came meanwhile are still to be processed
            now = asyncio.get_running_loop().time()
            silent = [
                name
                for name, seen in self._last_seen_s.items()
                if now - seen > limit_s and self._device_of(name) not in self._reopening.under_way
            ]
            if silent:
                raise LinkLost(self._device_of(silent[0]), f"{', '.join(silent)} fell silent for {limit_s:g} s")

    def _device_of(self, source: str) -> str:
        return next(imu.config.name for imu in self._imus if source in imu.source.names)

    async def _slept_late(self, time_s: float) -> bool:
        """Sleep; return whether this computer was late with that."""
        due_s = asyncio.get_running_loop().time() + time_s
        await asyncio.sleep(time_s)
        return self.host.woke(due_s)

    def blamed(self, error: DeviceError) -> DeviceError:
        """Return an error of a device, or the error of this computer that is behind it."""
        config = self._bench
        device = config.devices.get(error.device)
        return self.host.blame(error, served_here=device is not None and any(map(ends_here, device.links)))

    async def keep_flushing(self) -> None:
        """Write new data to the journal some 150 times a second, and every 2 s to the recording, until cancelled.

        Counts, marks of the monitor, the history of the live estimate and the host's load are taken every 0.2 s; an
        event tells of a clock that falls behind. While the journal is synced to the disk, the recording is not written.
        Intervals are in the host's time, which may fail; in virtual time all is written every 2 s.
        """
        loop = asyncio.get_running_loop()
        virtual, journal = is_virtual(loop), self.writer.journal
        every_s = _FLUSH_S if virtual else _JOURNAL_S * self._host_scale
        look_due_s, flush_due_s = loop.time(), loop.time()
        while True:
            await self._slept_late(every_s)
            if loop.time() >= look_due_s:
                look_due_s = loop.time() + _LOOK_S * self._host_scale
                self.task_guard.attempt("the monitor", self.monitor.mark, None)
                self._take_histories(_HISTORY_BLOCKS)
                self._note_counts()
                self.host.look()
            if self.monitor.phase is Phase.RUNNING and (slowed := self.host.slowed()):
                self.event(EventKind.NOTE, slowed)
            await self._write_journal()
            if self._sync is not None and not self._sync.done():
                continue  # a write into the recording now could wait for the disk, and everything for that write
            if loop.time() >= flush_due_s:
                flush_due_s = loop.time() + _FLUSH_S * self._host_scale
                for _ in self.writer.flushing():
                    if not virtual:
                        await self._write_journal()
            if not virtual and journal is not None and journal.unsynced:
                self._sync = loop.run_in_executor(None, journal.sync)

    async def _write_journal(self) -> None:
        loop = asyncio.get_running_loop()
        if not is_virtual(loop):
            self._note_arrived()
        await loop.run_in_executor(None, self.writer.write_journal)

    def _note_arrived(self) -> None:
        """Write to the journal the samples that a source holds back until it can time them."""
        for imu in self._imus:
            for name, arrival_ns, rate_rps in imu.source.arrived() if isinstance(imu.source, EarlySource) else ():
                self.writer.arrived(f"imu/{name}", arrival_ns, rate_rps)

    def _note_counts(self) -> None:
        """Write changed counts to the journal, for a run that dies."""
        for name, report in self._reports_now().items():
            attributes = report.attributes()
            if self._noted.get(name) != attributes:
                self._noted[name] = attributes
                self.writer.note_source(name, attributes)

    def _reports_now(self) -> dict[str, SourceReport]:
        about = [(imu.source, name) for imu in self._imus for name in imu.source.names]
        look = self.monitor
        return {
            name: SourceReport(name, counts=look.counts(source, name), clock=look.alignment(source, name))
            for source, name in about
        }

    async def close(self, attributes: Mapping[str, str], *, undisturbed: bool) -> None:
        """Close all sources and other devices, record what is left, and close the recording.

        That is: samples that sources still hold, the rest of the live estimate's history, counts of sources and links,
        the largest half width of the table's readings, and the root's ``attributes``. If ``undisturbed`` (no verdict so
        far), open each closed device again to check its identity, and finish the live estimate, whose EstimatorError is
        ignored. DeviceFault if another device is there: devices after it and the recording then stay open. Sets
        ``reports`` and, at the end, ``closed``.
        """
        self.monitor.end()
        for imu in self._imus:
            imu.source.close()
            for name, block in imu.source.flush():
                self._take_block(name, block)
        self.reports = self._reports_now()
        for imu in self._imus:
            for name in imu.source.names:
                self.writer.set_source(name, self.reports[name].attributes() | _link_attributes("", imu.counts))
            if undisturbed:
                await self._reopening.ask_at_end(imu.config.name, imu.source)
        for device in self._others:
            device.driver.close()
            if device.counts is not None and device.name in self._described:
                self.writer.set_attributes(_link_attributes("", device.counts), f"{DEVICES}/{device.name}")
            if undisturbed:
                await self._reopening.ask_at_end(device.name, device.driver)
        if undisturbed:
            with suppress(EstimatorError):  # the batch estimate reports it
                self.live.finish()
        self._take_histories(1)
        if counts := self.monitor.link_counts().get("table"):
            self.writer.set_attributes(_link_attributes("table_", counts))
        self.writer.set_attributes({"table_read_half_width_ns": self._half_width_ns, **attributes})
        if self._sync is not None:
            with suppress(OSError):
                await self._sync
        self.writer.close()
        self.closed = True

    def _take_histories(self, fewest: int) -> None:
        for group, columns in self.live.take_histories(fewest):
            self.writer.append_rows(group, columns)

    def causes(self) -> list[str]:
        """Return sentences on possible causes of a failure besides the gyros, empty if there are none.

        They are mistimed samples, a table slower than 20 ms, and a computer that fell behind. Call it after ``close``.
        """
        took_s = 2e-9 * self._half_width_ns
        took_ms = f"{2e-6 * self._half_width_ns:.0f} ms"
        slow = f"the table answered up to {took_ms} late, so the time of each angle is only known to {took_ms}"
        found = [report.mistimed for report in self.reports.values()]
        behind_ms = f"{self.host.worst_s * 1e3:.0f} ms"
        late = f"this computer fell behind by up to {behind_ms}. Close other programs or lower --scale"
        found += [slow] * (took_s > _SLOW_S) + [late] * (self.host.worst_s > 0.0)
        return [cause for cause in found if cause]


def _link_attributes(prefix: str, counts: LinkCounts) -> dict[str, Any]:
    return {f"{prefix}link_{name}": count for name, count in asdict(counts).items()}


def identity_attributes(prefix: str, identity: Identity) -> dict[str, Any]:
    """Return an identity as attributes, without empty values."""
    return {f"{prefix}{key}": value for key, value in asdict(identity).items() if value}
