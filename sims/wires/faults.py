"""Faults of a twin and its wire as settings, the same every time for one seed.

A bench file turns them in [twin.fault] for the table and [twin.NAME.fault] for a device; times count from the start of
the twins, on the loop's clock. Faults of a wire sit between device and wire, so one serves every wire.
"""

import asyncio
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from types import SimpleNamespace
from typing import Any, Generic, Self, TypeVar

import can
import numpy as np

from sims.physics.hidden.fields import (
    FLAG,
    SHARE,
    WHOLE,
    HiddenError,
    check,
    choice,
    given,
    key_of,
    read,
    refuse_unknown,
)
from sims.physics.table import FOLLOWING_ERROR, TableModel
from sims.wires.frames import FrameSink
from sims.wires.wires import ByteDevice, Plug, Write

T = TypeVar("T")

_MOST_UNDER_WAY = 100_000
_TRIPS = {"fault": "fault input", "limit": "limit switch", "servo": FOLLOWING_ERROR}
_FREEZES: Mapping[str, Mapping[str, bool]] = {
    "frozen": {},
    "frozen angle": {"rate": False},
    "frozen rate": {"angle": False},
    "zeros": {"zero": True},
    "zero angle": {"rate": False, "zero": True},
    "zero rate": {"angle": False, "zero": True},
}
_KINDS = (*_TRIPS, "runaway", "interlock", *_FREEZES)
_RUNAWAY_RPS = math.radians(20.0)


@dataclass(frozen=True, slots=True)
class WireFaults:
    """Faults of a wire, in both directions.

    Everything is delayed by ``latency_s`` and on average ``jitter_s`` more (exponential), in order; of the bytes or
    frames from the device the share ``late`` is delayed by a further ``late_by_s``. ``loss`` and ``doubled`` are shares
    of writes or frames; ``byte_loss`` and ``bit_flips`` shares of bytes. With ``one_byte`` bytes come singly. Nothing
    comes through from ``silent_from_s`` to ``silent_until_s``; the plug is out from ``unplug_s`` to ``replug_s``. From
    ``another_s`` on, another device of the same kind, just switched on, is at the far end.

    Of what the device sends the share ``swapped`` changes places with the next item; from ``repeats_s`` on the same
    item is repeated for ever; from ``backwards_s`` on the last second of traffic is replayed in reverse.
    """

    latency_s: float = field(default=0.0, metadata=given("s", least=0))
    jitter_s: float = field(default=0.0, metadata=given("s", least=0))
    late: float = field(default=0.0, metadata=SHARE)
    late_by_s: float = field(default=0.0, metadata=given("s", least=0))
    loss: float = field(default=0.0, metadata=SHARE)
    doubled: float = field(default=0.0, metadata=SHARE)
    byte_loss: float = field(default=0.0, metadata=SHARE)
    bit_flips: float = field(default=0.0, metadata=SHARE)
    one_byte: bool = field(default=False, metadata=FLAG)
    silent_from_s: float = field(default=math.inf, metadata=given("s", least=0))
    silent_until_s: float = field(default=math.inf, metadata=given("s", least=0))
    unplug_s: float = field(default=math.inf, metadata=given("s", least=0))
    replug_s: float = field(default=math.inf, metadata=given("s", least=0))
    another_s: float = field(default=math.inf, metadata=given("s", least=0))
    swapped: float = field(default=0.0, metadata=SHARE)
    repeats_s: float = field(default=math.inf, metadata=given("s", least=0))
    backwards_s: float = field(default=math.inf, metadata=given("s", least=0))

    def __post_init__(self) -> None:
        """Raise HiddenError for impossible values."""
        check(self)

    @property
    def to_device(self) -> Self:
        """The faults that also act on what the host sends."""
        return replace(self, late=0.0, swapped=0.0, repeats_s=math.inf, backwards_s=math.inf)

    @property
    def any(self) -> bool:
        """Whether there is any fault."""
        return self != WireFaults()

    @property
    def delays(self) -> bool:
        """Whether anything comes late."""
        return bool(self.latency_s or self.jitter_s or self.late)


