"""The CiA 402 states that a statusword tells."""

from __future__ import annotations

import pytest

from drivers.tables.modbus import cia402
from drivers.tables.modbus.cia402 import DriveState, state_of

MASKS = {
    DriveState.NOT_READY: (0x4F, 0x00),
    DriveState.SWITCH_ON_DISABLED: (0x4F, 0x40),
    DriveState.READY_TO_SWITCH_ON: (0x6F, 0x21),
    DriveState.SWITCHED_ON: (0x6F, 0x23),
    DriveState.OPERATION_ENABLED: (0x6F, 0x27),
    DriveState.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    DriveState.FAULT_REACTION: (0x4F, 0x0F),
    DriveState.FAULT: (0x4F, 0x08),
}


@pytest.mark.parametrize(("state", "mask", "value"), [(s, *bits) for s, bits in MASKS.items()], ids=str)
def test_a_state_shows_whatever_the_other_bits_are(state: DriveState, mask: int, value: int) -> None:
    others = [word for word in range(0x10000) if word & mask == value]
    assert all(state_of(word) is state for word in others)


def test_no_statusword_is_two_states_and_what_is_none_is_told() -> None:
    for word in range(0x100):
        matching = [state for state, (mask, value) in MASKS.items() if word & mask == value]
        assert len(matching) <= 1
        assert state_of(word) is (matching[0] if matching else None)


def test_states_have_names_in_plain_words() -> None:
    assert DriveState.SWITCH_ON_DISABLED.text == "switch on disabled"


def test_modes_and_bits_are_those_of_the_standard() -> None:
    # IEC 61800-7-201: modes of operation (6060h), statusword (6041h), controlword (6040h).
    modes = (cia402.MODE_PROFILE_POSITION, cia402.MODE_PROFILE_VELOCITY, cia402.MODE_HOMING)
    assert modes == (1, 3, 6)
    assert cia402.DISABLE_VOLTAGE == 0x0000
    assert (cia402.VOLTAGE_ENABLED, cia402.TARGET_REACHED, cia402.INTERNAL_LIMIT) == (0x0010, 0x0400, 0x0800)
    assert (cia402.BIT_12, cia402.BIT_13) == (0x1000, 0x2000)
