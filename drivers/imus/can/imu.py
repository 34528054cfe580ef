"""Any IMU on CAN that a DBC describes, with a mapping of its signals to channels."""

import asyncio
import threading
from collections import deque
from collections.abc import AsyncIterator, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.clocks.loop_scale import loop_scale
from drivers.clocks.sampling import Alignment, CounterClock, RegularClock
from drivers.errors import DeviceError
from drivers.imus.one_source import OneSource
from drivers.imus.samples import Companion, Piece, block_of, regular_block
from drivers.imus.signals import MessageKey, SignalReader, is_j1939, message_key, parameter_group
from drivers.packaged import sentence
from drivers.protocols import FrameLink
from drivers.specs import ImuSetup, ImuSpec, described
from drivers.types import Flags, Floats, Frame, Identity, ImuBlock, Octets, SourceCounts, Stamps

BUILT_IN_DBC = Path(__file__).with_name("gyro_nodes.dbc")


_GATHERED, _LEAST_GATHER_S, _MOST_GATHER_S = 32, 0.05, 0.33  # samples taken in together, and how long that may take
_LOOK_S = 0.008  # real time between looks at new frames, if a caller waits for them
_COUNT_BITS = 32  # of longer counters the lower bits will do: they wrap, as all do


@dataclass(frozen=True, slots=True)
class CanChannel:
    """The signals of one source, as ``MESSAGE.Signal`` names of the DBC.

    ``rates`` has one signal for each gyro, all of one message. Samples are timed by ``counter``, which advances by
    ``step``, or by ``time``, the device's own clock; the raw number of either wraps at ``wrap``, or at its length if
    that is 0. ``units`` gives units that the DBC does not state, by "rate", "temperature", "acceleration", "time". With
    ``saturates`` a rate or acceleration at an end of the DBC's range counts as missing.
    """

    name: str
    rate: str | tuple[str, ...]
    temperature: str | None = None
    counter: str | None = None
    time: str | None = None
    acceleration: tuple[str, str, str] | None = None
    units: tuple[tuple[str, str], ...] = ()
    wrap: int = 0
    step: int = 1
    saturates: bool = False

    @property
    def rates(self) -> tuple[str, ...]:
        """Names of the rate signals, one a gyro."""
        return (self.rate,) if isinstance(self.rate, str) else self.rate


@dataclass(frozen=True, slots=True)
class CanSource:
    """Description of a device on a CAN bus: its DBC, the signals of its sources, the J1939 address if only one is
    meant.

    ``database`` is cantools' database where there is no DBC file to read.
    """

    dbc: Path
    channels: tuple[CanChannel, ...]
    source_address: int | None = None
    database: Any = None


def load_dbc(device: str, dbc: Path) -> Any:
    """Return cantools' database of a DBC file; DeviceError, which names ``device``, if it cannot be read."""
    import cantools

    try:
        return cantools.database.load_file(dbc)
    except Exception as error:  # cantools has no common base class for errors in a file
        raise DeviceError(device, f"DBC file {dbc.name} cannot be read: {error}") from None


class ChannelSignals:
    """The signals of one channel, looked up in the DBC."""

    def __init__(self, device: str, database: Any, dbc: Path, channel: CanChannel) -> None:
        """Look up the signals of ``channel`` in cantools' ``database``; DeviceError for one that is missing or
        unsuitable.

        All rates must be in one message, and so must all accelerations; only a counter or a time may be given, and
        either must be a plain count. What the channel lacks is None, accelerations an empty list. ``device`` and
        ``dbc`` are for the error messages.
        """
        units = dict(channel.units)

        def reader(name: str, quantity: str) -> SignalReader:
            """Return the reader of a ``MESSAGE.Signal`` of the DBC as a ``quantity``; DeviceError if missing or
            unsuitable.

            The unit of the channel for this quantity takes precedence over the DBC's. If the channel ``saturates``,
            rates and accelerations at the ends of the DBC's range count as missing; other quantities never do.
            """
            saturates = channel.saturates and quantity in ("rate", "acceleration")
            return SignalReader(
                device=device,
                database=database,
                dbc=dbc,
                name=name,
                quantity=quantity,
                unit=units.get(quantity, ""),
                saturates=saturates,
            )

        self.rates = [reader(name, "rate") for name in channel.rates]
        self.acceleration = [reader(name, "acceleration") for name in channel.acceleration or ()]
        self.temperature = reader(channel.temperature, "temperature") if channel.temperature is not None else None
        self.counter = reader(channel.counter, "count") if channel.counter is not None else None
        self.time = reader(channel.time, "time") if channel.time is not None else None
        self.wrap, self.step = channel.wrap, channel.step
        for part, quantities in ((self.rates, "rates"), (self.acceleration, "accelerations")):
            if len({signal.key for signal in part}) > 1:
                names = ", ".join(signal.name for signal in part)
                raise DeviceError(device, sentence("imu.in_several", names=names, what=quantities, dbc=dbc.name))
        if self.counter is not None and self.time is not None:
            raise DeviceError(device, f"{self.counter.name} and {self.time.name}: give a counter or a time, not both")
        for signal in (self.counter, self.time):
            if signal is not None and not signal.counts:
                raise DeviceError(device, sentence("imu.no_count", signal=signal.name, dbc=dbc.name))

    @property
    def all(self) -> list[SignalReader]:
        """Every signal of the channel."""
        single = (self.temperature, self.counter, self.time)
        return [*self.rates, *self.acceleration, *(signal for signal in single if signal is not None)]


