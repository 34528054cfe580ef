"""The four seams to hardware, and the values that cross them. Nothing inherits from these to plug in."""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from drivers.arrays import Floats, Stamps
from drivers.host_fit import Alignment

_Told = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Frame:
    """One CAN frame with the loop time at which it arrived."""

    t_ns: int
    identifier: int
    extended: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What an axis may be asked for. ``travel_rad``: the angles from home that it stays between, None for all.

    ``acceleration_step_rps2``: the controller takes multiples of it only, and the one below what it is given.
    """

    rate_rps: float
    acceleration_rps2: float
    travel_rad: tuple[float, float] | None = None
    acceleration_step_rps2: float = 0.0


@dataclass(frozen=True, slots=True)
class AxisState:
    """Readback of one axis: angle and rate, each with the middle of its own round trip, and its half-width.

    A controller that only tells a mean rate gives the time that it is the mean of as ``rate_window_ns``; the rate's
    instant is then the middle of that.
    """

    angle_t_ns: int
    angle_rad: float
    rate_t_ns: int
    rate_rps: float
    half_width_ns: int
    rate_window_ns: int = 0

    @classmethod
    def told(cls, angle: _Told, rate: _Told, window_s: float = 0.0) -> AxisState:
        """Return the state of two round trips: when each was sent and here (s of the loop), and what it told."""
        angle_s, rate_s = ((sent_s + here_s) / 2 for sent_s, here_s, _ in (angle, rate))
        half_width_s = max(here_s - sent_s for sent_s, here_s, _ in (angle, rate)) / 2
        at_ns, rate_ns, half_ns, mean_ns = (
            round(t_s * 1e9) for t_s in (angle_s, rate_s - window_s / 2, half_width_s, window_s)
        )
        return cls(at_ns, angle[2], rate_ns, rate[2], half_ns, mean_ns)


@dataclass(frozen=True, slots=True)
class AxisStatus:
    """Condition of one axis; ``fault`` is the device's own text, ``caution`` what else to know; empty if nothing."""

    enabled: bool
    target_reached: bool
    fault: str
    text: str
    caution: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class ImuBlock:
    """Samples of one source.

    ``t_ns`` (n,) when each was taken, on the loop's clock; ``arrival_ns`` (n,) when it was here; ``rate_rps``
    (n, m); ``temperature_c`` (n,), NaN before the first is known; ``counter`` (n,) the device's own count and
    ``accel_mps2`` (n, 3), where there are such.
    """

    t_ns: Stamps
    arrival_ns: Stamps
    rate_rps: Floats
    temperature_c: Floats
    counter: Stamps | None = None
    accel_mps2: Floats | None = None


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says it is; empty where its protocol does not say."""

    model: str = ""
    serial: str = ""
    firmware: str = ""


@dataclass(slots=True)
class SourceCounts:
    """What a source lost, got twice, got late (two periods and 50 ms after its time), or had to throw away."""

    samples: int = 0
    lost: int = 0
    repeated: int = 0
    late: int = 0
    corrupt: int = 0


@dataclass(slots=True)
class ByteChunk:
    """Bytes with the loop time at which they arrived."""

    t_ns: int
    data: bytes = field(default=b"")


class ByteLink(Protocol):
    """A stream of bytes to one device."""

    async def open(self) -> None:
        """Open the link; LinkLost if there is none."""

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the other end is gone."""

    def write(self, data: bytes) -> None:
        """Send bytes."""

    def close(self) -> None:
        """Close; twice is once."""


class FrameLink(Protocol):
    """A CAN bus."""

    async def open(self) -> None:
        """Open the bus; LinkLost if there is none."""

    async def receive(self) -> list[Frame]:
        """Return the frames that have come since the last call, waiting for the first; LinkLost if gone."""

    def send(self, frame: Frame) -> None:
        """Send a frame, whatever its stamp; LinkLost if the bus does not take it."""

    def close(self) -> None:
        """Close; twice is once."""


class Turntable(Protocol):
    """A rate table of one to three axes, named x, y, z."""

    @property
    def limits(self) -> Mapping[str, AxisLimits]:
        """Limits by axis."""

    homing: set[str]
    """Axes that ``home`` turns and that are not there yet."""

    async def open(self) -> None:
        """Connect and see that every axis answers; an axis that is enabled is told nothing by that."""

    async def identify(self) -> Identity:
        """Ask the controller what it is; empty where it cannot be asked."""

    async def enable(self) -> None:
        """Bring every axis to holding position under power."""

    async def home(self) -> None:
        """Find the home position of every axis; their angles count from there."""

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn at a rate until told otherwise."""

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start towards an angle from home (turns are not wrapped) with a trapezoid of rate."""

    async def read(self, axis: str) -> AxisState:
        """Measure angle and rate."""

    async def status(self, axis: str) -> AxisStatus:
        """Get condition and fault."""

    async def stop(self) -> str:
        """Bring every axis to rest by a controlled stop, whatever has become of the link, and say what was seen.

        A link that is lost, or on which the last request was not answered, is opened again at once. Every axis is told,
        the one that was moved last first, and watched until it stands. DeviceError, after some ten seconds without
        news, tells what was seen last of those that may still turn.
        """

    async def abort(self) -> None:
        """Stop every axis at once, as hard as the controller can, and wait for it."""

    async def reset_fault(self) -> None:
        """Clear the faults that can be cleared."""

    async def disable(self) -> None:
        """Take power off."""

    def close(self) -> None:
        """Drop the link."""


class ImuSource(Protocol):
    """A device under test, or a part of one, that gives samples by itself."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sources it delivers."""

    def counts(self, name: str) -> SourceCounts:
        """Get the counts of one source."""

    def alignment(self, name: str) -> Alignment | None:
        """Get how the clock of one source lies to the loop's; None while that is not known."""

    async def open(self) -> None:
        """Open the link."""

    async def identify(self) -> Identity:
        """Ask the device what it is, after ``open`` and before ``blocks``; empty where it cannot be asked."""

    def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield (source name, block) as they come; LinkLost when the link ends."""

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the samples still held back for their timing, at the end of a run."""

    def close(self) -> None:
        """Close the link."""
