"""Rotors that follow their commands exactly: trapezoids, triangles, stops, limits."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from sims.physics.motion import AxisMotion

MAX_RATE, MAX_ACCELERATION = 2.0, 1.5


def axis(angle_rad: float = 0.0) -> AxisMotion:
    return AxisMotion(angle_rad, MAX_RATE, MAX_ACCELERATION)


def test_an_axis_that_is_told_nothing_stays() -> None:
    motion = axis(0.7)
    for t_s in (-5.0, 0.0, 1e6):
        assert motion.at(t_s) == (0.7, 0.0)
    assert motion.settled(0.0)
    np.testing.assert_array_equal(motion.angles(np.array([0.0, 5.0])), [0.7, 0.7])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_long_move_is_a_trapezoid(sign: int) -> None:
    motion = axis(0.5)
    motion.move(10.0, 0.5 + sign * 6.0, 1.0, 0.5)  # ramps of 2 s and 1 rad each, 4 s at 1 rad/s
    expected = {10.0: (0.0, 0.0), 11.0: (0.25, 0.5), 12.0: (1.0, 1.0), 14.0: (3.0, 1.0), 16.0: (5.0, 1.0)}
    expected |= {17.0: (5.75, 0.5), 18.0: (6.0, 0.0), 99.0: (6.0, 0.0)}
    for t_s, (way, rate) in expected.items():
        assert motion.at(t_s) == pytest.approx((0.5 + sign * way, sign * rate), abs=1e-12)
    assert not motion.settled(17.999)
    assert motion.settled(18.001)


def test_a_short_move_is_a_triangle() -> None:
    motion = axis()
    motion.move(0.0, 0.5, 2.0, 0.5)  # would need 4 rad a ramp: peaks at 0.5 rad/s after 1 s
    for t_s, state in {0.5: (0.0625, 0.25), 1.0: (0.25, 0.5), 1.5: (0.4375, 0.25), 2.0: (0.5, 0.0)}.items():
        assert motion.at(t_s) == pytest.approx(state, abs=1e-12)
    assert motion.settled(2.0 + 1e-12)


@pytest.mark.parametrize("way", [1e-9, -1e-5, 0.1, 1 / 3, math.pi, -2 * math.pi, 8 * math.pi, 1000.0])
def test_a_move_ends_exactly_on_its_target(way: float) -> None:
    motion = axis(0.1)
    motion.move(3.3, 0.1 + way, 1.234, 0.777)
    assert motion.at(1e6) == (0.1 + way, 0.0)
    assert motion.angles(np.array([1e6]))[0] == 0.1 + way


def test_a_move_to_where_it_stands_is_done_at_once() -> None:
    motion = axis(0.1)
    motion.move(5.0, 0.1, 1.0, 1.0)
    assert motion.settled(5.0)
    assert motion.at(5.0) == (0.1, 0.0)


def test_a_jog_ramps_to_its_rate_and_goes_on() -> None:
    motion = axis()
    motion.jog(1.0, -1.0, 0.5)
    assert motion.at(2.0) == pytest.approx((-0.25, -0.5))
    assert motion.at(3.0) == pytest.approx((-1.0, -1.0))
    assert motion.at(103.0) == pytest.approx((-101.0, -1.0))
    assert motion.settled(3.0)


def test_a_jog_may_be_reversed_in_motion() -> None:
    motion = axis()
    motion.jog(0.0, 1.0, 0.5)
    motion.jog(1.0, -0.5, 1.0)  # at 0.25 rad and 0.5 rad/s
    assert motion.at(1.5) == pytest.approx((0.375, 0.0))
    assert motion.at(2.0) == pytest.approx((0.25, -0.5))
    assert motion.at(3.0) == pytest.approx((-0.25, -0.5))


def test_a_stop_in_motion_brakes_along_its_ramp() -> None:
    motion = axis()
    motion.move(0.0, 10.0, 1.0, 0.5)
    motion.stop(3.0, 1.0)  # at 2 rad and 1 rad/s
    assert motion.at(3.5) == pytest.approx((2.375, 0.5))
    assert motion.at(4.0) == pytest.approx((2.5, 0.0))
    assert motion.at(50.0) == pytest.approx((2.5, 0.0))
    assert motion.settled(4.0)


def test_a_stop_in_a_ramp_brakes_from_the_rate_it_has() -> None:
    motion = axis()
    motion.move(0.0, 10.0, 1.0, 0.5)
    motion.stop(1.0, 1.0)  # at 0.25 rad and 0.5 rad/s
    assert motion.at(1.5) == pytest.approx((0.375, 0.0))


def test_a_move_in_motion_goes_on_from_the_rate_it_has() -> None:
    motion = axis()
    motion.jog(0.0, 0.5, 0.5)
    motion.move(1.0, 10.0, 1.0, 0.5)  # at 0.25 rad and 0.5 rad/s
    assert motion.at(2.0) == pytest.approx((1.0, 1.0))
    assert motion.at(1e3) == (10.0, 0.0)


@pytest.mark.parametrize("target", [-1.0, 0.26, 0.3])
def test_a_move_that_cannot_be_made_in_one_go_comes_to_rest_first(target: float) -> None:
    motion = axis()
    motion.jog(0.0, 0.5, 0.5)
    motion.move(1.0, target, 1.0, 0.5)  # at 0.25 rad and 0.5 rad/s: stops at 0.5 rad
    assert motion.at(2.0) == pytest.approx((0.5, 0.0), abs=1e-12)
    assert motion.at(1e3) == (target, 0.0)


def test_more_than_the_axis_can_is_cut_to_its_limits() -> None:
    motion = axis()
    motion.jog(0.0, 100.0, 100.0)
    assert motion.at(1.0)[1] == pytest.approx(MAX_ACCELERATION)
    assert motion.at(10.0)[1] == MAX_RATE
    motion.jog(10.0, -100.0, 100.0)
    assert motion.at(100.0)[1] == -MAX_RATE
    motion.stop(100.0, 0.0)  # no ramp given: the steepest
    assert motion.at(100.0 + MAX_RATE / MAX_ACCELERATION)[1] == pytest.approx(0.0, abs=1e-12)


COMMANDS = st.tuples(
    st.sampled_from(["jog", "move", "stop"]),
    st.floats(-20, 20),
    st.floats(0.01, 5),
    st.floats(0.01, 5),
    st.floats(0.01, 8),
)


def told(commands: list[tuple[str, float, float, float, float]]) -> tuple[AxisMotion, list[float], float | None]:
    """Return the axis, the instants of its commands, and the target if the last was a move."""
    motion, now, instants = axis(), 0.0, []
    motion.keep_all()
    target = None
    for kind, value, rate, acceleration, later in commands:
        instants.append(now)
        target = value if kind == "move" else None
        if kind == "jog":
            motion.jog(now, value / 5, acceleration)
        elif kind == "move":
            motion.move(now, value, rate, acceleration)
        else:
            motion.stop(now, acceleration)
        now += later
    return motion, instants, target


@settings(max_examples=60, deadline=None)
@given(st.lists(COMMANDS, min_size=1, max_size=8))
def test_whatever_it_is_told_it_keeps_to_its_limits_and_never_jumps(commands: list[tuple]) -> None:
    motion, _, target = told(commands)
    step = 0.01
    t_s = np.arange(0, 90, step)
    angle, rate = np.array([motion.at(float(t)) for t in t_s]).T
    assert np.abs(rate).max() <= MAX_RATE * (1 + 1e-9)
    assert np.abs(np.diff(rate)).max() <= MAX_ACCELERATION * step * (1 + 1e-6) + 1e-9
    # The angle is the integral of the rate: within a step the two can differ by what a ramp bends.
    np.testing.assert_allclose(
        np.diff(angle), 0.5 * (rate[1:] + rate[:-1]) * step, atol=0.3 * MAX_ACCELERATION * step**2 + 1e-9
    )
    if target is not None:
        assert motion.at(1e7) == (target, 0.0)


@settings(max_examples=60, deadline=None)
@given(st.lists(COMMANDS, min_size=1, max_size=8))
def test_angles_are_those_of_single_instants(commands: list[tuple]) -> None:
    motion, instants, _ = told(commands)
    t_s = np.sort(np.concatenate([np.linspace(-1, 100, 300), instants]))
    np.testing.assert_allclose(motion.angles(t_s), [motion.at(float(t))[0] for t in t_s], atol=1e-9)
    late = t_s[t_s > instants[-1]]
    np.testing.assert_allclose(motion.angles(late[::-1])[::-1], motion.angles(late), atol=1e-9)


def test_the_past_is_not_changed_by_a_command() -> None:
    motion = axis()
    motion.move(0.0, 10.0, 1.0, 0.5)
    t_s = np.linspace(0, 5, 50)
    before = motion.angles(t_s)
    motion.jog(5.0, -1.0, 1.0)
    np.testing.assert_array_equal(motion.angles(t_s), before)


def test_each_command_is_a_new_revision() -> None:
    motion = axis()
    seen = {motion.revision}
    for command in (
        lambda: motion.move(1.0, 5.0, 1.0, 1.0),
        lambda: motion.jog(2.0, 1.0, 1.0),
        lambda: motion.stop(3.0, 1),
    ):
        command()
        seen.add(motion.revision)
    assert len(seen) == 4


def test_many_commands_do_not_spoil_what_is_to_come() -> None:
    motion = axis()
    for i in range(500):
        motion.move(float(i), (-1) ** i * 0.1, 1.0, 1.0)
    assert motion.at(1e4) == (-0.1, 0.0)
    t_s = np.linspace(498, 505, 200)
    np.testing.assert_allclose(motion.angles(t_s), [motion.at(float(t))[0] for t in t_s], atol=1e-12)


def test_a_move_at_no_rate_stays_where_it_is() -> None:
    axis = AxisMotion(0.5, 2.0, 1.0)
    axis.move(1.0, 5.0, 0.0, 1.0)
    assert axis.at(10.0) == (0.5, 0.0)
