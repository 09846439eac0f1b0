"""Messages of a bench as frames on a CAN bus, and frames as messages (docs/wire-can.md).

Glossary: requests and answers are sent in *parts*, a number in each frame's first byte and the next
bytes of the message behind it; a sign of life is one frame; a block is a *sync* frame, its rows,
and a *check* frame with the CRC-32 that the same block would have as a message, so that a lost,
repeated, exchanged or foreign frame is detected.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.model.wire import serial_messages as msg
from rig.model.wire.can_layout import FD_SIZES, SESSION_BITS, CanLayout, CanMessage, CanSignal
from rig.model.wire.frames import MAX_BODY, WireFrame, decode_body, encode_body
from rig.model.wire.registers import BlockHeader, BlockLayout, Status
from rig.model.wire.serial_messages import Message

ZERO_KEY: Final = 0x5A  # equal from every host, so that two may send it at once
SESSION_MASK: Final = (1 << SESSION_BITS) - 1
_LENGTH: Final = struct.Struct(">H")
_CHECK: Final = struct.Struct(">I")


@dataclass(frozen=True, slots=True)
class CanFrame:
    """One frame: identifier (11 bits, or 29 where `extended`) and bytes."""

    identifier: int
    data: bytes
    extended: bool = False
    fd: bool = False

    @property
    def size(self) -> int:
        """Bytes of data."""
        return len(self.data)


def frame_of(message: CanMessage, data: bytes) -> CanFrame:
    """Return a frame of a message with these bytes."""
    return CanFrame(message.identifier, data, message.extended, message.fd)


# -- requests and answers ---------------------------------------------------------------------


def part_frames(message: CanMessage, content: WireFrame) -> list[CanFrame]:
    """Return the frames of a request or an answer; raises as `encode_body`."""
    body = encode_body(content)
    stream = _LENGTH.pack(len(body)) + body
    room = message.size - 1
    frames = []
    for part, first in enumerate(range(0, len(stream), room)):
        piece = bytes([part]) + stream[first : first + room]
        # CAN FD has certain frame sizes only; the length states where the message ends.
        size = next(size for size in FD_SIZES if size >= len(piece))
        frames.append(frame_of(message, piece.ljust(size, b"\0")))
    return frames


class PartCollector:
    """Joins the parts of messages; memory stays below one message.

    `damaged` counts parts that do not fit and messages with a wrong length or checksum.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self._stream = b""
        self._next = 0

    def feed(self, data: bytes) -> WireFrame | None:
        """Return the message that a frame completes, None if it is incomplete."""
        part = data[0] if data else -1
        if part == 0:
            self.damaged += self._next > 0  # the message before was not completed
            self._stream, self._next = b"", 0
        elif part != self._next or part < 0:
            self.damaged += 1
            self._next = 0
            return None
        self._stream += data[1:]
        self._next = part + 1
        if len(self._stream) < _LENGTH.size:
            return None
        (length,) = _LENGTH.unpack_from(self._stream)
        if length > MAX_BODY:
            self.damaged += 1
            self._next = 0
            return None
        if len(self._stream) < _LENGTH.size + length:
            return None
        self._next = 0
        message = decode_body(self._stream[_LENGTH.size : _LENGTH.size + length])
        self.damaged += message is None
        return message

    def reset(self) -> None:
        """Drop an incomplete message."""
        self._stream, self._next = b"", 0


# -- zero and signs of life -------------------------------------------------------------------


def zero_frame(layout: CanLayout) -> CanFrame:
    """Return the frame that zeroes all outputs at once."""
    return frame_of(layout.zero, layout.zero.pack({"zero_key": ZERO_KEY}))


def alive_frame(layout: CanLayout, note: WireFrame) -> CanFrame:
    """Return the frame of an `ALIVE_NOTE`; raises struct.error on a wrong payload."""
    alive = msg.unpack_alive(note.payload)
    values = {
        "alive_stream": note.number,
        "alive_acknowledge": alive.acknowledge,
        "alive_heartbeat": alive.heartbeat,
        "alive_session": note.session & SESSION_MASK,
        "alive_resend": int(alive.resend),
    }
    return frame_of(layout.alive, layout.alive.pack(values))


def read_alive(layout: CanLayout, data: bytes, session: int) -> WireFrame | None:
    """Return the `ALIVE_NOTE` of a frame's bytes, None if it is not of session `session`."""
    if len(data) < layout.alive.size:
        return None
    signals = layout.alive.unpack(data)
    if signals["alive_session"] & SESSION_MASK != session & SESSION_MASK:
        return None
    alive = msg.Alive(
        signals["alive_acknowledge"] & 0xFFFF,
        signals["alive_heartbeat"] & 0xFFFF,
        bool(signals["alive_resend"]),
    )
    number = signals["alive_stream"] & 0xFFFF
    return WireFrame(Message.ALIVE_NOTE, number, session, msg.pack_alive(alive))


# -- blocks -----------------------------------------------------------------------------------


