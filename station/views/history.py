"""Recordings of a folder for display: a row for each, control charts of a device, gauge studies of a station.

Figures in SI, None for what is not known. Loads nothing that takes long: the screen lists thousands of recordings.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimator.estimation.control_charts import ControlChart


@dataclass(kw_only=True, frozen=True, slots=True)
class Move:
    """A state of a gyro that moved by ``sigmas``, of both runs together, since a file that was made ``since_when``."""

    gyro: str
    state: str
    sigmas: float
    since: str
    since_when: str

    @property
    def words(self) -> str:
        """The state without its unit, the gyro, and by how much it moved."""
        return f"{self.state.partition('_r')[0]} of {self.gyro} {self.sigmas:+.1f}"


@dataclass(kw_only=True, frozen=True, slots=True)
class HistoryGyro:
    """Values and standard deviations of the states of one gyro, by the name of the state."""

    name: str
    values: Mapping[str, float | None]
    sds: Mapping[str, float | None]


@dataclass(kw_only=True, frozen=True, slots=True)
class HistoryRow:
    """One recording. If it cannot be read, ``wrong`` says why, and only file and time are known.

    ``bench`` is the name of the station, ``device`` the serial number or, without one, the names of the devices.
    """

    when: str
    serial: str
    bench: str
    script: str
    outcome: str
    reason: str
    operator: str
    accepted_by: str
    accepted_utc: str
    file: str
    wrong: str
    device: str
    when_utc_s: float
    nis_mean: float | None
    moved: Sequence[Move]
    gyros: Sequence[HistoryGyro]


@dataclass(kw_only=True, frozen=True, slots=True, eq=False)
class ChartView:
    """Control charts of runs of a device, in the order of time.

    ``chart`` has values (runs, gyros, 4) and limits, which the ``counted`` runs set. ``units`` are those of the bench
    file.
    """

    bench: str
    script: str
    counted: Sequence[bool]
    gyros: Sequence[str]
    files: Sequence[str]
    when: Sequence[str]
    units: Mapping[str, str]
    chart: "ControlChart"


@dataclass(kw_only=True, frozen=True, slots=True)
class GaugeStudy:
    """Standard deviations of a gauge study by the name of the state, see ``gauge_study``."""

    repeatability: Mapping[str, float | None]
    reproducibility: Mapping[str, float | None]
    parts: Mapping[str, float | None]
    grr: Mapping[str, float | None]
    dof: Mapping[str, float | None]
    ratio: Mapping[str, float | None]
    ratio_low: Mapping[str, float | None]
    ratio_high: Mapping[str, float | None]


@dataclass(kw_only=True, frozen=True, slots=True)
class GaugeView:
    """A gauge study of comparable runs, of which ``failed`` are a FAIL.

    ``repeated`` is the number of devices that were measured twice by one operator on one bench; ``study`` is None for
    fewer than two of them.
    """

    script: str
    gyros: Sequence[str]
    operators: Sequence[str]
    benches: Sequence[str]
    devices: int
    runs: int
    failed: int
    repeated: int
    units: Mapping[str, str]
    study: GaugeStudy | None


_MOVE_KEYS = tuple(field.name for field in fields(Move))
_ROW_KEYS = tuple(field.name for field in fields(HistoryRow) if field.name not in ("moved", "gyros"))


def row_object(row: HistoryRow) -> dict[str, Any]:
    """Return a row for --json: the recording, what moved since the last comparable one, and states by gyro.

    A gyro's states are by their names, with "sd" their standard deviations. Values must be JSON's already.
    """
    from station.views.json_values import named

    return {
        **named(row, _ROW_KEYS),
        "moved": [named(move, _MOVE_KEYS) for move in row.moved],
        "gyros": [{"name": gyro.name, **gyro.values, "sd": gyro.sds} for gyro in row.gyros],
    }


def chart_object(view: ChartView) -> dict[str, Any]:
    """Return control charts for --json."""
    from station.views.json_values import json_object

    whole: dict[str, Any] = json_object(view)
    chart: dict[str, Any] = whole.pop("chart")
    return whole | chart


def gauge_object(view: GaugeView) -> dict[str, Any]:
    """Return a gauge study for --json."""
    from station.views.json_values import json_object

    whole: dict[str, Any] = json_object(view)
    return whole
