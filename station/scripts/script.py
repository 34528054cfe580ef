"""Scripts: what the table is to do, as data that can be checked and drawn before anything moves."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.types import AxisLimits
from station.errors import ScriptError, sentence
from station.schema.tables import Table

_DEG = math.pi / 180
_ROUNDING_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Rest:
    """Stand still."""

    duration_s: float
    label: str = "rest"


@dataclass(frozen=True, slots=True)
class Move:
    """Go to an angle from home and stop there."""

    axis: str
    angle_rad: float
    rate_rps: float
    acceleration_rps2: float
    label: str


@dataclass(frozen=True, slots=True)
class Rotate:
    """Turn at a rate for a time, both ramps included; negative rates turn backwards."""

    axis: str
    rate_rps: float
    duration_s: float
    acceleration_rps2: float
    label: str

    @property
    def turn_rad(self) -> float:
        """Angle that the trapezoid covers."""
        return self.rate_rps * (self.duration_s - abs(self.rate_rps) / self.acceleration_rps2)


Step = Rest | Move | Rotate


@dataclass(frozen=True, slots=True)
class Timed:
    """A step in its place: when it begins, how long it takes, from and to which angle from home its axis goes."""

    step: Step
    start_s: float
    duration_s: float
    from_rad: float
    to_rad: float


@dataclass(frozen=True, slots=True)
class Script:
    """A name and steps in order."""

    name: str
    steps: tuple[Step, ...]

    @property
    def duration_s(self) -> float:
        """Planned time of all steps."""
        return sum(self.durations_s())

    def durations_s(self) -> list[float]:
        """Return the planned time of each step."""
        return [timed.duration_s for timed in self.timeline()]

    def timeline(self) -> list[Timed]:
        """Return when each step is planned to begin, and its way, from home with every axis."""
        angles: dict[str, float] = {}
        found, at_s = [], 0.0
        for step in self.steps:
            start = end = 0.0
            if not isinstance(step, Rest):
                start = angles.get(step.axis, 0.0)
                end = angles[step.axis] = step.angle_rad if isinstance(step, Move) else start + step.turn_rad
            duration_s = _trapezoid_s(abs(end - start), step) if isinstance(step, Move) else step.duration_s
            found.append(Timed(step, at_s, duration_s, start, end))
            at_s += duration_s
        return found


def paper_script() -> Script:
    """Return the paper's 360 s script with real ramps: each axis turns four times in 75 s and ends home."""
    rate, acceleration = 20 * _DEG, 20 / 3 * _DEG
    turns = tuple(Rotate(axis, rate, 75.0, acceleration, f"{axis} at 20 deg/s") for axis in "xyz")
    return Script("paper-360s", (Rest(67.5, "rest before"), *turns, Rest(67.5, "rest after")))


def load_script(path: Path) -> Script:
    """Read a script from TOML; ScriptError with the line of what is wrong."""
    own = Table.load(path, ScriptError, "a script. Give a .toml file").read_all("script.script")
    if not own["step"]:
        raise ScriptError(f'{path}: it has no [[step]]; a step has kind = "rest", "move" or "rotate"')
    return Script(own["name"] or path.stem, tuple(map(_read_step, own["step"])))


