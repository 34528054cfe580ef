"""Scripts: the motion of the table as data that can be checked and drawn before anything moves."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

from drivers.packaged import packaged_text
from drivers.plugins import PluginError, Registry
from drivers.types import AxisLimits
from station.errors import ScriptError, sentence
from station.schema.tables import Table, known_in
from station.scripts.steps.kind import LABEL, Demand, Part, Span, Step, StepKind, Turn, total
from station.scripts.steps.move import Move as Move
from station.scripts.steps.registry import known_steps
from station.scripts.steps.rest import Rest as Rest
from station.scripts.steps.rotate import Rotate as Rotate

S = TypeVar("S", bound=Step)

ONE_AXIS = "full-imu-one-axis"
SHIPPED = ("full-imu", "full-imu-two-axes", ONE_AXIS)
"""Scripts that come with the station, by name: of a whole IMU on a table of three, of two axes, or of one."""
_DEG = math.pi / 180
_ROUNDING_RAD = 1e-9


@dataclass(frozen=True, slots=True)
class Timed:
    """A step with its earliest beginning in the plan, its duration and its parts."""

    step: Step
    start_s: float
    span: Span
    parts: tuple[Part, ...]

    def turns(self) -> Iterator[tuple[float, Turn]]:
        """Yield its turns, each with the time at which it begins."""
        at_s = self.start_s
        for part in self.parts:
            if part.turn is not None:
                yield at_s, part.turn
            at_s += part.span.least_s

    @property
    def last_turn(self) -> Turn | None:
        """The last of its turns, None of a step in which all axes stand."""
        return next((part.turn for part in reversed(self.parts) if part.turn is not None), None)


@dataclass(frozen=True, slots=True)
class Script:
    """A name and steps in order; ``plugins`` are the packages with kinds of its steps."""

    name: str
    steps: tuple[Step, ...]
    plugins: tuple[str, ...] = field(default=(), repr=False)

    @property
    def span(self) -> Span:
        """Planned time of all steps."""
        return total(self.spans())

    @property
    def least_s(self) -> float:
        """Planned time of all steps if each takes as little time as it may: all that a plan can count on."""
        return self.span.least_s

    def spans(self) -> list[Span]:
        """Return the planned time of each step."""
        return [timed.span for timed in self.timeline()]

    def timeline(self) -> list[Timed]:
        """Return each step with its earliest beginning in s, its span and its parts; every axis starts from home."""
        angles_rad: dict[str, float] = {}
        timeline = []
        at_s = 0.0
        for step in self.steps:
            parts = tuple(step.parts(angles_rad))
            span = total([part.span for part in parts])
            timeline.append(Timed(step, at_s, span, parts))
            at_s += span.least_s
            for part in parts:
                if part.turn is not None:
                    angles_rad[part.turn.axis] = part.turn.to_rad
        return timeline


def paper_script() -> Script:
    """Return the paper's 360 s script with real ramps: each axis turns four times in 75 s and ends home."""
    rate, acceleration = 20 * _DEG, 20 / 3 * _DEG
    turns = tuple(Rotate(axis, rate, 75.0, acceleration, f"{axis} at 20 deg/s") for axis in "xyz")
    return Script("paper-360s", (Rest(67.5, "rest before"), *turns, Rest(67.5, "rest after")))


def load_script(path: Path, plugins: Iterable[Path] = (), axis: str = "x") -> Script:
    """Return the script of a TOML file, or the shipped one of this name; that for one axis is about ``axis``.

    A shipped one is meant if ``path`` has no suffix and does not exist. ``plugins`` are Python files of a bench that
    may define kinds of steps. ScriptError, with the line where there is one, if the file is missing or invalid or has
    no step; whether a table can do it is not checked.
    """
    if path.suffix or path.exists():
        top = Table.load(path, ScriptError, "a script. Give a .toml file")
    elif path.name in SHIPPED:
        text = packaged_text("station.scripts.shipped", f"{path.name}.toml")
        if path.name == ONE_AXIS:
            text = text.replace('axis = "x"', f'axis = "{axis}"')
        top = Table.parse(text, path.name, ScriptError)
    else:
        raise ScriptError(f"{path}: there is no such script. Give a .toml file, or one of {', '.join(SHIPPED)}")
    own = top.read_all("script.script")
    try:
        known = known_steps(plugins)
    except PluginError as error:
        raise ScriptError(f"{path}: {error}") from None
    if not own["step"]:
        raise ScriptError(f"{path}: it has no [[step]]; the kinds of steps are {', '.join(known)}")
    kinds = [_kind_of(table, known) for table in own["step"]]
    steps = tuple(_read_step(table, kind) for table, kind in zip(own["step"], kinds, strict=True))
    origins = {known.origin(kind.name) for kind in kinds} - {""}
    return Script(own["name"] or path.stem, steps, tuple(sorted(origins)))


