"""The register map of a bench on Modbus, for both ends (docs/wire-modbus-tcp.md).

A register is 16 bits; wider values take consecutive registers, high word first. Addresses are those
of the protocol (0-based).
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rig.model import channels as ch
from rig.model.parameters import MAX_JOINTS
from rig.model.rig import Rig

MAGIC: Final = 0x4252414D  # "BRAM"
PROTOCOL_VERSION: Final = 1

MAX_READ: Final = 125  # registers in one answer: the protocol's own limit
MAX_WRITE: Final = 123
HEADER_WORDS: Final = 5
MAX_BLOCK_SAMPLES: Final = 10

WAVE_CAPACITY: Final = 131_072  # samples of one joint's waveform
WAVE_BITS: Final = 16  # finer than the converter, so that a gain can scale the waveform
PAGE_SAMPLES: Final = MAX_WRITE - 2  # samples of a waveform in one write

LAW_FIELDS: Final = ("gain", "bias", "position_gain", "setpoint", "limit")
LAW_WORDS: Final = 2 * len(LAW_FIELDS)

# Values of single registers.
ZERO_NOW: Final = 1
STREAM_STOP: Final = 0
STREAM_START: Final = 1
APPLY: Final = 1
APPLY_AND_RESTART: Final = 3
RESET_KEY: Final = 0x5253  # "RS": an accidental write of 0 or 1 must not clear a trip


@dataclass(frozen=True)
class Register:
    """One entry of the map: first address, width in registers, form and writer."""

    name: str
    address: int
    words: int
    form: str
    access: str

    @property
    def end(self) -> int:
        """The address after the last register."""
        return self.address + self.words


IDENTITY_MAGIC = Register("magic", 0x0000, 2, "u32", "R")
IDENTITY_VERSION = Register("protocol_version", 0x0002, 1, "u16", "R")
IDENTITY_JOINTS = Register("joints", 0x0003, 1, "u16", "R")
IDENTITY_CHANNELS = Register("channels", 0x0004, 1, "u16", "R")
IDENTITY_RATE = Register("sample_rate", 0x0005, 2, "f32", "R")
IDENTITY_BLOCK = Register("block_samples", 0x0007, 1, "u16", "R")
IDENTITY_VIRTUAL = Register("virtual_time", 0x0008, 1, "u16", "R")
IDENTITY_CAPACITY = Register("wave_capacity", 0x0009, 2, "u32", "R")
IDENTITY_CONVERTERS = Register("converter_checksum", 0x000B, 2, "u32", "R")
IDENTITY_NAME = Register("rig_name", 0x0010, 16, "ascii", "R")

STATUS_FLAGS = Register("status", 0x0040, 1, "u16", "R")
STATUS_CAUSE = Register("trip_cause", 0x0041, 1, "u16", "R")
STATUS_TRIP_TICK = Register("trip_tick", 0x0042, 2, "u32", "R")
STATUS_TICK = Register("tick", 0x0044, 2, "u32", "R")
STATUS_SEQUENCE = Register("next_sequence", 0x0046, 1, "u16", "R")
STATUS_BACKLOG = Register("backlog", 0x0047, 1, "u16", "R")
STATUS_DROPPED = Register("dropped_blocks", 0x0048, 2, "u32", "R")
STATUS_APPLY_TICK = Register("apply_tick", 0x004A, 2, "u32", "R")
STATUS_REFUSAL = Register("last_refusal", 0x004C, 1, "u16", "R")
STATUS_REFUSAL_JOINT = Register("last_refusal_joint", 0x004D, 1, "u16", "R")
STATUS_OUTPUTS = Register("outputs", 0x0050, MAX_JOINTS, "i16", "R")

CONTROL_ACK = Register("acknowledge", 0x0080, 1, "u16", "RW")
CONTROL_HEARTBEAT = Register("heartbeat", 0x0081, 1, "u16", "RW")
CONTROL_ZERO = Register("zero_outputs", 0x0082, 1, "u16", "RW")
CONTROL_STREAM = Register("stream", 0x0083, 1, "u16", "RW")
CONTROL_APPLY = Register("apply", 0x0084, 1, "u16", "RW")
CONTROL_RESET = Register("reset", 0x0085, 1, "u16", "RW")
CONTROL_WATCHDOG = Register("watchdog_ms", 0x0086, 1, "u16", "RW")

BLOCK = Register("block", 0x0100, MAX_READ, "block", "R")
LAWS = Register("laws", 0x0200, LAW_WORDS * MAX_JOINTS, "f32", "RW")

UPLOAD_JOINT = Register("upload_joint", 0x0300, 1, "u16", "W")
UPLOAD_LENGTH = Register("upload_length", 0x0301, 2, "u32", "W")
UPLOAD_OFFSET = Register("upload_offset", 0x0303, 2, "u32", "W")
UPLOAD_PAGE = Register("upload_page", 0x0305, PAGE_SAMPLES, "i16", "W")
UPLOAD_COMMIT = Register("upload_checksum", 0x0380, 2, "u32", "W")

REGISTERS: Final = tuple(value for value in list(globals().values()) if isinstance(value, Register))

# Groups that may be read with one request each, as (first, after the last).
IDENTITY_SPAN: Final = (0x0000, IDENTITY_NAME.end)
STATUS_SPAN: Final = (STATUS_FLAGS.address, STATUS_OUTPUTS.end)
CONTROL_SPAN: Final = (CONTROL_ACK.address, CONTROL_WATCHDOG.end)


class Status(IntFlag):
    """Bits of the status register and of a block's header."""

    STREAMING = 1
    TRIPPED = 2
    ARMED = 4  # a joint's law may put out a voltage
    BLOCK = 8  # (header) samples follow; otherwise the rest of the answer is undefined
    CONTROLLED = 16  # a client has control