def check(script: Script, limits: Mapping[str, AxisLimits]) -> Script:
    """Return the script as the table does it: turns of the same angle, with the accelerations that a controller has.

    ScriptError names the first step that the table cannot do, and the limit.
    """
    driven: list[Step] = []
    angles = dict.fromkeys(limits, 0.0)
    for number, step in enumerate(script.steps, 1):
        where = f"script {script.name}, step {number} ({step.label})"
        if isinstance(step, Rest):
            if not 0 < step.duration_s < math.inf:
                raise ScriptError(f"{where}: a rest of {step.duration_s:g} s. Give a time above zero")
            driven.append(step)
            continue
        if step.axis not in limits:
            raise ScriptError(f"{where}: the table has no axis {step.axis}, only {', '.join(limits)}")
        limit = limits[step.axis]
        if step.rate_rps == 0 or step.acceleration_rps2 <= 0:
            raise ScriptError(f"{where}: rate and acceleration must not be zero")
        if abs(step.rate_rps) > limit.rate_rps * (1 + 1e-9):
            rate, most = abs(step.rate_rps) / _DEG, limit.rate_rps / _DEG
            raise ScriptError(sentence("script.too_fast", where=where, rate_dps=rate, axis=step.axis, most_dps=most))
        if step.acceleration_rps2 > limit.acceleration_rps2 * (1 + 1e-9):
            asked, most = step.acceleration_rps2 / _DEG, limit.acceleration_rps2 / _DEG
            raise ScriptError(sentence("script.accelerates", where=where, dps2=asked, axis=step.axis, most_dps2=most))
        if isinstance(step, Rotate) and step.duration_s <= 2 * abs(step.rate_rps) / step.acceleration_rps2:
            ramp = abs(step.rate_rps) / step.acceleration_rps2
            raise ScriptError(sentence("script.too_short", where=where, length_s=step.duration_s, ramp_s=ramp))
        angles[step.axis] = step.angle_rad if isinstance(step, Move) else angles[step.axis] + step.turn_rad
        low, high = limit.travel_rad or (-math.inf, math.inf)
        if not low - _ROUNDING_RAD <= angles[step.axis] <= high + _ROUNDING_RAD:
            at, least, most = angles[step.axis] / _DEG, low / _DEG, high / _DEG
            raise ScriptError(
                sentence("script.beyond_travel", where=where, axis=step.axis, at_deg=at, least_deg=least, most_deg=most)
            )
        driven.append(_driven(step, limit, where))
    return Script(script.name, tuple(driven))


def rounded(asked: Script, driven: Script) -> list[str]:
    """Return, in words, which accelerations of a script the controller makes less of, and what that comes to."""
    ramps = {
        f"axis {a.axis} at {a.acceleration_rps2 / _DEG:.3g} deg/s2 does {d.acceleration_rps2 / _DEG:.3g}"
        for a, d in zip(asked.steps, driven.steps, strict=True)
        if not isinstance(a, Rest) and not isinstance(d, Rest) and d.acceleration_rps2 < 0.99 * a.acceleration_rps2
    }
    if not ramps:
        return []
    return [
        sentence("script.rounded", ramps=", ".join(sorted(ramps)), driven_s=driven.duration_s, asked_s=asked.duration_s)
    ]


def _driven(step: Move | Rotate, limit: AxisLimits, where: str) -> Move | Rotate:
    """Return a step with the acceleration that the controller makes of it; ScriptError if it has none so small."""
    quantum = limit.acceleration_step_rps2
    if not quantum:
        return step
    if quantum > limit.acceleration_rps2:
        least, most = quantum / _DEG, limit.acceleration_rps2 / _DEG
        raise ScriptError(sentence("script.coarse", where=where, axis=step.axis, least_dps2=least, most_dps2=most))
    acceleration = max(math.floor(step.acceleration_rps2 / quantum * (1 + 1e-9)), 1) * quantum
    if isinstance(step, Move):
        return replace(step, acceleration_rps2=acceleration)
    duration_s = abs(step.turn_rad / step.rate_rps) + abs(step.rate_rps) / acceleration
    return replace(step, acceleration_rps2=acceleration, duration_s=duration_s)


def is_possible(script: Script, limits: Mapping[str, AxisLimits]) -> bool:
    """Return whether the table can do every step."""
    try:
        check(script, limits)
    except ScriptError:
        return False
    return True


def _read_step(table: Table) -> Step:
    kind = table.read("script.step")["kind"]
    own = table.read_all(f"script.{kind}")
    if kind == "rest":
        return Rest(**own)
    if kind == "move":
        own["rate_rps"] = abs(own["rate_rps"])
        made = f"{own['axis']} to {own['angle_rad'] / _DEG:g} deg"
    else:
        made = f"{own['axis']} at {own['rate_rps'] / _DEG:g} deg/s"
    own["label"] = made if own["label"] is None else own["label"]
    return Move(**own) if kind == "move" else Rotate(**own)


def _trapezoid_s(way_rad: float, move: Move) -> float:
    peak = min(abs(move.rate_rps), math.sqrt(way_rad * move.acceleration_rps2))
    return way_rad / peak + peak / move.acceleration_rps2 if peak > 0 else 0.0
