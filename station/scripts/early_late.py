"""A script of the same length as another one that turns each axis early and again late, so that drifts show."""

import math
from collections.abc import Mapping, Sequence

from drivers.types import AxisLimits
from estimator.observations.coverage import AxisCoverage, planned_coverage
from station.errors import ScriptError
from station.scripts.planned import planned_motion
from station.scripts.script import Script, check
from station.scripts.steps.kind import Step, Turn
from station.scripts.steps.move import Move
from station.scripts.steps.rest import Rest

END_REST_S = 10.0
"""Longest rest that is left at either end: until the first turn and after the last one nothing is proved."""
_LEAST_REST_S = 1.0  # in the middle
_LEAST_SHARE = 0.2  # of the rests between steps that must remain between moves
_PERIOD_S = 0.1
_HOME_RAD = math.radians(0.01)


def planned_constancy(script: Script, gimbals: Sequence[str]) -> tuple[AxisCoverage, ...]:
    """Return by axis the time over which a run of this script can prove constancy."""
    return planned_coverage(planned_motion(script, gimbals, _PERIOD_S).readings(None))


def early_and_late(script: Script, limits: Mapping[str, AxisLimits], gimbals: Sequence[str]) -> Script | None:
    """Return a script of the same length that goes through the steps twice, each time in half of their time.

    In the second pass every turn has the opposite direction, so that it ends where it began. If that does not help, the
    axes go home in between and turn the same way again. What exceeds 10 s of the rests at both ends is spent between
    the passes.

    None if there is no such script: turns would be shorter than their ramps, moves take too long to be made twice, an
    axis would still not be turned far apart in time, or a step cannot be changed or has an open duration.
    """
    if not script.span.is_exact or any(not step.turns and not step.rest_s for step in script.steps):
        return None
    for sign in (-1, 1):
        offered = _early_and_late(script, limits, sign)
        if offered is None:
            continue
        try:
            driven = check(offered, limits)
        except ScriptError:
            continue
        constancy = planned_constancy(driven, gimbals)
        if constancy and all(axis.proved for axis in constancy):
            return offered
    return None


def _early_and_late(script: Script, limits: Mapping[str, AxisLimits], sign: int) -> Script | None:
    """Return a script with the steps in half of their time, a rest, and them again with angles times ``sign``.

    With ``sign`` 1 the axes go home before the rest. Moves cannot be faster; their extra time is taken from the rests.
    None if that is too much, if a step cannot be halved, or if nothing moves.
    """
    before, between, after = _around_motion(script.steps)
    halves = [step.halved(limits) for step in between]
    once = [step for step in halves if step is not None]
    if not once or len(once) < len(halves):
        return None
    home = _moves_home(once) if sign > 0 else []
    again = [step.mirrored(sign) for step in once]
    moving_s = Script("", tuple(step for step in (*once, *home, *again) if step.turns)).least_s
    rests_s = sum(step.rest_s for step in (*once, *again))
    ends_s = sum(step.duration_s for step in (*before, *after))
    room_s = script.least_s - ends_s - moving_s - _LEAST_REST_S
    share = min(1.0, room_s / rests_s) if rests_s else 1.0
    if room_s < 0 or share < _LEAST_SHARE:
        return None
    middle = Rest(_LEAST_REST_S + room_s - share * rests_s, "rest in the middle")
    first = [step.shortened(share) for step in once]
    second = [step.shortened(share) for step in again]
    steps = (*before, *first, *home, middle, *second, *after)
    return Script(f"{script.name}, early and late", steps)


def _moves_home(steps: Sequence[Step]) -> list[Move]:
    """Return the moves that bring all axes home after these steps, at the largest rates that these have.

    An axis that is only rotated goes to the nearest full turn, one that moves to stated angles to zero. Axes that are
    there within 0.01 deg are left out.
    """
    angles: dict[str, float] = {}
    fastest: dict[str, Turn] = {}
    moved: set[str] = set()
    for timed in Script("", tuple(steps)).timeline():
        for _, turn in timed.turns():
            angles[turn.axis] = turn.to_rad
            fastest[turn.axis] = max(fastest.get(turn.axis, turn), turn, key=lambda one: abs(one.rate_rps))
            if timed.step.ends_at_stated_angles:
                moved.add(turn.axis)
    found = []
    for axis, angle_rad in angles.items():
        target_rad = 0.0 if axis in moved else 2 * math.pi * round(angle_rad / (2 * math.pi))
        if abs(angle_rad - target_rad) > _HOME_RAD:
            rate_rps = abs(fastest[axis].rate_rps)
            found.append(Move(axis, target_rad, rate_rps, fastest[axis].acceleration_rps2, f"{axis} home"))
    return found


def _around_motion(steps: Sequence[Step]) -> tuple[tuple[Rest, ...], tuple[Step, ...], tuple[Rest, ...]]:
    """Return the rest before the first motion, the steps from the first to the last motion, and the rest after.

    The rests at each end are joined into one of at most 10 s; it is left out if there are none. All are empty if
    nothing moves.
    """
    moving = [number for number, step in enumerate(steps) if step.turns]
    if not moving:
        return (), (), ()
    ends = steps[: moving[0]], steps[moving[-1] + 1 :]
    lengths_s = [sum(step.rest_s for step in end) for end in ends]
    before, after = (
        (Rest(min(length_s, END_REST_S), label),) if length_s else ()
        for length_s, label in zip(lengths_s, ("rest before", "rest after"), strict=True)
    )
    return before, tuple(steps[moving[0] : moving[-1] + 1]), after
