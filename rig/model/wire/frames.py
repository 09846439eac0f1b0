"""Messages of a bench as bytes, and their frames on a serial line.

    body = header, payload, CRC-32 of both
    header = version u8, type u8, number u16, session u32; high byte first
    frame on a serial line = 00, COBS(body), 00

COBS (consistent overhead byte stuffing) leaves no zero inside, so that a receiver finds the next
frame after any damage. The header's layout is the same in every version of the protocol.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Final

from cobs import cobs

FRAME_VERSION: Final = 1
MAX_PAYLOAD: Final = 252  # a block of 125 registers and the two bytes before it
DELIMITER: Final = b"\0"

_HEADER: Final = struct.Struct(">BBHI")
_CHECK: Final = struct.Struct(">I")
_MIN_BODY: Final = _HEADER.size + _CHECK.size
MAX_BODY: Final = _MIN_BODY + MAX_PAYLOAD
MAX_ENCODED: Final = MAX_BODY + -(-MAX_BODY // 254)  # between the zeros: 266 bytes


@dataclass(frozen=True)
class WireFrame:
    """One message: its type, the request that it is or answers, its session."""

    type: int
    number: int
    session: int
    payload: bytes = b""
    version: int = FRAME_VERSION


def encode_body(frame: WireFrame) -> bytes:
    """Return header, payload and checksum of a message.

    Raises ValueError for a payload above `MAX_PAYLOAD` bytes, struct.error for a number that
    does not fit its field.
    """
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(f"payload of {len(frame.payload)} bytes; {MAX_PAYLOAD} at most")
    head = _HEADER.pack(frame.version, frame.type, frame.number, frame.session)
    body = head + frame.payload
    return body + _CHECK.pack(zlib.crc32(body))


def decode_body(body: bytes) -> WireFrame | None:
    """Return the message of a body, None if its size or checksum is wrong."""
    if not _MIN_BODY <= len(body) <= MAX_BODY:
        return None
    content, check = body[: -_CHECK.size], body[-_CHECK.size :]
    if _CHECK.pack(zlib.crc32(content)) != check:
        return None
    version, kind, number, session = _HEADER.unpack_from(content)
    return WireFrame(kind, number, session, content[_HEADER.size :], version)


def encode_frame(frame: WireFrame) -> bytes:
    """Return the bytes of a frame with the zeros around it; raises as `encode_body`."""
    stuffed: bytes = cobs.encode(encode_body(frame))
    return DELIMITER + stuffed + DELIMITER


class FrameDecoder:
    """Finds the frames in a stream of bytes, however it is divided; memory stays below one frame.

    `damaged` counts invalid content between two zeros, `received` all bytes.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self.received = 0
        self._partial = b""
        self._skipping = False  # in something too long for a frame, up to the next zero

    def feed(self, data: bytes) -> list[WireFrame]:
        """Return the frames that `data` completes; damaged ones are counted and left out."""
        self.received += len(data)
        *ended, begun = (self._partial + data).split(DELIMITER)
        frames = []
        for piece in ended:
            if self._skipping:
                self._skipping = False
            elif piece:
                frame = _decode(piece)
                if frame is None:
                    self.damaged += 1
                else:
                    frames.append(frame)
        if len(begun) > MAX_ENCODED:
            self.damaged += not self._skipping
            self._skipping = True
        self._partial = b"" if self._skipping else begun
        return frames

    def reset(self) -> None:
        """Drop an incomplete frame, because the line was opened anew."""
        self._partial = b""
        self._skipping = False


def _decode(piece: bytes) -> WireFrame | None:
    if len(piece) > MAX_ENCODED:
        return None
    try:
        return decode_body(cobs.decode(piece))
    except cobs.DecodeError:
        return None
