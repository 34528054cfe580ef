"""What a session says of itself and of its end, read from its messages as values."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from drivers.types import AxisLimits
from station.views.figures import STATE_FIGURES, StateUnit, figures_from

_STATES = ("k", "b_rps", "sigma_rad", "sigma_rad")
"""Keys of the limits of the four states."""
_FORCE_STATES = ("k", "b_mps2", "sigma_rad", "sigma_rad")
"""Keys of the limits of the four states of accelerometers."""
_UNLIMITED: tuple[float, ...] = (math.inf,) * len(_STATES)
_UNWRITTEN: tuple[str, ...] = ("",) * len(_STATES)


@dataclass(kw_only=True, frozen=True, slots=True)
class SentLimits:
    """The limits of a session's bench: sizes of the four states in SI, infinite where there is none.

    ``written`` are the sizes as in the bench file, empty where not known. ``force_sizes`` and ``force_written`` are
    those of accelerometers. ``nis`` are the limits of the mean NIS that there are, ``figures`` the states in the units
    of the bench.
    """

    sizes: tuple[float, ...] = _UNLIMITED
    written: tuple[str, ...] = _UNWRITTEN
    force_sizes: tuple[float, ...] = _UNLIMITED
    force_written: tuple[str, ...] = _UNWRITTEN
    nis: tuple[float, ...] = ()
    figures: tuple[StateUnit, ...] = STATE_FIGURES

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the limits in an object of JSON; what is missing there has its default, as of another version.

        TypeError or ValueError for a limit that is no number.
        """
        forces = data.get("forces")
        sizes, written = _sizes(data, _STATES)
        force_sizes, force_written = _sizes(forces if isinstance(forces, Mapping) else {}, _FORCE_STATES)
        return cls(
            sizes=sizes,
            written=written,
            force_sizes=force_sizes,
            force_written=force_written,
            nis=tuple(float(data[key]) for key in ("nis_low", "nis_high") if data.get(key)),
            figures=figures_from(data.get("units")),
        )


def _sizes(data: Mapping[str, Any], keys: tuple[str, ...]) -> tuple[tuple[float, ...], tuple[str, ...]]:
    """Return the limits of the states with these keys, infinite for none, and how they were written, "" if unknown."""
    sizes = tuple(math.inf if data.get(key) is None else float(data[key]) for key in keys)
    written = data.get("written")
    texts: Mapping[str, Any] = written if isinstance(written, Mapping) else {}
    return sizes, tuple(str(texts.get(key, "")) for key in keys)


@dataclass(kw_only=True, frozen=True, slots=True)
class Greeting:
    """The first message of a session.

    ``bench_file`` is empty for the built-in bench. ``manual``: the table is driven by hand, within ``axes`` by name.
    ``steps_begin_s`` are by plan, None if some duration is not known in advance.
    """

    bench: str
    bench_file: str
    recording: str
    script: str
    steps_begin_s: tuple[float, ...] | None
    manual: bool = False
    axes: Mapping[str, AxisLimits]
    limits: SentLimits

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the greeting in an object of JSON; KeyError, TypeError or ValueError if it is none.

        Bench file, manual mode, axes and limits may be missing; bench, recording and script may not.
        """
        script = data["script"]
        return cls(
            bench=str(data["bench"]),
            bench_file=data.get("bench_file") or "",
            recording=str(data["recording"]),
            script=str(script["name"]),
            steps_begin_s=_steps_begin_s(script),
            manual=bool(data.get("manual")),
            axes={name: _axis_limits(limits) for name, limits in dict(data.get("table") or {}).items()},
            limits=SentLimits.read(dict(data.get("limits") or {})),
        )

    @property
    def recording_path(self) -> Path:
        """The recording that the session writes."""
        return Path(self.recording)


def _steps_begin_s(script: Mapping[str, Any]) -> tuple[float, ...] | None:
    """Return when steps begin by plan; None if the script may take longer than that."""
    if script.get("longest_s", script.get("duration_s")) != script.get("duration_s"):
        return None
    return tuple(float(step["start_s"]) for step in script.get("steps", []))


def _axis_limits(data: Mapping[str, Any]) -> AxisLimits:
    travel = data.get("travel_rad")
    return AxisLimits(
        rate_rps=float(data["rate_rps"]),
        acceleration_rps2=float(data["acceleration_rps2"]),
        travel_rad=(float(travel[0]), float(travel[1])) if travel else None,
    )


@dataclass(kw_only=True, frozen=True, slots=True)
class RunEnd:
    """The last message of a session: the outcome of its run, and why."""

    outcome: str
    reason: str

    @classmethod
    def read(cls, data: Mapping[str, Any]) -> Self:
        """Return the end of a run in an object of JSON."""
        return cls(outcome=str(data.get("outcome") or ""), reason=str(data.get("reason") or ""))
