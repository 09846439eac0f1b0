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
    retry: float = 0.1  # [blocks] until a block that was not ready is requested again
    earlier: float = 0.005  # [blocks] by which each block is requested earlier
    late_blocks: int = 16  # number of past blocks to which a late answer may belong
    quiet: float = 0.05  # [s] without a byte, after which a late answer on a line is over
    babble: float = 1.0  # [s] of bytes without a pause, after which the line counts as lost
    busy_pause: float = 0.01  # [s] before a request is sent again to a module that was busy
    zero_volts: float = 0.02  # [V] that an output read back may hold at zero: coarse steps
    resolved: float = 1e-7  # of a sensor's range: a smaller value is read in the wrong word order

    # Messages over serial lines and CAN.
    tries: int = 5  # of a request, within the time after which a silent device counts as lost
    resend: float = 0.1  # [s] without a block, beyond the time that one takes
    notes_before_status: int = 3  # heartbeats without a block, before the status is requested
    serial_write: float = 1.0  # [s] for the port to accept bytes
    serial_wait: float = 0.02  # [s] of one wait for bytes: largest delay of the end of reading

    # CAN.
    bus_load: float = 0.8  # of the bus, at worst: the rest is for requests and repetitions
    can_greeting: float = 2.0  # [s] for an adapter to greet
    can_open: float = 5.0  # [s] for an interface to open; some libraries never return
    can_wait: float = 0.05  # [s] of one wait of the receiver: largest delay of closing
    can_send: float = 1.0  # [s] for a free slot of the adapter's transmit queue
    can_full: float = 0.001  # [s] between two tries at a full queue
    can_frames: int = 100_000  # received and not yet read, at most: bounds the memory
    heartbeats: int = 5  # of CANopen, within the time after which a node misses its host
    state_seconds: float = 0.5  # [s] for a CANopen node to reach a state

    # Devices without a clock of their own.
    block_samples: int = 10  # of a block, at most
    block_seconds: float = 0.05  # [s] of a block, at most, so that limits are checked as soon
    late: float = 0.5  # [periods] after its tick, beyond which a sample counts as late
    early: float = 1e-6  # [periods] that rounding may take from a tick that is due
    trials: int = 3  # exchanges at connect, of which the fastest must fit into a period
    silent_periods: int = 3  # least watchdog time, in sample periods
    rounding: float = 1e-9  # of a sensor's range


DRIVER: Final = DriverSettings()
