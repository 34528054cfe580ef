"""The scripts of the loop: exploration, which shows effects, verification, which only judges, and the next one."""

import math
from collections.abc import Iterator, Mapping, Sequence

from drivers.types import AxisLimits
from station.scripts.script import Script
from station.scripts.steps.kind import Step
from station.scripts.steps.move import Move
from station.scripts.steps.rest import Rest
from station.scripts.steps.rotate import Rotate

_DEG = math.pi / 180

TURN_S = 24.0
RAMP_RPS2 = 20 * _DEG
REST_S = 15.0


def exploration_script() -> Script:
    """Return both directions of every axis at two rates between rests: 318 s. Each pair of turns ends at home."""
    turns = [turn for rate in (12.0, 30.0) for axis in "xyz" for turn in there_and_back(axis, rate)]
    return between_rests("exploration", turns)


def verification_script() -> Script:
    """Return rates that nothing is fitted to, slower and faster than those, in another order: 318 s."""
    turns = [turn for rate in (-45.0, 8.0) for axis in "zxy" for turn in there_and_back(axis, rate)]
    return between_rests("verification", turns)


def between_rests(name: str, steps: Sequence[Step], rest_s: float = REST_S) -> Script:
    """Return steps with a rest before and after."""
    return Script(name, (Rest(rest_s, "rest before"), *steps, Rest(rest_s, "rest after")))


def there_and_back(
    axis: str, rate_dps: float, duration_s: float = TURN_S, acceleration_rps2: float = RAMP_RPS2
) -> tuple[Rotate, Rotate]:
    """Return a turn at a rate and the opposite turn, so that the axis ends where it began.

    Each takes ``duration_s`` with its ramps. The rate is in deg/s, the acceleration in rad/s2.
    """
    first, second = (
        Rotate(axis, rate * _DEG, duration_s, acceleration_rps2, f"{axis} at {rate:g} deg/s")
        for rate in (rate_dps, -rate_dps)
    )
    return first, second


def candidates(limits: Mapping[str, AxisLimits], gimbals: Sequence[str]) -> Iterator[Script]:
    """Yield scripts of all kinds that show effects, each ending at home.

    Turns of several kinds, between rests, come once, twice and four times, then three single rests. Rates and
    accelerations are within the limits; travel is not considered.
    """
    axes = [axis for axis in "xyz" if axis in gimbals]

    def turns(share_or_dps: float, turn_s: float, steep: bool = False) -> list[Step]:
        """Return turns in both directions about each axis, lengthened if too short for their ramps.

        ``share_or_dps`` is a rate in deg/s or, below 1, a share of the axis' limit; it is limited to that. ``steep``:
        ramps with the full acceleration instead of ``RAMP_RPS2``.
        """
        steps: list[Step] = []
        for axis in axes:
            top, push = limits[axis].rate_rps, limits[axis].acceleration_rps2
            rate = min(share_or_dps * top if share_or_dps < 1 else math.radians(share_or_dps), top)
            ramp = push if steep else min(RAMP_RPS2, push)
            steps += there_and_back(axis, math.degrees(rate), max(turn_s, 2.5 * rate / ramp), ramp)
        return steps

    for cycles, times in ((1, ""), (2, ", twice"), (4, ", 4 times")):
        yield between_rests("both ways at 12 and 30 deg/s" + times, (turns(12, 24) + turns(30, 24)) * cycles)
        yield between_rests("steep ramps" + times, (turns(0.4, 4, True) + turns(0.8, 4, True)) * cycles)
        many = [step for rate in (5, 10, 20, 0.4, 0.6, 0.8) for step in turns(rate, 12)]
        yield between_rests("both ways at six rates" + times, many * cycles)
        rests = [step for axis in axes for step in (Rest(30.0), *there_and_back(axis, *_gentle(limits[axis], 12.0)))]
        yield between_rests("rests between turns" + times, rests * cycles)
        yield between_rests("tilted rests" + times, _tilted(limits, axes) * cycles)
        yield between_rests("full turns at 8 deg/s" + times, _full_turns(limits, axes, 8.0) * cycles)
        yield between_rests("full turns at 30 deg/s" + times, _full_turns(limits, axes, 30.0) * cycles)
    for rest_s in (150.0, 300.0, 600.0):
        yield Script(f"rest of {rest_s:g} s", (Rest(rest_s, "rest"),))


def _gentle(limit: AxisLimits, turn_s: float) -> tuple[float, float, float]:
    push = min(RAMP_RPS2, limit.acceleration_rps2)
    rate = min(math.radians(20), limit.rate_rps, push * turn_s / 2.5)
    return math.degrees(rate), turn_s, push


def _tilted(limits: Mapping[str, AxisLimits], axes: Sequence[str]) -> list[Step]:
    """Return, for each axis, moves to 45, 90, 180, 270 and 0 deg with a rest of 15 s after each, also the last.

    Moves are gentle: at most 20 deg/s, and within the limits of rate and acceleration. The travel of an axis is not
    considered.
    """
    steps: list[Step] = []
    for axis in axes:
        rate_dps, _, push = _gentle(limits[axis], 24.0)
        for angle in (45, 90, 180, 270, 0):
            move = Move(axis, math.radians(angle), math.radians(rate_dps), push, f"{axis} to {angle} deg")
            steps += [move, Rest(15.0, f"rest with {axis} at {angle} deg")]
    return steps


def _full_turns(limits: Mapping[str, AxisLimits], axes: Sequence[str], rate_dps: float) -> list[Step]:
    """Return a full turn of each axis in both directions at ``rate_dps``, or the limit of the axis."""
    steps: list[Step] = []
    for axis in axes:
        rate, push = min(math.radians(rate_dps), limits[axis].rate_rps), min(RAMP_RPS2, limits[axis].acceleration_rps2)
        turn_s = 2 * math.pi / rate + rate / push
        label = f"{axis} at {{:g}} deg/s"
        steps += [Rotate(axis, r, turn_s, push, label.format(math.degrees(r))) for r in (rate, -rate)]
    return steps