def block_frames(layout: CanLayout, block: BlockLayout, message: WireFrame) -> list[CanFrame]:
    """Return the frames of a `BLOCK`; raises ValueError for one of another size."""
    pushed = msg.unpack_block(message.payload, block)
    codes = np.frombuffer(pushed.samples, ">u2").reshape(block.samples, block.columns).tolist()
    header = pushed.header
    sync = {
        "sync_tick": header.tick,
        "sync_sequence": header.sequence,
        "sync_status": int(header.status),
    }
    frames = [frame_of(layout.sync, layout.sync.pack(sync))]
    places = [
        (message, [(name, _column(layout, name)) for name in message.signals])
        for message in layout.rows
    ]
    for number, row in enumerate(codes):
        for part, columns in places:
            values = {
                name: number if column is None else _raw(part.signals[name], row[column])
                for name, column in columns
            }
            frames.append(frame_of(part, part.pack(values)))
    (checksum,) = _CHECK.unpack(encode_body(message)[-_CHECK.size :])
    check = {"check_sum": checksum, "check_oldest": pushed.oldest, "check_backlog": header.backlog}
    frames.append(frame_of(layout.check, layout.check.pack(check)))
    return frames


class BlockCollector:
    """Joins the frames of a block; `damaged` counts incomplete blocks.

    `feed` takes the stream (number of the request that started it) and the session that the block
    must have.
    """

    def __init__(self, layout: CanLayout, block: BlockLayout) -> None:
        self.damaged = 0
        self._layout, self._block = layout, block
        self._sync: dict[str, int] | None = None
        self._codes = self._empty()
        self._row = -1
        self._first = layout.rows[0].key
        self._number = layout.rows[0].signals["row"]
        self._columns = {
            message.key: [
                (column, signal)
                for name, signal in message.signals.items()
                if (column := _column(layout, name)) is not None
            ]
            for message in layout.rows
        }
        self._sizes = {
            message.key: message.size for message in (layout.sync, layout.check, *layout.rows)
        }

    def takes(self, key: int) -> bool:
        """Return whether a message of this key is part of a block."""
        return key in self._sizes

    def feed(self, key: int, data: bytes, number: int, session: int) -> WireFrame | None:
        """Return the `BLOCK` that a frame completes, None if it is incomplete."""
        if len(data) < self._sizes[key]:
            self._drop()
        elif key == self._layout.sync.key:
            self._sync = self._layout.sync.unpack(data)
            self._codes = self._empty()
            self._row = -1
        elif key == self._layout.check.key:
            return self._whole(self._layout.check.unpack(data), number, session)
        else:
            self._sample(key, data)
        return None

    def reset(self) -> None:
        """Drop an incomplete block."""
        self._sync = None

    def _empty(self) -> NDArray[np.int64]:
        return np.zeros((self._block.samples, self._block.columns), dtype=np.int64)

    def _drop(self) -> None:
        self.damaged += self._sync is not None
        self._sync = None

    def _sample(self, key: int, data: bytes) -> None:
        if key == self._first:
            self._row = self._number.read(data)
        if self._sync is None or not 0 <= self._row < self._block.samples:
            self._drop()
            return
        row = self._codes[self._row]
        for column, signal in self._columns[key]:
            row[column] = signal.read(data)

    def _whole(self, check: dict[str, int], number: int, session: int) -> WireFrame | None:
        sync, self._sync = self._sync, None
        if sync is None:
            return None
        header = BlockHeader(
            sync["sync_sequence"] & 0xFFFF,
            sync["sync_tick"] & 0xFFFF_FFFF,
            Status(sync["sync_status"] & 0xFFFF),
            check["check_backlog"] & 0xFFFF,
        )
        samples = (self._codes & 0xFFFF).astype(">u2").tobytes()
        pushed = msg.PushedBlock(check["check_oldest"] & 0xFFFF, header, samples)
        message = WireFrame(Message.BLOCK, number, session, msg.pack_block(pushed))
        (checksum,) = _CHECK.unpack(encode_body(message)[-_CHECK.size :])
        if checksum != check["check_sum"] & 0xFFFF_FFFF:
            self.damaged += 1
            return None
        return message


def _column(layout: CanLayout, name: str) -> int | None:
    """Return the column of a signal in a row, None for the row's number."""
    return layout.columns.index(name) if name in layout.columns else None


def _raw(signal: CanSignal, code: int) -> int:
    """Return the raw value of a 16-bit code; a signed one keeps its sign in any width."""
    return code - 0x10000 if signal.signed and code & 0x8000 else code


def frame_bits(frame: CanFrame | CanMessage) -> tuple[int, int]:
    """Return the largest number of bits of a frame: (at the nominal rate, at the data rate).

    ISO 11898-1: a classic frame of n bytes has 47 + 8 n bits (67 with 29 identifier bits), of which
    34 + 8 n (54) are stuffed: at worst one bit after every four. CAN FD with bit rate switch sends
    17 (36) bits before the switch, stuffed, and 13 after the checksum at the nominal rate; in
    between ESI, length code and data, stuffed, 4 bits of stuff count and 17 or 21 of checksum with
    a fixed stuff bit before every four.
    """
    n = frame.size
    if not frame.fd:
        most, stuffed = (67, 54) if frame.extended else (47, 34)
        return most + 8 * n + (stuffed + 8 * n - 1) // 4, 0
    before = 36 if frame.extended else 17
    checked = 4 + (17 if n <= 16 else 21)
    data = 5 + 8 * n
    return before + (before - 1) // 4 + 13, data + data // 4 + checked + -(-checked // 4)


def stream_seconds(
    layout: CanLayout, block: BlockLayout, bitrate: float, data_bitrate: float
) -> float:
    """Return the longest time that a block with its acknowledgement occupies the bus [s]."""

    def seconds(messages: Sequence[CanMessage]) -> float:
        pairs = [frame_bits(message) for message in messages]
        return sum(slow / bitrate + fast / data_bitrate for slow, fast in pairs)

    once = (layout.sync, layout.check, layout.alive)
    return seconds(once) + block.samples * seconds(layout.rows)