class CanImu(OneSource[FrameLink]):
    """A device on a CAN bus; each channel is a separate source with its own clock."""

    def __init__(self, setup: ImuSetup, link: FrameLink) -> None:
        """Prepare a source for each channel of ``setup.signals``, a ``CanSource``; no link is opened.

        Its DBC is read unless it brings a database. DeviceError if the DBC cannot be read or a signal is missing or
        unsuitable. J1939 messages are recognised by their parameter group, from any sender unless a source address is
        given; other messages by their identifier.
        """
        device, source, rate_hz = setup.name, setup.signals, setup.rate_hz
        super().__init__(device, link)
        self._address = source.source_address
        dbc, channels = source.dbc, source.channels
        database = source.database or load_dbc(device, dbc)
        self._order = 0
        self._arrived: list[Frame] = []
        self._fresh: list[Frame] | None = None  # those of them that ``arrived`` has not returned yet
        self._timed: deque[tuple[str, ImuBlock]] = deque()
        self._timing = threading.Lock()
        self._sources = {
            channel.name: _Source(ChannelSignals(device, database, dbc, channel), rate_hz) for channel in channels
        }
        self._gather_s = min(max(_GATHERED / rate_hz, _LEAST_GATHER_S), _MOST_GATHER_S)
        self._exact: dict[MessageKey, list[_Inlet]] = {}
        self._groups: dict[int, list[_Inlet]] = {}
        for source in self._sources.values():
            for inlet in source.inlets:
                if is_j1939(inlet.message):
                    self._groups.setdefault(parameter_group(inlet.message.frame_id), []).append(inlet)
                else:
                    self._exact.setdefault(message_key(inlet.message), []).append(inlet)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(self._sources)

    def counts(self, name: str) -> SourceCounts:
        """Get the counts of one channel."""
        return self._sources[name].counts

    def alignment(self, name: str) -> Alignment | None:
        """Get how the clock of one channel lies to the loop's; None while that is not known."""
        return self._sources[name].alignment

    async def identify(self) -> Identity:
        """Return an empty identity: a DBC tells how to read values, not how to ask for them."""
        return Identity()

    async def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield (source, block) as samples can be timed; LinkLost when the bus is gone.

        Blocks that are still held come first. Called again after a break, the clocks of sources without a counter or
        time start anew. Frames are gathered and timed in a thread, so that answers of the table do not wait.
        """
        for name, held in self.flush():
            yield name, held
        with self._timing:
            for source in self._sources.values():
                source.restart()
        loop = asyncio.get_running_loop()
        due_s, look_s = 0.0, _LOOK_S * loop_scale(loop)
        while True:
            frames = await self._link.receive()
            with self._timing:
                self._arrived += frames
            if self._fresh is not None:
                self._fresh += frames
            if loop.time() >= due_s:
                # In a thread, so that tasks that wait for the table are not delayed by computing.
                await loop.run_in_executor(None, self._time)
                while self._timed:
                    yield self._timed.popleft()
                # Frames are stamped by the link: to time them in handfuls costs no accuracy and a tenth of the work.
                due_s = loop.time() + self._gather_s
            await asyncio.sleep(self._gather_s if self._fresh is None else min(self._gather_s, look_s))

    def arrived(self) -> list[tuple[str, Stamps, Floats]]:
        """Return source name, arrivals (n,) in ns and rates (n, m) in rad/s of samples since the last call, before they
        are timed.

        Only sources with new samples are listed; frames of a wrong length count for none, and those that lack a
        multiplexed rate are left out. The first call returns nothing: from it on, samples are kept for the next call.
        """
        frames, self._fresh = self._fresh or [], []
        leading: dict[_Inlet, list[Frame]] = {}
        for frame in frames:
            for inlet in self._inlets(frame):
                if inlet.companion is None and inlet.fits(frame.data):
                    leading.setdefault(inlet, []).append(frame)
        of_sources = [(name, source, leading.get(source.lead)) for name, source in self._sources.items()]
        return [(name, *source.rates(came)) for name, source, came in of_sources if came]

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return (source, block) for the samples that are still held back for their timing or for a part to come."""
        self._time(flush=True)
        with self._timing:
            last = list(self._timed)
            self._timed.clear()
        return last

    def _time(self, *, flush: bool = False) -> None:
        """Time the frames that have arrived, and queue the finished blocks for ``blocks``; ``flush`` holds none
        back.

        Runs in a thread, under the lock that also guards the loop's accesses: a reader that stops may leave it running.
        """
        with self._timing:
            arrived, self._arrived = self._arrived, []
            self._take(arrived)
            for name, source in self._sources.items():
                if (block := source.block(flush=flush)) is not None:
                    self._timed.append((name, block))

    def _take(self, frames: Iterable[Frame]) -> None:
        for frame in frames:
            self._order += 1
            for inlet in self._inlets(frame):
                inlet.take(Piece(self._order, frame.t_ns, frame.data))

    def _inlets(self, frame: Frame) -> "Sequence[_Inlet]":
        """Return the inlets for a frame, by its identifier or its J1939 parameter group.

        Empty for messages that no channel uses, and for J1939 messages of other senders if a source address is given.
        """
        if exact := self._exact.get((frame.identifier, frame.extended)):
            return exact
        if not self._groups or not frame.extended:
            return ()
        if self._address is not None and frame.identifier & 0xFF != self._address:
            return ()
        return self._groups.get(parameter_group(frame.identifier), ())


