"""The values that cross the seams to hardware, and the types of arrays that drivers, twins and the station share."""

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Stamps = NDArray[np.int64]
    """Instants in ns."""
    Flags = NDArray[np.bool_]
    Octets = NDArray[np.uint8]
else:  # names alone: programs that only control a table, as the guard does, save the 10 MB of numpy
    Floats = Ints = Stamps = Flags = Octets = Any

_Told = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a device's clock relates to the loop's.

    ``offset_s`` is loop time minus device time now, including the least transmission delay; ``drift_ppm`` is its
    growth, positive for a device clock that is slow. The standard uncertainties of both leave out the least delay,
    which cannot be known. ``jitter_rms_s`` is the scatter of arrivals about their mean.
    """

    offset_s: float
    drift_ppm: float
    sd_offset_s: float
    sd_drift_ppm: float
    jitter_rms_s: float


@dataclass(frozen=True, slots=True)
class Frame:
    """One CAN frame with the loop time at which it arrived."""

    t_ns: int
    identifier: int
    extended: bool
    data: bytes


@dataclass(frozen=True, slots=True)
class AxisLimits:
    """What an axis may be commanded to do. ``travel_rad``: angles from home between which it stays, None for unlimited.

    ``acceleration_step_rps2``: the controller rounds accelerations down to a multiple of it. ``resolution_rad``: the
    least difference between readings, 0 where unknown.
    """

    rate_rps: float
    acceleration_rps2: float
    travel_rad: tuple[float, float] | None = None
    acceleration_step_rps2: float = 0.0
    resolution_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class AxisState:
    """Readings of one axis: angle and rate, each with the middle of its own round trip, and half the longer round trip.

    A controller that only reports a mean rate gives its averaging time as ``rate_window_ns``; the instant of the rate
    is then the middle of that.
    """

    angle_t_ns: int
    angle_rad: float
    rate_t_ns: int
    rate_rps: float
    half_width_ns: int
    rate_window_ns: int = 0

    @classmethod
    def told(cls, angle: _Told, rate: _Told, window_s: float = 0.0) -> Self:
        """Return the state from two round trips, each (sent, arrived, value) with times in s of the loop.

        A value is taken to be of the middle of its trip; ``half_width_ns`` is half of the longer trip. ``window_s`` is
        the time over which the controller averages the rate, whose instant is earlier by half of that.
        """
        angle_s, rate_s = ((sent_s + here_s) / 2 for sent_s, here_s, _ in (angle, rate))
        half_width_s = max(here_s - sent_s for sent_s, here_s, _ in (angle, rate)) / 2
        at_ns, rate_ns, half_ns, mean_ns = (
            round(t_s * 1e9) for t_s in (angle_s, rate_s - window_s / 2, half_width_s, window_s)
        )
        return cls(
            angle_t_ns=at_ns,
            angle_rad=angle[2],
            rate_t_ns=rate_ns,
            rate_rps=rate[2],
            half_width_ns=half_ns,
            rate_window_ns=mean_ns,
        )


@dataclass(frozen=True, slots=True)
class AxisStatus:
    """Condition of one axis; ``fault`` is the device's own text, ``caution`` a further remark; empty if there is none.

    ``interlock``: an interlock or emergency stop that blocks motion; empty, too, where the protocol does not report it.
    """

    enabled: bool
    target_reached: bool
    fault: str
    text: str
    caution: str = ""
    interlock: str = ""

    @property
    def trouble(self) -> str:
        """Why the axis must not be moved, empty if it may."""
        return "; ".join(filter(None, (self.fault, self.interlock)))


@dataclass(frozen=True, slots=True, eq=False)
class ImuBlock:
    """Samples of one source.

    ``t_ns`` (n,) is when each was taken, ``arrival_ns`` (n,) when it arrived, both on the loop's clock; ``rate_rps``
    (n, m); ``temperature_c`` (n,), NaN before the first is known; ``counter`` (n,), the device's own count, and
    ``accel_mps2`` (n, 3), where the device has them.
    """

    t_ns: Stamps
    arrival_ns: Stamps
    rate_rps: Floats
    temperature_c: Floats
    counter: Stamps | None = None
    accel_mps2: Floats | None = None


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device reports about itself; empty where its protocol does not report it.

    ``settings`` describes its configuration, in any form, where samples depend on it and the driver does not set it. It
    is not part of the device's identity.
    """

    model: str = ""
    serial: str = ""
    firmware: str = ""
    settings: str = field(default="", compare=False)


@dataclass(slots=True)
class SourceCounts:
    """Samples of a source that were lost, repeated, late (two periods and 50 ms after their time) or discarded."""

    samples: int = 0
    lost: int = 0
    repeated: int = 0
    late: int = 0
    corrupt: int = 0


@dataclass(slots=True)
class LinkCounts:
    """Traffic of a link since its device was built, in bytes or CAN frames, and its errors; meaningful by comparison
    only.

    Answers that timed out, came too late, were damaged, malformed or had a number that was not asked for; bytes
    ``discarded`` as they answered nothing; error frames of CAN, and those that report bus-off.
    """

    opened: int = field(default=0, compare=False)
    received: int = field(default=0, compare=False)
    sent: int = field(default=0, compare=False)
    timeouts: int = 0
    late: int = 0
    corrupt: int = 0
    malformed: int = 0
    foreign: int = 0
    discarded: int = 0
    error_frames: int = 0
    bus_off: int = 0

    @property
    def text(self) -> str:
        """All that is not zero, in words."""
        return ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in asdict(self).items() if count)


@dataclass(slots=True)
class ByteChunk:
    """Bytes with the loop time at which they arrived."""

    t_ns: int
    data: bytes = field(default=b"")
