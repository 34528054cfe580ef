"""The body of the twins: what it tells one instant after the other is what it tells of all at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sims.physics.body import Body
from sims.physics.table import AxisData, TableModel

DEG = np.pi / 180
PERIOD_S = 1 / 2000
EXACT = 1e-12


class Rig:
    """A table of three axes, none of which stands level, whose clock is set by hand, and the body on it."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.asked = 0
        axes = {
            axis: AxisData(100 * DEG, 50 * DEG, 65536, start)
            for axis, start in zip("zyx", (0.3, -0.2, 0.1), strict=True)
        }
        self.table = TableModel(axes, lambda: self.now_s)
        self.body = Body(
            gimbals="zyx", angles=self.angles, revision=self.table.revision, latitude_rad=np.pi / 4, heading_rad=0.3
        )

    def angles(self, axis: str, t_s: np.ndarray) -> np.ndarray:
        self.asked += 1
        return self.table.angles(axis, t_s)

    def turn(self) -> None:
        for axis, turns in zip("zyx", (0.7, -0.5, 0.4), strict=True):
            self.table.move_encoder(axis, turns, 80 * DEG, 50 * DEG)


def off(rig: Rig, up: Callable[[np.ndarray], np.ndarray], t_s: float) -> float:
    """Return by how much ``up`` at one instant differs from that of the body."""
    rig.now_s = t_s
    at = np.array([t_s])
    found = up(at)
    assert found.shape == (1, 3)
    return float(np.abs(found - rig.body.up(at)).max())


def test_up_in_turn_is_up_while_the_table_turns() -> None:
    rig = Rig()
    rig.turn()
    up = rig.body.up_in_turn(PERIOD_S)
    moved = rig.body.up(np.array([1.0])) - rig.body.up(np.array([1.5]))
    assert np.abs(moved).max() > 0.1
    assert max(off(rig, up, 1.0 + i * PERIOD_S) for i in range(400)) < EXACT


@pytest.mark.parametrize("count", [3, 7, 300])
def test_up_in_turn_is_up_at_several_instants_at_once(count: int) -> None:
    rig = Rig()
    rig.turn()
    up = rig.body.up_in_turn(PERIOD_S)
    for first in range(0, 400, count):
        at = 1.0 + PERIOD_S * np.arange(first, first + count)
        rig.now_s = float(at[0])
        assert np.abs(up(at) - rig.body.up(at)).max() < EXACT


def test_up_in_turn_heeds_a_command_that_comes_between_two_instants() -> None:
    rig = Rig()
    up = rig.body.up_in_turn(PERIOD_S)
    for i in range(200):
        rig.now_s = i * PERIOD_S
        if i == 30:  # while it stands, and much is worked out ahead
            rig.turn()
        if i == 150:
            rig.table.stop("z")
        assert off(rig, up, i * PERIOD_S) < EXACT


@pytest.mark.parametrize("step_s", [-0.02, -5.0, 0.00123, 0.05, 30.0], ids=lambda s: f"{s:+} s")
def test_up_in_turn_is_up_at_an_instant_out_of_turn(step_s: float) -> None:
    rig = Rig()
    rig.turn()
    up = rig.body.up_in_turn(PERIOD_S)
    for i in range(50):
        up(np.array([6.0 + i * PERIOD_S]))
    for i in range(5):
        assert off(rig, up, 6.0 + 49 * PERIOD_S + step_s + i * PERIOD_S) < EXACT


def test_a_clock_that_is_not_the_hosts_is_followed() -> None:
    rig = Rig()
    rig.turn()
    up = rig.body.up_in_turn(PERIOD_S)
    assert max(off(rig, up, 1.0 + i * PERIOD_S * (1 + 200e-6)) for i in range(400)) < 80 * DEG * 2e-6  # a microsecond


def test_up_in_turn_of_many_instants_is_up() -> None:
    rig = Rig()
    rig.turn()
    t_s = np.linspace(0.0, 3.0, 40)
    np.testing.assert_array_equal(rig.body.up_in_turn(PERIOD_S)(t_s), rig.body.up(t_s))


def test_up_in_turn_asks_the_table_seldom() -> None:
    rig = Rig()
    rig.turn()
    up = rig.body.up_in_turn(PERIOD_S)
    for i in range(2000):  # one second
        up(np.array([i * PERIOD_S]))
    assert rig.asked < 50
