"""The messages of a bench on a serial line or a CAN bus: one definition for both ends.

They are described in docs/wire-serial.md and docs/wire-can.md.

Glossary: a *request* is answered, with its number and session; a *note* is not. A *session* is
the time of one host, named by a number that it draws. Values and codes are those of
`rig.model.wire.registers`: integers high byte first, floats of single precision.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from rig.model.wire import registers as reg
from rig.model.wire.frames import MAX_ENCODED, MAX_PAYLOAD
from rig.model.wire.registers import BlockHeader, BlockLayout

ANSWER: Final = 0x80  # added to the type of the request that is answered
WINDOW: Final = 8  # blocks that the device sends ahead of their acknowledgement
PAGE_SAMPLES: Final = reg.PAGE_SAMPLES
NOTHING_YET: Final = 0xFFFF  # acknowledged before a stream's first block


class Message(IntEnum):
    """Types of message; `BLOCK` and those that end in `_NOTE` have no answer."""

    IDENTIFY = 0x01
    STATUS = 0x02
    ZERO = 0x03
    OPEN = 0x10
    CLOSE = 0x11
    START = 0x12
    STOP = 0x13
    APPLY = 0x14
    RESET = 0x15
    UPLOAD_BEGIN = 0x18
    UPLOAD_PAGE = 0x19
    UPLOAD_END = 0x1A
    ALIVE_NOTE = 0x20
    BLOCK = 0x40
    REFUSED = 0xFF


# Carried out for every session and every repetition, because none causes motion.
FOR_ANYBODY: Final = frozenset({Message.IDENTIFY, Message.STATUS, Message.ZERO})


@dataclass(frozen=True)
class Alive:
    """The host's note while a stream runs.

    `acknowledge` is the number of the last block received in order, `heartbeat` feeds the
    watchdog when it differs from the one before, `resend` asks for the blocks after
    `acknowledge` again.
    """

    acknowledge: int
    heartbeat: int
    resend: bool = False


@dataclass(frozen=True)
class DeviceRefusal:
    """Why the device refused a request; `joint` is 1-based or 0."""

    reason: int
    joint: int = 0


@dataclass(frozen=True)
class PushedBlock:
    """A block as it is sent: `samples` are `BlockLayout.samples` rows of registers.

    `oldest` is the number of the oldest block that the device still has: earlier blocks that were
    not received are lost.
    """

    oldest: int
    header: BlockHeader
    samples: bytes


_ALIVE = struct.Struct(">HHH")
_PAIR = struct.Struct(">HH")
_OLDEST = struct.Struct(">H")


def pack_alive(alive: Alive) -> bytes:
    """Return the payload of an `ALIVE_NOTE`."""
    return _ALIVE.pack(alive.acknowledge, alive.heartbeat, alive.resend)


def unpack_alive(payload: bytes) -> Alive:
    """Read the payload of an `ALIVE_NOTE`; raises struct.error on a wrong size."""
    acknowledge, heartbeat, flags = _ALIVE.unpack(payload)
    return Alive(acknowledge, heartbeat, bool(flags & 1))


def pack_refusal(refusal: DeviceRefusal) -> bytes:
    """Return the payload of `REFUSED`."""
    return _PAIR.pack(refusal.reason, refusal.joint)


def unpack_refusal(payload: bytes) -> DeviceRefusal:
    """Read the payload of `REFUSED`; raises struct.error on a wrong size."""
    return DeviceRefusal(*_PAIR.unpack(payload))


def pack_apply(flag: int, laws: Sequence[Sequence[float]]) -> bytes:
    """Return the payload of `APPLY`: the flag, then five floats per joint.

    Values beyond single precision become infinite, which the device refuses.
    """
    values = np.array(laws)
    with np.errstate(over="ignore"):
        words = reg.float_words(values)
    return struct.pack(f">H{len(words)}H", flag, *words)


def pack_upload_begin(joint: int, samples: int) -> bytes:
    """Return the payload of `UPLOAD_BEGIN`; `joint` is 1-based."""
    return struct.pack(">HI", joint, samples)


def pack_u32(value: int) -> bytes:
    """Return four bytes, high byte first."""
    return struct.pack(">I", value)


def pack_block(block: PushedBlock) -> bytes:
    """Return the payload of `BLOCK`."""
    return _OLDEST.pack(block.oldest) + reg.pack_header(block.header) + block.samples


def unpack_block(payload: bytes, layout: BlockLayout) -> PushedBlock:
    """Read the payload of `BLOCK`; raises ValueError on a wrong size."""
    expected = _OLDEST.size + 2 * layout.words
    if len(payload) != expected:
        raise ValueError(f"block of {len(payload)} bytes, {expected} expected")
    header = reg.unpack_header(payload[_OLDEST.size :])
    samples = payload[_OLDEST.size + 2 * reg.HEADER_WORDS :]
    return PushedBlock(_OLDEST.unpack_from(payload)[0], header, samples)


def line_rate(layout: BlockLayout, sample_rate: float) -> float:
    """Return the largest bit rate [1/s] of a stream on a line of 10 bits a byte."""
    overhead = MAX_ENCODED - MAX_PAYLOAD + 2 + _OLDEST.size
    return 10.0 * sample_rate / layout.samples * (2 * layout.words + overhead)
