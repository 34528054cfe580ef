"""What the station's commands answer to the screen as JSON, read back as values."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Self, TypeVar

from drivers.types import Identity
from station.computer.finding import Finding
from station.run.snapshot import of_type

Value = TypeVar("Value")


@dataclass(kw_only=True, frozen=True, slots=True)
class Reply(Generic[Value]):
    """The end of a command: its exit code, and its answer or, if that is None, the ``reason`` in words."""

    code: int
    value: Value | None
    reason: str


@dataclass(kw_only=True, frozen=True, slots=True)
class AxisAnswer:
    """One axis of a table: ``text`` is its condition in words."""

    name: str
    text: str
    angle_rad: float


@dataclass(kw_only=True, frozen=True, slots=True)
class SourceAnswer:
    """Two seconds of one source; ``temperature_c`` is NaN if it is not known."""

    name: str
    rate_hz: float
    lost: int
    temperature_c: float


@dataclass(kw_only=True, frozen=True, slots=True)
class DeviceAnswer:
    """What a device answered; ``wrong`` says what is wrong and what to do, empty if nothing is."""

    device: str
    kind: str
    link: str
    identity: Identity
    axes: tuple[AxisAnswer, ...]
    sources: tuple[SourceAnswer, ...]
    wrong: tuple[str, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class CheckAnswer:
    """The answer of `station check`: the devices, the table first, and findings on this computer."""

    devices: tuple[DeviceAnswer, ...]
    computer: tuple[Finding, ...] = ()

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the answer in an object of JSON; KeyError, TypeError or ValueError if it is none."""
        answer: Self = of_type(cls, data)
        return answer


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedGyro:
    """The predicted sigmas of a gyro, None where there is none; ``reached``: they are as small as required."""

    name: str
    sd: tuple[float | None, ...]
    reached: bool


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedAccelerometer:
    """The predicted sigmas of an accelerometer; ``name`` begins with that of its device if there are several."""

    name: str
    sd: tuple[float | None, ...]


@dataclass(kw_only=True, frozen=True, slots=True)
class PlannedAxis:
    """An axis of the table, and whether the script proves that nothing about it drifts."""

    axis: str
    proved: bool


@dataclass(kw_only=True, frozen=True, slots=True)
class PlanAnswer:
    """The answer of `station plan`: predicted and required sigmas in SI, in the order of the states."""

    gyros: tuple[PlannedGyro, ...]
    required: tuple[float | None, ...]
    constancy: tuple[PlannedAxis, ...]
    accelerometers: tuple[PlannedAccelerometer, ...] = ()

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the answer in an object of JSON; KeyError, TypeError or ValueError if it is none."""
        gyros = tuple(
            PlannedGyro(name=row["name"], sd=tuple(row["sd"].values()), reached=row["reached"]) for row in data["gyros"]
        )
        if not gyros:
            raise ValueError("a plan without gyros")
        return cls(
            gyros=gyros,
            required=tuple((data.get("required") or {}).values()),
            constancy=tuple(of_type(PlannedAxis, axis) for axis in data.get("constancy", [])),
            accelerometers=tuple(_planned_accelerometers(data.get("accelerometers", []))),
        )

    @property
    def missed(self) -> list[str]:
        """Names of the gyros that do not reach the required sigmas."""
        return [gyro.name for gyro in self.gyros if not gyro.reached]


@dataclass(kw_only=True, frozen=True, slots=True)
class InvestigationAnswer:
    """The answer of `station investigate`, also as it is stored beside a recording.

    ``next_script`` is the script that tells explanations apart, None if none is needed. ``view`` is the whole object:
    it may be damaged, or of another version of the station.
    """

    verdict: str
    next_script: str | None
    view: Mapping[str, Any]

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the answer in an object of JSON; KeyError or ValueError for an object without a verdict."""
        if not data["verdict"]:
            raise ValueError("an investigation without a verdict")
        return cls(verdict=str(data["verdict"]), next_script=data.get("next_script"), view=data)


def _planned_accelerometers(devices: Sequence[Mapping[str, Any]]) -> Iterator[PlannedAccelerometer]:
    """Yield the accelerometers of the devices of a plan in JSON."""
    for device in devices:
        before = f"{device['device']} " if len(devices) > 1 else ""
        for row in device["accelerometers"]:
            yield PlannedAccelerometer(name=f"{before}{row['name']}", sd=tuple(row["sd"].values()))
