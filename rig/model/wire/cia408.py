"""A proportional valve of CiA 408: its states, words and values (docs/wire-canopen-408.md).

Source: CiA 408 (device profile fluid power technology), device state machine; manuals of valves
that follow it list the same numbers.
"""

from __future__ import annotations

from enum import IntEnum, IntFlag
from importlib import resources
from typing import Final

DEVICE_TYPE: Final = 408  # low half of object 0x1000
FULL_SCALE: Final = 0x4000  # of set point and actual value: 100 %

CONSUMER_HEARTBEAT: Final = 0x1016
CONTROL_WORD: Final = 0x6040
STATUS_WORD: Final = 0x6041
DEVICE_MODE: Final = 0x6042
CONTROL_MODE: Final = 0x6043
SET_POINT: Final = 0x6300
ACTUAL_VALUE: Final = 0x6301

BY_BUS: Final = 1  # device mode: the set point comes by the bus
POSITION_OPEN_LOOP: Final = 1  # control mode: the spool follows the set point

SYNC_ID: Final = 0x080
EMERGENCY_ID: Final = 0x080  # and the node's number
HEARTBEAT_ID: Final = 0x700
OPERATIONAL: Final = 5  # state in a heartbeat
BOOT_UP: Final = 0  # the same, once after a node has started


class Control(IntFlag):
    """Bits of the control word."""

    DISABLED = 1
    HOLD = 2
    ACTIVE = 4
    RESET = 8


class ValveState(IntEnum):
    """Low four bits of the status word: ready, active, hold, disabled."""

    INIT = 0b1000
    DISABLED = 0b1001
    HOLD = 0b1011
    ACTIVE = 0b1111
    FAULT_HOLD = 0b0011
    FAULT_DISABLED = 0b0001
    FAULT_INIT = 0b0000

    @property
    def in_fault(self) -> bool:
        """Whether only a reset leaves the state."""
        return not self & 0b1000


def next_state(state: ValveState, before: int, word: int) -> ValveState:
    """Return the state after control word `word`, the previous word being `before`.

    A rising reset bit leaves a fault, to the state without an output; any other state is the
    highest whose bits are all set.
    """
    if state.in_fault:
        rising = word & ~before & Control.RESET
        return ValveState.DISABLED if rising else state
    if word & 0b111 == 0b111:
        return ValveState.ACTIVE
    if word & 0b11 == 0b11:
        return ValveState.HOLD
    return ValveState.DISABLED if word & 0b1 else ValveState.INIT


def shipped_eds() -> str:
    """Return the text of the valve's EDS file."""
    return (resources.files("rig") / "shipped" / "valve-408.eds").read_text("utf-8")