@dataclass(frozen=True, slots=True)
class DeviceFaults:
    """Faults of a device under test.

    From ``from_s`` to ``until_s`` gyro ``stuck`` (counted from 1; 0 is none) freezes and gyro ``saturated`` shows the
    end of its range. ``dropped`` and ``doubled`` are shares of samples, ``huge`` that of samples with impossible rates,
    where the protocol can express them; ``clock`` is the share by which its clock is too fast. With ``no_temperature``
    its temperature is not a number.
    """

    stuck: int = field(default=0, metadata=WHOLE)
    saturated: int = field(default=0, metadata=WHOLE)
    from_s: float = field(default=0.0, metadata=given("s", least=0))
    until_s: float = field(default=math.inf, metadata=given("s", least=0))
    dropped: float = field(default=0.0, metadata=SHARE)
    doubled: float = field(default=0.0, metadata=SHARE)
    huge: float = field(default=0.0, metadata=SHARE)
    no_temperature: bool = field(default=False, metadata=FLAG)
    clock: float = field(default=0.0, metadata=given("ppm"))

    def __post_init__(self) -> None:
        """Raise HiddenError for impossible values."""
        check(self)
        if min(self.stuck, self.saturated) < 0:
            raise HiddenError("stuck, saturated: gyros are counted from 1")

    @property
    def clock_ppm(self) -> float:
        """How much too fast its clock runs, in ppm."""
        return self.clock * 1e6


@dataclass(frozen=True, slots=True)
class TableFault:
    """A fault at one instant: of the input, limit switch or servo of an axis, of the interlock of all, or of readings.

    Frozen readings do not change any more, or are zero, while the axis moves on.
    """

    axis: str = field(metadata=choice(("x", "y", "z")))
    at_s: float = field(metadata=given("s", least=0))
    kind: str = field(default="fault", metadata=choice(_KINDS))

    def strike(self, table: TableModel, *, limits_trip: bool) -> None:
        """Apply the fault to a table: open its interlock, freeze readings, trip the axis, or let it run at 20 deg/s.

        ``limits_trip``: the drives treat a limit switch as a reason to trip; else it is pressed, in the direction of
        motion, forward at rest.
        """
        if self.kind == "runaway":
            table.motion[self.axis].jog(table.clock(), _RUNAWAY_RPS, table.data[self.axis].max_acceleration_rps2)
        elif self.kind == "interlock":
            table.open_interlock()
        elif self.kind in _FREEZES:
            table.freeze_readings(self.axis, **_FREEZES[self.kind])
        elif self.kind == "limit" and not limits_trip:
            table.press_limit(self.axis, 1 if table.rate_rps(self.axis) >= 0 else -1)
        else:
            table.trip(self.axis, _TRIPS[self.kind])


def device_faults(table: Mapping[str, object], gyros: int, where: str) -> tuple[DeviceFaults, WireFaults]:
    """Return the faults of a device with ``gyros`` gyros and those of its wire, from the keys of [twin.NAME.fault].

    ``where`` is the name of that table for errors. HiddenError for unknown keys, invalid values and missing gyros.
    """
    device, wire = _split(table, (DeviceFaults, WireFaults), where)
    found = _read(DeviceFaults, device, where)
    for key in ("stuck", "saturated"):
        if (number := getattr(found, key)) > gyros:
            raise HiddenError(f"{where}.{key}: {number} is not the number of a gyro, 1 to {gyros}")
    return found, _read(WireFaults, wire, where)


def wire_faults(table: Mapping[str, object], where: str) -> WireFaults:
    """Return the wire faults in [twin.NAME.fault] for a device of another kind; HiddenError if invalid."""
    refuse_unknown(table, {key_of(described): described for described in fields(WireFaults)}, where)
    return _read(WireFaults, table, where)


def table_faults(
    table: Mapping[str, object], axes: Collection[str], where: str
) -> tuple[TableFault | None, WireFaults]:
    """Return the fault of a table with these axes, None without one, and those of its wire, from [twin.fault].

    ``where`` is the name of that TOML table for errors. HiddenError for unknown keys, invalid values and missing axes.
    """
    fault, wire = _split(table, (TableFault, WireFaults), where)
    found = _read(TableFault, fault, where) if fault else None
    if found is not None and found.axis not in axes:
        raise HiddenError(f"{where}.axis: the table has no axis {found.axis}; it has {', '.join(axes)}")
    return found, _read(WireFaults, wire, where)


