"""The interfaces to hardware, and optional abilities of devices. Plug-ins need not inherit from these."""

from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Protocol, runtime_checkable

from drivers.types import (
    Alignment,
    AxisLimits,
    AxisState,
    AxisStatus,
    ByteChunk,
    Floats,
    Frame,
    Identity,
    ImuBlock,
    SourceCounts,
    Stamps,
)


class Openable(Protocol):
    """A link, source or table that can be closed and opened again."""

    async def open(self) -> None:
        """Open; LinkLost if it is not there."""

    def close(self) -> None:
        """Close; twice is once."""


class Device(Openable, Protocol):
    """A driver of any kind: it can be reopened and identifies itself."""

    async def identify(self) -> Identity:
        """Return the device's identity, after ``open``; empty where it cannot be asked."""


@runtime_checkable
class MadeSafe(Openable, Protocol):
    """A device that must be left in a safe state."""

    async def make_safe(self) -> None:
        """Bring the device to its safe state and confirm it, whatever the state of the link; else DeviceError.

        A link that is lost, or was never opened, is opened first.
        """


@runtime_checkable
class ChecksSetPoint(Protocol):
    """A device that can tell, without acting, whether it would accept a set point."""

    async def refused(self, set_point: float) -> str:
        """Return why it would not take this set point (SI, temperatures in degC), empty if it would."""


@runtime_checkable
class AppendsSeries(Protocol):
    """A device that measures something itself and appends columns to the recording."""

    @property
    def columns(self) -> Mapping[str, str]:
        """Names of its columns, in their order, each with its unit."""

    def rows(self) -> AsyncIterator[tuple[int, Sequence[float]]]:
        """Yield instants (ns of the loop's clock) and a value for each column, for ever; LinkLost if the link ends."""


class ByteLink(Openable, Protocol):
    """A stream of bytes to one device."""

    async def receive(self) -> ByteChunk:
        """Return the next bytes; LinkLost when the other end is gone."""

    def write(self, data: bytes) -> None:
        """Send bytes."""


class FrameLink(Openable, Protocol):
    """A CAN bus."""

    async def receive(self) -> list[Frame]:
        """Return the frames since the last call, waiting for the first; LinkLost if the bus is gone."""

    def send(self, frame: Frame) -> None:
        """Send a frame, whatever its stamp; LinkLost if the bus refuses it."""


class Turntable(Openable, Protocol):
    """A rate table of one to three axes, named x, y, z."""

    @property
    def limits(self) -> Mapping[str, AxisLimits]:
        """Limits by axis."""

    homing: set[str]
    """Axes that ``home`` turns and that are not there yet."""

    async def open(self) -> None:
        """Connect and check that every axis answers; nothing changes on an axis that is enabled."""

    async def identify(self) -> Identity:
        """Return the controller's identity; empty where it cannot be asked."""

    async def enable(self) -> None:
        """Bring every axis to holding position under power."""

    async def home(self) -> None:
        """Find the home position of every axis; their angles count from there."""

    async def jog(self, axis: str, rate_rps: float, acceleration_rps2: float) -> None:
        """Turn at a rate until the next command."""

    async def move(self, axis: str, angle_rad: float, rate_rps: float, acceleration_rps2: float) -> None:
        """Start towards an angle from home (turns are not wrapped) with a trapezoid of rate."""

    async def read(self, axis: str) -> AxisState:
        """Measure angle and rate."""

    async def status(self, axis: str) -> AxisStatus:
        """Get condition and fault."""

    async def stop(self) -> str:
        """Bring every axis to rest by a controlled stop, whatever the state of the link, and return what was seen.

        A link that is lost, or on which the last request was not answered, is reopened at once. Every axis gets the
        stop, the one that was moved last first, and is watched until it stands. DeviceError, after some ten seconds
        without news, with the last readings of axes that may still turn.
        """

    async def abort(self) -> None:
        """Stop every axis at once, as hard as the controller can, and wait for it."""

    async def reset_fault(self) -> None:
        """Clear the faults that can be cleared."""

    async def disable(self) -> None:
        """Take power off."""


class ImuSource(Openable, Protocol):
    """A device under test, or a part of one, that sends samples without being asked."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sources it delivers."""

    def counts(self, name: str) -> SourceCounts:
        """Get the counts of one source."""

    def alignment(self, name: str) -> Alignment | None:
        """Get how the clock of one source lies to the loop's; None while that is not known."""

    async def identify(self) -> Identity:
        """Return the device's identity, after ``open`` and before ``blocks``; empty where it cannot be asked."""

    def blocks(self) -> AsyncIterator[tuple[str, ImuBlock]]:
        """Yield (source name, block) as they come; LinkLost when the link ends."""

    def flush(self) -> list[tuple[str, ImuBlock]]:
        """Return the samples still held back for their timing, at the end of a run."""


@runtime_checkable
class EarlySource(Protocol):
    """An IMU source that holds samples back until it can time them, and reports arrivals before that."""

    def arrived(self) -> list[tuple[str, Stamps, Floats]]:
        """Return source name, arrivals (n,) in ns and rates (n, m) of samples that came since the last call.

        Once called it is to be called every few milliseconds.
        """


@runtime_checkable
class TellsOrders(Protocol):
    """A table whose drives report the last command they were given, by whatever program."""

    async def orders(self, axis: str) -> Mapping[str, float]:
        """Return by name the registers in which a drive keeps its last commands."""