def _kind_of(table: Table, known: Registry[StepKind]) -> StepKind:
    kind: StepKind = table.read("script.step", kind=known_in(known))["kind"]
    return kind


def _read_step(table: Table, kind: StepKind) -> Step:
    values = {key.field or key.name: table.option(key) for key in kind.keys}
    label = table.option(LABEL)
    table.done()
    unlabelled = kind.make(**values, label="")
    return unlabelled if label == "" else kind.make(**values, label=label or unlabelled.words())


def check(script: Script, limits: Mapping[str, AxisLimits]) -> Script:
    """Return the script as the table carries it out: the same angles, with accelerations that the controller can do.

    ScriptError names the first step that the table cannot do, and the limit.
    """
    driven: list[Step] = []
    angles_rad = dict.fromkeys(limits, 0.0)
    for number, step in enumerate(script.steps, 1):
        try:
            driven.append(check_step(step, limits, angles_rad))
        except ScriptError as error:
            raise ScriptError(f"script {script.name}, step {number} ({step.label}): {error}") from None
    return replace(script, steps=tuple(driven))


def check_step(step: S, limits: Mapping[str, AxisLimits], angles_rad: dict[str, float]) -> S:
    """Return a step as the table carries it out, with accelerations that the controller can do.

    ``angles_rad``, where the axes stand before, are updated to those at its end. ScriptError if the table cannot do it.
    """
    for demand in step.demands():
        _check_demand(demand, limits)
    if problem := step.problem():
        raise ScriptError(problem)
    for part in step.parts(angles_rad):
        if part.turn is not None:
            check_turn(part.turn, limits)
            angles_rad[part.turn.axis] = part.turn.to_rad
    return step.driven(limits)


def check_turn(turn: Turn, limits: Mapping[str, AxisLimits]) -> None:
    """Raise ScriptError for a turn that its axis cannot do."""
    _check_demand(Demand(turn.axis, turn.rate_rps, turn.acceleration_rps2), limits)
    _check_travel(turn, limits[turn.axis])


def _check_demand(demand: Demand, limits: Mapping[str, AxisLimits]) -> None:
    """Raise ScriptError for a rate or acceleration that is zero or beyond the limit of its axis, or an unknown axis.

    Accelerations must be positive; the sign of a rate is a direction.
    """
    axis = demand.axis
    if axis not in limits:
        raise ScriptError(f"the table has no axis {axis}, only {', '.join(limits)}")
    limit = limits[axis]
    if demand.rate_rps == 0 or demand.acceleration_rps2 <= 0:
        raise ScriptError("rate and acceleration must not be zero")
    if abs(demand.rate_rps) > limit.rate_rps * (1 + 1e-9):
        rate_dps = abs(demand.rate_rps) / _DEG
        raise ScriptError(sentence("script.too_fast", rate_dps=rate_dps, axis=axis, most_dps=limit.rate_rps / _DEG))
    if demand.acceleration_rps2 > limit.acceleration_rps2 * (1 + 1e-9):
        asked_dps2 = demand.acceleration_rps2 / _DEG
        most_dps2 = limit.acceleration_rps2 / _DEG
        raise ScriptError(sentence("script.accelerates", dps2=asked_dps2, axis=axis, most_dps2=most_dps2))


def _check_travel(turn: Turn, limit: AxisLimits) -> None:
    """Raise ScriptError if a turn ends beyond the travel of its axis; an axis without a travel turns without limit."""
    low, high = limit.travel_rad or (-math.inf, math.inf)
    if low - _ROUNDING_RAD <= turn.to_rad <= high + _ROUNDING_RAD:
        return
    raise ScriptError(
        sentence(
            "script.beyond_travel",
            axis=turn.axis,
            at_deg=turn.to_rad / _DEG,
            least_deg=low / _DEG,
            most_deg=high / _DEG,
        )
    )


def rounded(asked: Script, driven: Script) -> list[str]:
    """Return one sentence on the accelerations that the controller rounds down by more than 1 %, in a list.

    It also names both lengths of the script. Empty if there are none. The scripts must have the same steps.
    """
    ramps = set()
    for asked_step, driven_step in zip(asked.steps, driven.steps, strict=True):
        for wanted, made in zip(asked_step.demands(), driven_step.demands(), strict=True):
            if made.acceleration_rps2 < 0.99 * wanted.acceleration_rps2:
                asked_dps2 = wanted.acceleration_rps2 / _DEG
                made_dps2 = made.acceleration_rps2 / _DEG
                ramps.add(f"axis {wanted.axis} at {asked_dps2:.3g} deg/s2 does {made_dps2:.3g}")
    if not ramps:
        return []
    return [sentence("script.rounded", ramps=", ".join(sorted(ramps)), driven_s=driven.least_s, asked_s=asked.least_s)]


def is_possible(script: Script, limits: Mapping[str, AxisLimits]) -> bool:
    """Return whether the table can do every step."""
    try:
        check(script, limits)
    except ScriptError:
        return False
    return True