def damaged(data: bytes, faults: WireFaults, random: np.random.Generator) -> bytes:
    """Return ``data`` with some bits flipped and some bytes lost, by the shares in ``faults``."""
    if not faults.byte_loss and not faults.bit_flips:
        return data
    octets = np.frombuffer(data, dtype=np.uint8).copy()
    flipped = random.random(len(octets)) < faults.bit_flips
    octets[flipped] ^= (1 << random.integers(0, 8, int(flipped.sum()))).astype(np.uint8)
    return octets[random.random(len(octets)) >= faults.byte_loss].tobytes()


class FaultyWay(Generic[T]):
    """One direction of a wire: items are lost, doubled or delayed."""

    def __init__(
        self, hand_on: Callable[[T], None], faults: WireFaults, seed: Any, *, silent_unplugged: bool = False
    ) -> None:
        """Prepare to pass what arrives to ``hand_on``; ``faults`` count their times from now; needs a running loop.

        Nothing arrives while the wire is silent, nor, with ``silent_unplugged``, while the plug is out. ``seed`` is of
        any kind that numpy accepts.
        """
        self._hand_on, self._faults = hand_on, faults
        self._random = np.random.default_rng(seed)
        self._under_way: deque[tuple[float, T]] = deque(maxlen=_MOST_UNDER_WAY)
        self._last_s = -math.inf
        spans = [(faults.silent_from_s, faults.silent_until_s), (faults.unplug_s, faults.replug_s)]
        self._spans = [span for span in spans[: 1 + silent_unplugged] if span[0] < math.inf]
        self._began_s = asyncio.get_running_loop().time()
        self._sent: deque[tuple[float, T]] = deque()  # in the last second
        self._repeated: dict[object, T] = {}
        self._held: T | None = None

    def __call__(self, item: T) -> None:
        """Send an item, which may be lost, doubled, damaged, out of order or late."""
        for each in self._disordered(item):
            if self.silent or _share(self._random, self._faults.loss):
                continue
            for _ in range(2 if _share(self._random, self._faults.doubled) else 1):
                self._put(self._damaged(each))

    def _disordered(self, item: T) -> list[T]:
        """Return the items sent in place of ``item``; the list may be empty.

        After ``repeats_s`` the first item of its kind is repeated. After ``backwards_s`` those of the last second
        before it are sent in reverse, until all have been. Else some are swapped with the next one, and held back for
        the next call.
        """
        faults, at_s = self._faults, asyncio.get_running_loop().time() - self._began_s
        if at_s >= faults.repeats_s:
            return [self._repeated.setdefault(self._kind(item), item)]
        if at_s >= faults.backwards_s and self._sent:
            return [self._sent.pop()[1]]
        if faults.backwards_s < math.inf and at_s < faults.backwards_s:
            self._sent.append((at_s, item))
            while self._sent[0][0] < at_s - 1.0:
                self._sent.popleft()
        if self._held is not None:
            held, self._held = self._held, None
            return [item, held]
        if _share(self._random, faults.swapped):
            self._held = item
            return []
        return [item]

    def _kind(self, item: T) -> object:
        """Return a key that messages share if one may stand for another; None for all."""
        return None

    @property
    def silent(self) -> bool:
        """Whether nothing comes through now."""
        at_s = asyncio.get_running_loop().time() - self._began_s if self._spans else 0.0
        return any(from_s <= at_s < until_s for from_s, until_s in self._spans)

    def _damaged(self, item: T) -> T:
        return item

    def _put(self, item: T) -> None:
        """Deliver an item, at once or after a delay; items keep their order.

        A delay is constant, random, or long for a share of the items, or all three. Of too many under way the oldest
        are lost.
        """
        faults = self._faults
        if not faults.delays:
            self._deliver(item)
            return
        loop = asyncio.get_running_loop()
        late_s = faults.latency_s + (self._random.exponential(faults.jitter_s) if faults.jitter_s else 0.0)
        late_s += faults.late_by_s if _share(self._random, faults.late) else 0.0
        self._last_s = max(self._last_s, loop.time() + late_s)
        self._under_way.append((self._last_s, item))
        if len(self._under_way) == 1:
            loop.call_at(self._last_s, self._arrive)

    def _arrive(self) -> None:
        loop = asyncio.get_running_loop()
        while self._under_way and self._under_way[0][0] <= loop.time() + 1e-9:
            self._deliver(self._under_way.popleft()[1])
        if self._under_way:
            loop.call_at(self._under_way[0][0], self._arrive)

    def _deliver(self, item: T) -> None:
        if not self.silent:
            self._hand_on(item)


