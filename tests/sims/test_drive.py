"""The drive twin does what IEC 61800-7-201 (CiA 402) says of halt, relative moves and quick stop."""

from __future__ import annotations

import math

import pytest

from drivers.tables.modbus import cia402
from drivers.tables.modbus.cia402 import DriveState
from drivers.tables.modbus.registers import load_profile
from sims.physics.table import AxisData, TableModel
from sims.tables.drive import Drive

RATE, ACCELERATION = 0.1, 0.1  # turns/s, turns/s2
ENABLE, HALT = 0x0F, 0x10F


class Bench:
    """One enabled drive, and a clock that goes on when told."""

    def __init__(self) -> None:
        self.now_s = 0.0
        data = AxisData(2 * math.pi, 2 * math.pi, 65536)
        self.drive = Drive(TableModel({"x": data}, lambda: self.now_s), "x", load_profile("kinco"), 0.0)
        for word in (0x06, 0x07, ENABLE):
            self.tell(word)
        for name in ("acceleration", "deceleration"):
            self.drive.write(name, ACCELERATION)

    def tell(self, *words: int) -> None:
        for word in words:
            self.drive.write("controlword", word)

    def after(self, wait_s: float) -> tuple[DriveState | None, float, float]:
        """Return state, position in turns and rate in turns/s some time later."""
        self.now_s += wait_s
        state = cia402.state_of(int(self.drive.read("statusword")))
        return state, self.drive.read("position"), self.drive.read("rate")

    def reached(self) -> bool:
        return bool(int(self.drive.read("statusword")) & cia402.TARGET_REACHED)


def turning() -> Bench:
    bench = Bench()
    bench.drive.write("mode", cia402.MODE_PROFILE_VELOCITY)
    bench.drive.write("target_rate", RATE)
    bench.tell(ENABLE)
    assert bench.after(3.0)[2] == pytest.approx(RATE)
    return bench


def positioning(*, target: float) -> Bench:
    bench = Bench()
    bench.drive.write("mode", cia402.MODE_PROFILE_POSITION)
    bench.drive.write("profile_rate", RATE)
    bench.drive.write("target_position", target)
    return bench


def test_halt_brings_a_turning_axis_to_rest_and_lets_it_go_on() -> None:
    bench = turning()
    bench.tell(HALT)
    state, at_rest, rate = bench.after(2.0)
    assert (state, rate) == (DriveState.OPERATION_ENABLED, 0.0)
    assert bench.reached()
    bench.drive.write("target_rate", -RATE)
    assert bench.after(2.0)[1] == at_rest
    bench.tell(ENABLE)
    assert bench.after(3.0)[2] == pytest.approx(-RATE)


def test_halt_interrupts_a_move_which_then_ends_at_its_target() -> None:
    bench = positioning(target=1.0)
    bench.tell(0x2F, 0x3F)
    assert bench.after(4.0)[2] == pytest.approx(RATE)
    bench.tell(0x13F)
    _, at_rest, rate = bench.after(3.0)
    assert rate == 0.0
    assert 0.3 < at_rest < 0.6
    bench.tell(0x3F)
    assert bench.after(20.0)[1] == 1.0


def test_relative_moves_add_up() -> None:
    bench = positioning(target=0.25)
    for place in (0.25, 0.5):
        bench.tell(0x4F, 0x5F)
        assert bench.after(10.0)[1] == place
    bench.drive.write("target_position", -0.125)
    bench.tell(0x4F, 0x5F)
    assert bench.after(10.0)[1] == 0.375
    bench.tell(0x2F, 0x3F)
    assert bench.after(10.0)[1] == -0.125


def test_a_relative_move_in_the_middle_of_another_begins_at_its_target() -> None:
    bench = positioning(target=0.5)
    bench.tell(0x4F, 0x5F)
    assert bench.after(3.0)[1] < 0.3
    bench.tell(0x4F, 0x5F)
    assert bench.after(20.0)[1] == 1.0


def test_after_a_turn_a_relative_move_begins_where_the_axis_is() -> None:
    bench = positioning(target=0.25)
    bench.tell(0x4F, 0x5F)
    bench.after(10.0)
    bench.drive.write("mode", cia402.MODE_PROFILE_VELOCITY)
    bench.drive.write("target_rate", RATE)
    bench.tell(ENABLE)
    bench.after(10.0)
    bench.drive.write("target_rate", 0.0)
    _, start, _ = bench.after(10.0)
    assert start > 1.0
    bench.drive.write("mode", cia402.MODE_PROFILE_POSITION)
    bench.tell(0x4F, 0x5F)
    assert bench.after(10.0)[1] == pytest.approx(start + 0.25, abs=2 / 65536)


def test_quick_stop_active_is_left_by_disable_voltage_or_enable_operation_alone() -> None:
    bench = turning()
    bench.tell(0x0B)
    bench.after(3.0)
    for word in (0x06, 0x07, 0x0B):
        bench.tell(word)
        state, _, rate = bench.after(3.0)
        assert (state, rate) == (DriveState.QUICK_STOP_ACTIVE, 0.0)
    bench.tell(ENABLE)
    assert bench.after(1.0)[0] is DriveState.OPERATION_ENABLED
    bench.tell(0x0B, 0x00)
    assert bench.after(1.0)[0] is DriveState.SWITCH_ON_DISABLED
    bench.tell(0x06)
    assert bench.after(0.0)[0] is DriveState.READY_TO_SWITCH_ON
