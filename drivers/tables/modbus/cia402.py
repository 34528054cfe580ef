"""The CiA 402 drive state machine (IEC 61800-7-201): statusword masks and controlword commands."""

from enum import Enum

MODE_PROFILE_POSITION = 1
MODE_PROFILE_VELOCITY = 3
MODE_HOMING = 6
DISABLE_VOLTAGE = 0x00  # controlword: to switch on disabled, from every state without a fault

TARGET_REACHED = 1 << 10
INTERNAL_LIMIT = 1 << 11  # a limit switch, or a set-point beyond what the drive allows
BIT_12 = 1 << 12  # set-point acknowledged (position), speed zero (velocity), homing attained (homing)
BIT_13 = 1 << 13  # following error (position), homing error (homing)
VOLTAGE_ENABLED = 1 << 4


class DriveState(Enum):
    """State of a drive, with mask and value of the statusword bits that show it."""

    NOT_READY = (0x4F, 0x00)
    SWITCH_ON_DISABLED = (0x4F, 0x40)
    READY_TO_SWITCH_ON = (0x6F, 0x21)
    SWITCHED_ON = (0x6F, 0x23)
    OPERATION_ENABLED = (0x6F, 0x27)
    QUICK_STOP_ACTIVE = (0x6F, 0x07)
    FAULT_REACTION = (0x4F, 0x0F)
    FAULT = (0x4F, 0x08)

    @property
    def text(self) -> str:
        """Name in plain words."""
        return self.name.lower().replace("_", " ")


def state_of(statusword: int) -> DriveState | None:
    """Return the state for a statusword, None for an unknown pattern."""
    for state in DriveState:
        mask, value = state.value
        if statusword & mask == value:
            return state
    return None