class _Inlet:
    """One message of one source; ``companion`` collects it unless it is the leading one."""

    def __init__(self, message: Any, counts: SourceCounts, companion: Companion | None) -> None:
        self.message, self.companion = message, companion
        self.waiting: list[Piece] = []
        self._length, self._counts = int(message.length), counts

    def fits(self, data: bytes) -> bool:
        return len(data) == self._length

    def take(self, piece: Piece) -> None:
        if not self.fits(piece.data):
            self._counts.corrupt += 1
        elif self.companion is not None:
            self.companion.add(piece)
        else:
            self.waiting.append(piece)

    def table(self, rows: list[bytes]) -> Octets:
        return np.frombuffer(b"".join(rows), dtype=np.uint8).reshape(len(rows), self._length)


class _Source:
    """Frames of one channel that were received and not yet returned as blocks."""

    def __init__(self, signals: ChannelSignals, rate_hz: float) -> None:
        """Prepare the leading message, that of the rates, and a companion for each further message.

        A companion belongs to the leading frame before it if its identifier is larger and it has more than a
        temperature, else to the one after it. Samples are timed by the time or counter signal if there is one, which
        wraps as the channel says, else at its number of bits; without one by their rhythm.
        """
        self.counts = SourceCounts()
        self._signals = signals
        lead = signals.rates[0]
        self.lead = _Inlet(lead.message, self.counts, None)
        self._others: dict[MessageKey, _Inlet] = {}
        self._companions: dict[MessageKey, Companion] = {}
        of_a_sample = [*signals.acceleration, *(s for s in (signals.counter, signals.time) if s is not None)]
        for signal in signals.all:
            if signal.key != lead.key and signal.key not in self._others:
                # A temperature belongs to the next sample; other parts of a sample may also come after it.
                follows = signal.key > lead.key and any(signal.key == other.key for other in of_a_sample)
                self._companions[signal.key] = Companion(follows=follows)
                self._others[signal.key] = _Inlet(signal.message, self.counts, self._companions[signal.key])
        self._before = 0  # place of the last leading frame given
        self._temperature_c = float("nan")
        self._count = signals.time or signals.counter
        self._clock: RegularClock | CounterClock = RegularClock(1 / rate_hz, self.counts)
        if self._count is not None:
            tick_s = signals.time.scale if signals.time is not None else 1 / (rate_hz * signals.step)
            self._modulus = signals.wrap or 1 << min(self._count.bits, _COUNT_BITS)
            self._clock = CounterClock(tick_s, self._modulus, max(round(1 / (rate_hz * tick_s), 6), 1), self.counts)

    @property
    def inlets(self) -> list[_Inlet]:
        return [self.lead, *self._others.values()]

    @property
    def alignment(self) -> Alignment | None:
        return self._clock.alignment

    def restart(self) -> None:
        """Begin anew after a break; nothing must be held any more."""
        if isinstance(self._clock, RegularClock):
            self._clock.restart()

    def block(self, *, flush: bool = False) -> ImuBlock | None:
        """Return a block of the samples that can be timed, or None if there are none; ``flush`` holds none back.

        Where a counter or time signal is given, samples without one and repeated ones are dropped.
        """
        pieces, gyros = self._whole(flush=flush), len(self._signals.rates)
        if isinstance(self._clock, RegularClock):
            values = self._rows(pieces)[0] if pieces else np.empty((0, gyros))
            samples = [(piece.t_ns, row, piece.data) for piece, row in zip(pieces, values, strict=True)]
            return regular_block(self._clock, samples, gyros, flush=flush)
        if not pieces:
            return None
        values, counted, count = self._rows(pieces)
        arrival_ns = np.array([piece.t_ns for piece in pieces], dtype=np.int64)[counted]
        new, t_ns = self._clock.stamp(count[counted], arrival_ns)
        return block_of(t_ns, arrival_ns[new], values[counted][new], gyros, count[counted][new]) if len(t_ns) else None

    def rates(self, frames: Sequence[Frame]) -> tuple[Stamps, Floats]:
        """Return arrivals (n,) in ns and rates (n, m) of leading frames; frames that lack a multiplexed rate are left
        out.
        """
        rows = self.lead.table([frame.data for frame in frames])
        there = np.logical_and.reduce([signal.present(rows) for signal in self._signals.rates])
        arrival_ns = np.array([frame.t_ns for frame in frames], dtype=np.int64)
        return arrival_ns[there], np.column_stack([signal.values(rows) for signal in self._signals.rates])[there]

    def _whole(self, *, flush: bool) -> list[Piece]:
        """Take the waiting leading frames whose companions have come or will not come any more.

        Only the newest may have to wait for one; ``flush`` takes it as well. Frames that lack a multiplexed rate are
        dropped. Empty if no frame waits; companions that nothing can match any more are then dropped.
        """
        waiting = self.lead.waiting
        for signal in self._signals.rates:
            if waiting and signal.multiplexed:
                present = signal.present(self.lead.table([piece.data for piece in waiting]))
                waiting = [piece for piece, has in zip(waiting, present, strict=True) if has]
        if not waiting:
            self.lead.waiting = waiting
            for companion in self._companions.values():
                companion.idle()
            return []
        order = waiting[-1].order
        open_end = any(c.follows and not c.reached(order) for c in self._companions.values())
        hold = 1 if open_end and not flush else 0
        pieces, self.lead.waiting = waiting[: len(waiting) - hold], waiting[len(waiting) - hold :]
        return pieces

    def _rows(self, pieces: list[Piece]) -> tuple[Floats, Flags, Stamps]:
        """Return rows (n, k) of leading frames, as ``block_of`` expects them; which have a count (n,), and the counts
        (n,).

        Values of a missing companion are NaN; the temperature keeps its last value. Counts are reduced to their wrap,
        and mean nothing in rows without one. Without a count signal no row has one. Companions up to the last of these
        frames are used up.
        """
        n = len(pieces)
        places = [piece.order for piece in pieces]
        after = self.lead.waiting[0].order if self.lead.waiting else np.iinfo(np.int64).max
        lead = self.lead.table([piece.data for piece in pieces])
        found: dict[MessageKey, tuple[Flags, Octets]] = {self._signals.rates[0].key: (np.ones(n, dtype=np.bool_), lead)}
        for key, companion in self._companions.items():
            which, rows = companion.matched(self._before, places, after)
            found[key] = which, self._others[key].table(rows)
            companion.forget(places[-1])
        self._before = places[-1]

        def column(signal: SignalReader) -> Floats:
            which, data = found[signal.key]
            out = np.full(n, np.nan)
            out[which] = signal.values(data)
            return out

        temperature = np.full(n, np.nan) if self._signals.temperature is None else column(self._signals.temperature)
        columns = [column(signal) for signal in self._signals.rates]
        values = np.column_stack([*columns, self._held(temperature), *map(column, self._signals.acceleration)])
        counted, count = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.int64)
        if self._count is not None:
            which, data = found[self._count.key]
            counted[which] = self._count.present(data)
            count[which] = self._count.raw(data) % self._modulus
        return values, counted, count

    def _held(self, temperature_c: Floats) -> Floats:
        """Return the temperature at each sample: the last one received."""
        known = np.concatenate([[self._temperature_c], temperature_c])
        latest = np.maximum.accumulate(np.where(np.isnan(known), 0, np.arange(len(known))))
        held = known[latest]
        self._temperature_c = float(held[-1])
        return np.asarray(held[1:])


SPEC = described(ImuSpec, __package__, make=CanImu, gyros=None)