class TripCause(IntEnum):
    """Why the device zeroed its outputs."""

    NONE = 0
    WATCHDOG = 1
    HOST_LOST = 2
    FAULT = 3


class Refusal(IntEnum):
    """Why the last control write was refused."""

    NONE = 0
    NOT_IN_CONTROL = 1
    TRIPPED = 2
    NOT_FINITE = 3
    OUT_OF_RANGE = 4
    NO_SUCH_REGISTER = 5
    UPLOAD_TORN = 6
    FAULT = 7


TRIP_TEXT: Final = {
    TripCause.NONE: "not tripped",
    TripCause.WATCHDOG: "watchdog: no heartbeat from the host",
    TripCause.HOST_LOST: "the host's connection ended while outputs or stream were on",
    TripCause.FAULT: "fault inside the device",
}
REFUSAL_TEXT: Final = {
    Refusal.NONE: "no reason given",
    Refusal.NOT_IN_CONTROL: "another client has control",
    Refusal.TRIPPED: "the device has tripped; find the cause, then reset it",
    Refusal.NOT_FINITE: "a value is not finite",
    Refusal.OUT_OF_RANGE: "a value is out of range",
    Refusal.NO_SUCH_REGISTER: "no such register, or not in this combination",
    Refusal.UPLOAD_TORN: "the waveform is incomplete or its checksum differs",
    Refusal.FAULT: "fault inside the device",
}


@dataclass(frozen=True)
class BlockLayout:
    """The size of a block: `samples` rows of `columns` registers behind a header of five."""

    samples: int
    channels: int
    joints: int

    @property
    def columns(self) -> int:
        """Registers of one sample: measured channels, then commands."""
        return self.channels + self.joints

    @property
    def words(self) -> int:
        """Registers of the whole answer."""
        return HEADER_WORDS + self.samples * self.columns


class BlockHeader(NamedTuple):
    """The header of a block."""

    sequence: int
    tick: int
    status: int  # bits of `Status`
    backlog: int


_HEADER = struct.Struct(">HIHH")


def block_layout(channels: int, joints: int) -> BlockLayout:
    """Return the largest block, up to ten samples, that fits an answer of 125 registers."""
    samples = min(MAX_BLOCK_SAMPLES, (MAX_READ - HEADER_WORDS) // (channels + joints))
    return BlockLayout(samples, channels, joints)


def pack_header(header: BlockHeader) -> bytes:
    """Return the ten bytes of a header; raises struct.error for a value that does not fit."""
    return _HEADER.pack(*header)


def unpack_header(data: bytes) -> BlockHeader:
    """Read a header from the first ten bytes; raises struct.error when there are fewer."""
    return BlockHeader._make(_HEADER.unpack_from(data))


def pack_samples(measured: ArrayLike, commands: ArrayLike) -> bytes:
    """Return the bytes of AD codes (n, channels) and signed DA codes (n, joints), row by row."""
    codes, outputs = np.asarray(measured), np.asarray(commands)
    rows = np.empty((len(codes), codes.shape[1] + outputs.shape[1]), ">u2")
    rows[:, : codes.shape[1]] = codes
    rows[:, codes.shape[1] :] = outputs  # two's complement, as the cast wraps
    return rows.tobytes()


def float_words(values: ArrayLike) -> list[int]:
    """Return two registers per value: IEEE 754 single precision, high word first."""
    return np.asarray(values, dtype=">f4").ravel().view(">u2").tolist()


def wave_checksum(codes: NDArray[np.int16]) -> int:
    """Return the CRC-32 (ISO 3309, as zlib's) over a waveform's codes, high byte first."""
    return zlib.crc32(np.asarray(codes).astype(">i2").tobytes())


def converter_checksum(rig: Rig) -> int:
    """Return the CRC-32 over every converter's range and bits, which both ends must share."""
    lines = []
    for name in rig.channels:
        sensor = rig.sensors.of(ch.kind_of(name)[0])
        low, high = sensor.range
        lines.append(f"{name} {low:.9g} {high:.9g} {sensor.bits}")
    for index, joint in enumerate(rig.joints, start=1):
        name = ch.channel(ch.COMMAND, index)
        lines.append(f"{name} {joint.valve.command_range:.9g} {joint.valve.command_bits}")
    return zlib.crc32("\n".join(lines).encode("ascii"))
