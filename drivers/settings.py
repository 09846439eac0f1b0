"""Times and limits of the drivers.

Set by `bramah bench --only wires` and the study `conformance` (docs/wires.md) unless stated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True)
class DriverSettings:
    """Numbers without unit are shares or counts; [blocks] is in lengths of a block."""

    # Modbus.
    retry: float = 0.1  # [blocks] until a block that was not there is asked for again
    earlier: float = 0.005  # [blocks] by which each block is asked for earlier
    late_blocks: int = 16  # blocks back that a late answer may be of
    quiet: float = 0.05  # [s] without a byte: nothing more of a late answer on a line is coming
    babble: float = 1.0  # [s] that a line may keep talking before it counts as garbage
    resolved: float = 1e-7  # of its range: a register finer than a converter of 20 bits

    # Messages over serial lines and CAN.
    tries: int = 5  # of a request, within the time after which a silent device counts as lost
    resend: float = 0.1  # [s] without a block, beyond the time that one takes
    notes_before_status: int = 3  # signs of life without a block, before the status is asked for
    serial_write: float = 1.0  # [s] for bytes to leave
    serial_wait: float = 0.02  # [s] that pyserial waits at a time: so late reading ends, at most

    # CAN.
    bus_load: float = 0.8  # of the bus, at worst: the rest is for requests and for sending again
    can_greeting: float = 2.0  # [s] for an adapter to greet
    can_open: float = 5.0  # [s] for an interface to open; some libraries wait for ever
    can_wait: float = 0.05  # [s] that the receiver waits at a time: so long closing takes
    can_send: float = 1.0  # [s] for a place in the adapter's transmit queue
    can_full: float = 0.001  # [s] between two tries at a full one
    can_frames: int = 100_000  # received and not taken: memory stays bounded
    heartbeats: int = 5  # of CANopen, within the time after which a node misses its host
    state_seconds: float = 0.5  # [s] for a CANopen node to reach a state

    # Devices without a clock of their own.
    block_samples: int = 10  # of a block, at most
    block_seconds: float = 0.05  # [s] of a block, at most, so that limits are checked as soon
    late: float = 0.5  # [periods] after its tick, from which on a sample counts as late
    early: float = 1e-6  # [periods] that rounding may take from a tick that is due
    trials: int = 3  # exchanges at connect, of which the fastest must fit into a period
    silent_periods: int = 3  # sample periods that a watchdog must let pass, at least
    rounding: float = 1e-9  # of a sensor's range


DRIVER: Final = DriverSettings()
