"""Encode Modbus requests, and frames of TCP and serial lines; decode answers.

Glossary: a *PDU* is a function code and its data, a *frame* a PDU with its wire's header and
checksum. Sources: MODBUS Application Protocol V1.1b3, Messaging on TCP/IP V1.0b, MODBUS over Serial
Line V1.02.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

READ_HOLDING: Final = 3
READ_INPUT: Final = 4
WRITE_ONE: Final = 6
WRITE_MANY: Final = 16
WRITE_AND_READ: Final = 23
REFUSED: Final = 0x80  # added to the function of a refused request

_MBAP = struct.Struct(">HHHB")  # transaction, protocol (0), length of the rest, unit
_LONGEST: Final = 254  # [bytes] of unit and PDU
_COUNTED: Final = (READ_HOLDING, READ_INPUT, WRITE_AND_READ)  # answers with a byte count


class TcpFrame(NamedTuple):
    """The content of a frame of TCP; `used` is its length [bytes]."""

    transaction: int
    unit: int
    pdu: bytes
    used: int


def read_request(function: int, address: int, count: int) -> bytes:
    """Return the PDU that reads `count` registers by function 3 or 4."""
    return struct.pack(">BHH", function, address, count)


def write_request(address: int, words: Sequence[int]) -> bytes:
    """Return the PDU that writes registers by function 6 (one) or 16.

    Its first five bytes are its answer. Raises struct.error for an invalid register.
    """
    if len(words) == 1:
        return struct.pack(">BHH", WRITE_ONE, address, words[0])
    size = len(words)
    return struct.pack(f">BHHB{size}H", WRITE_MANY, address, size, 2 * size, *words)


def write_and_read_request(write_at: int, words: Sequence[int], read_at: int, count: int) -> bytes:
    """Return the PDU of function 23: registers written, then read."""
    size = len(words)
    return struct.pack(
        f">BHHHHB{size}H", WRITE_AND_READ, read_at, count, write_at, size, 2 * size, *words
    )


def payload_of(answer: bytes) -> bytes:
    """Return the registers' bytes of an answer; raises ValueError if their count is not as stated.

    An answer to a write has none.
    """
    if answer[0] not in _COUNTED:
        return b""
    if answer[1] != len(answer) - 2:
        raise ValueError(f"{len(answer) - 2} bytes follow a byte count of {answer[1]}")
    return answer[2:]


def tcp_frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """Return the frame of a PDU."""
    return _MBAP.pack(transaction, 0, len(pdu) + 1, unit) + pdu


def read_tcp_frame(data: bytes) -> TcpFrame | None:
    """Return the frame that begins `data`, None while it is incomplete.

    Raises ValueError for bytes that begin no frame.
    """
    if len(data) < _MBAP.size:
        return None
    transaction, protocol, length, unit = _MBAP.unpack_from(data)
    if protocol != 0 or not 3 <= length <= _LONGEST:
        raise ValueError("no frame of Modbus TCP")
    used = length + 6
    if len(data) < used:
        return None
    return TcpFrame(transaction, unit, data[7:used], used)


def _crc_of_byte(value: int) -> int:
    for _ in range(8):
        value = value >> 1 ^ (0xA001 if value & 1 else 0)
    return value


_CRC_TABLE: Final = tuple(map(_crc_of_byte, range(256)))


def crc16(data: bytes) -> bytes:
    """Return the CRC-16 of a serial line's frame, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """Return the frame of a PDU on a serial line."""
    body = bytes([unit]) + pdu
    return body + crc16(body)


def read_rtu_answer(data: bytes, unit: int) -> bytes | None:
    """Return the PDU of the first complete answer of `unit` in `data`, None if there is none.

    Earlier bytes (noise, a damaged frame) are skipped.
    """
    for start in range(len(data)):
        if data[start] != unit:
            continue
        length = _answer_length(data[start : start + 3])
        if length is None:
            return None  # the rest may still arrive
        frame = data[start : start + length]
        if length and len(frame) < length:
            return None
        if length and frame[-2:] == crc16(frame[:-2]):
            return frame[1:-2]
    return None


def _answer_length(head: bytes) -> int | None:
    """Return the length of an answer's frame [bytes] by its first three, None if they are fewer.

    0 if no answer begins like this.
    """
    if len(head) < 3:
        return None
    if head[1] & REFUSED:
        return 5
    if head[1] in _COUNTED:
        return 5 + head[2]
    return 8 if head[1] in (WRITE_ONE, WRITE_MANY) else 0
