"""The state of a running run for screens: one frozen value, also as JSON.

All figures in SI units; NaN where nothing is known, null in JSON.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from station.views.typed_json import view_of

AFTER_THIS_STEP, PAUSED = "after this step", "paused"
"""Words of ``Snapshot.paused``, beside ""."""


class Phase(StrEnum):
    """The phase of a run, as opposed to the label of a step."""

    CONNECTING = "connecting"
    ENABLING = "enabling"
    PREPARING = "preparing devices"
    HOMING = "homing"
    RUNNING = "running"
    STOPPING = "coming to rest"
    ESTIMATING = "estimating"


class EventKind(StrEnum):
    """The subject of an event; its text is for people."""

    SCRIPT = "script"
    LINK = "link"
    NOTE = "note"
    AT_REST = "at rest"
    NOT_AT_REST = "not seen at rest"
    TERMINAL = "terminal"


@dataclass(kw_only=True, frozen=True, slots=True)
class AxisSnapshot:
    """One axis of the table: its last reading, and the rate that the script commands now.

    ``state``: "at rest", "turning", the phase before the script ("connecting", "enabling", "homing"), or the table's
    fault in its own words. ``target_rad``: the angle it is moving to, NaN if it does not move.
    """

    name: str
    angle_rad: float
    rate_rps: float
    setpoint_rps: float
    state: str
    target_rad: float = math.nan


@dataclass(frozen=True, slots=True)
class GyroSnapshot:
    """One gyro as seen by the live filter, or from a recording, then without ``nis``.

    ``values`` (k, b_rps, sigma_j_rad, sigma_k_rad) and their standard deviations ``sds``; ``nis``: mean square of its
    normalised innovations over the last half minute, 1 for a correct filter. ``rate_rps``: its newest sample;
    ``expected_rps``: the output of a gyro with these values at the last motion of the table; ``residual``: its last
    normalised innovation, mostly within 2 for a correct filter.
    """

    name: str
    source: str
    values: tuple[float, ...]
    sds: tuple[float, ...]
    nis: float = math.nan
    rate_rps: float = math.nan
    residual: float = math.nan
    expected_rps: float = math.nan

    @property
    def output(self) -> float:
        """Its newest sample."""
        return self.rate_rps

    @property
    def expected(self) -> float:
        """What was expected of it."""
        return self.expected_rps

    @property
    def full_name(self) -> str:
        """Its source and name: two devices may have gyros of one name."""
        return " ".join(dict.fromkeys((self.source, self.name)))


@dataclass(kw_only=True, frozen=True, slots=True)
class AccelerometerSnapshot:
    """One accelerometer as seen by the live filter.

    ``values`` (k, b_mps2, sigma_j_rad, sigma_k_rad) and their standard deviations ``sds``; ``nis``, ``residual``: as of
    a gyro. ``force_mps2``: its newest output; ``expected_mps2``: that of an accelerometer with these values where the
    table stands, without the force of its motion. ``left_out``: why its last samples were not used, "" if they were.
    """

    name: str
    source: str
    values: tuple[float, ...]
    sds: tuple[float, ...]
    nis: float = math.nan
    force_mps2: float = math.nan
    residual: float = math.nan
    expected_mps2: float = math.nan
    left_out: str = ""

    @property
    def output(self) -> float:
        """Its newest sample."""
        return self.force_mps2

    @property
    def expected(self) -> float:
        """What was expected of it."""
        return self.expected_mps2

    @property
    def full_name(self) -> str:
        """Its source and name: two devices may have accelerometers of one name."""
        return " ".join(dict.fromkeys((self.source, self.name)))


@dataclass(kw_only=True, frozen=True, slots=True)
class ArmSnapshot:
    """What the accelerometers of a source have in common: their lever arm (x, y, z), their delay, and sigmas.

    ``nis_recent`` per degree of freedom is that of their innovations over the last half minute, ``recent`` the number
    of these.
    """

    source: str
    arm_m: tuple[float, ...]
    arm_sd_m: tuple[float, ...]
    delay_s: float
    delay_sd_s: float
    nis_recent: float = math.nan
    recent: int = 0


@dataclass(frozen=True, slots=True)
class SourceSnapshot:
    """One source: its counts, its rate over the last two seconds, delay and jitter of its samples.

    ``latency_s`` is from the instant of a sample to its arrival, without the least delay, which cannot be known;
    ``jitter_s`` the rms scatter of arrivals; ``link``: "ok", "reopening" or "silent".
    """

    name: str
    device: str
    rate_hz: float
    samples: int
    lost: int
    repeated: int
    late: int
    corrupt: int
    latency_s: float
    jitter_s: float
    temperature_c: float
    link: str


@dataclass(frozen=True, slots=True)
class SeriesSnapshot:
    """The newest value of a column that a device appends to the recording."""

    device: str
    column: str
    unit: str
    value: float


@dataclass(frozen=True, slots=True)
class Snapshot:
    """State of a run at one instant; times in seconds of the loop's clock. ``label``: that of the present step, or "".

    ``remaining_s`` is the least remaining time, ``longer_s`` by how much it may be longer: 0 if known, infinite or NaN
    for no limit. ``nis_mean`` per degree of freedom is over the whole run, ``nis_recent`` over the last half minute;
    ``whiteness``: correlation of the innovations with those of the previous block, 0 for a good filter; ``recent``: the
    number of innovations of the latter two. ``paused``: "", ``AFTER_THIS_STEP`` or ``PAUSED``. ``links``: traffic and
    errors of each device's link, in words.
    """

    phase: Phase
    label: str
    elapsed_s: float
    remaining_s: float
    samples: int
    lost: int
    nis_mean: float
    nis_recent: float = math.nan
    whiteness: float = math.nan
    paused: str = ""
    axes: tuple[AxisSnapshot, ...] = ()
    sources: tuple[SourceSnapshot, ...] = ()
    gyros: tuple[GyroSnapshot, ...] = ()
    recent: int = 0
    links: tuple[str, ...] = ()
    longer_s: float = 0.0
    series: tuple[SeriesSnapshot, ...] = ()
    accelerometers: tuple[AccelerometerSnapshot, ...] = ()
    arms: tuple[ArmSnapshot, ...] = ()

    @property
    def sensors(self) -> tuple[GyroSnapshot | AccelerometerSnapshot, ...]:
        """Gyros, then accelerometers."""
        return (*self.gyros, *self.accelerometers)

    def called(self, sensor: GyroSnapshot | AccelerometerSnapshot) -> str:
        """Return what a sensor is called: its name, with that of its source if another source has one of that name."""
        alike = sum(other.name == sensor.name for other in self.sensors)
        return sensor.name if alike < 2 else sensor.full_name

    @property
    def doing(self) -> str:
        """Current activity in words: the step's label while the script runs, else the phase."""
        return self.label or self.phase

    @property
    def share(self) -> float:
        """Share of the run that is done, 0 to 1; half of the time by which it may be longer counts as remaining."""
        longer_s = self.longer_s if math.isfinite(self.longer_s) else 0.0
        return self.elapsed_s / max(self.elapsed_s + self.remaining_s + longer_s / 2, 1e-9)


def snapshot_of(message: Mapping[str, Any]) -> Snapshot:
    """Return the snapshot in an object of JSON; unknown keys are ignored.

    KeyError, TypeError or ValueError if it is not a snapshot.
    """
    return view_of(Snapshot, message)