class FaultyBytes(FaultyWay[bytes]):
    """One direction of a wire for bytes."""

    def __call__(self, data: bytes) -> None:
        """Send bytes."""
        if data:
            super().__call__(data)

    def _damaged(self, data: bytes) -> bytes:
        return damaged(data, self._faults, self._random)

    def _deliver(self, data: bytes) -> None:
        size = 1 if self._faults.one_byte else max(len(data), 1)
        for i in range(0, 0 if self.silent else len(data), size):
            self._hand_on(data[i : i + size])


class FaultyFrames(FaultyWay[can.Message]):
    """One direction of a CAN bus to one node. The bus drops damaged frames itself; an unplugged node is silent."""

    def __init__(self, sink: FrameSink | Callable[[can.Message], None], faults: WireFaults, seed: Any) -> None:
        """Pass the frames that survive to ``sink``; must be created within a running loop."""
        super().__init__(sink if callable(sink) else sink.send, faults, seed, silent_unplugged=True)

    def send(self, msg: can.Message) -> None:
        """Send a frame."""
        self(msg)

    def _kind(self, item: can.Message) -> object:
        return item.arbitration_id


def faulty_device(
    make: Callable[[Write], ByteDevice], faults: WireFaults, seed: int | tuple[int, ...], plug: Plug
) -> Callable[[Write], ByteDevice]:
    """Return ``make`` with its device behind a wire with ``faults``, unchanged if there are none.

    ``seed`` is that of both directions. ``plug`` is the plug of the wire; it is pulled and put back at the times of
    ``faults`` once the device is made.
    """
    if not faults.any:
        return make
    seeds = np.random.SeedSequence(seed).generate_state(2)

    def made(write: Write) -> ByteDevice:
        device = make(FaultyBytes(write, faults, int(seeds[0])))
        plug.schedule(faults.unplug_s, faults.replug_s)
        hear = FaultyBytes(device.received, faults.to_device, int(seeds[1]))
        return SimpleNamespace(received=hear, hung_up=getattr(device, "hung_up", lambda: None))

    return made


class Exchanged:
    """The device at the end of a wire, which may be replaced by another."""

    def __init__(self, device: Any) -> None:
        """Put a device there; one that hears nothing is no harm."""
        self.device = device

    def received(self, data: Any) -> None:
        """Take bytes, or a frame, from the host."""
        getattr(self.device, "received", lambda data: None)(data)

    def hung_up(self) -> None:
        """Tell the device that its connection has ended, if it has a method for that."""
        getattr(self.device, "hung_up", lambda: None)()


def _share(random: np.random.Generator, share: float) -> bool:
    return share > 0 and float(random.random()) < share


def _split(table: Mapping[str, object], kinds: tuple[type, type], where: str) -> tuple[dict[str, object], ...]:
    """Return the parts of a table that belong to each of two kinds; keys of both go to the first.

    HiddenError, which begins with ``where``, for a key of neither.
    """
    known = [{key_of(described): described for described in fields(kind)} for kind in kinds]
    refuse_unknown(table, known[0] | known[1], where)
    first = {key: value for key, value in table.items() if key in known[0]}
    return first, {key: value for key, value in table.items() if key not in first}


def _read(kind: type[T], table: Mapping[str, object], where: str) -> T:
    """Return an object of a kind from a table; errors begin with the place in the file."""
    try:
        return read(kind, table, where)
    except HiddenError as error:
        raise error if str(error).startswith(where) else HiddenError(f"{where}.{error}") from None
