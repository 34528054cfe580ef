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
else:  # names alone: whoever only talks to a table, as the guard of a run does, does without the 10 MB of numpy
    Floats = Ints = Stamps = Flags = Octets = Any

_Told = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a device's clock lies to the loop's.

    ``offset_s`` is loop time less device time now, with the least delay in it; ``drift_ppm`` how much it grows,
    above zero for a device clock that is slow; both with standard uncertainties, in which the least delay, being
    unknowable, has no part. ``jitter_rms_s`` is what arrivals scatter about their mean.
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
    """What an axis may be asked for. ``travel_rad``: the angles from home that it stays between, None for all.

    ``acceleration_step_rps2``: the controller takes multiples of it only, and the one below what it is given.
    ``resolution_rad``: the angle by which readings differ at least, 0 where that is not known.
    """

    rate_rps: float
    acceleration_rps2: float
    travel_rad: tuple[float, float] | None = None
    acceleration_step_rps2: float = 0.0
    resolution_rad: float = 0.0


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
    def told(cls, angle: _Told, rate: _Told, window_s: float = 0.0) -> Self:
        """Return the state of two round trips: when each was sent and here (s of the loop), and what it told."""
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
    """Condition of one axis; ``fault`` is the device's own text, ``caution`` what else to know; empty if nothing.

    ``interlock``: that an interlock or emergency stop keeps it from moving; empty, too, where no protocol tells.
    """

    enabled: bool
    target_reached: bool
    fault: str
    text: str
    caution: str = ""
    interlock: str = ""

    @property
    def trouble(self) -> str:
        """Why the axis must not be moved, empty if it may be."""
        return "; ".join(filter(None, (self.fault, self.interlock)))


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
    """What a device says it is; empty where its protocol does not say.

    ``settings`` is how it is set, in whatever form it says that, where its samples depend on it and the driver does not
    set it. It is no part of who the device is.
    """

    model: str = ""
    serial: str = ""
    firmware: str = ""
    settings: str = field(default="", compare=False)


@dataclass(slots=True)
class SourceCounts:
    """What a source lost, got twice, got late (two periods and 50 ms after its time), or had to throw away."""

    samples: int = 0
    lost: int = 0
    repeated: int = 0
    late: int = 0
    corrupt: int = 0


@dataclass(slots=True)
class LinkCounts:
    """What went over a link since its device was built, bytes or CAN frames, and what went wrong: only that compares.

    Answers that did not come in time, came too late, damaged, malformed or with a number that was not asked; bytes that
    were ``discarded`` as they answered nothing; error frames of CAN, and those of them that tell of a bus that is off.
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
        return ", ".join(f"{count} {what.replace('_', ' ')}" for what, count in asdict(self).items() if count)


@dataclass(slots=True)
class ByteChunk:
    """Bytes with the loop time at which they arrived."""

    t_ns: int
    data: bytes = field(default=b"")
