"""Where a frame ends in a stream of bytes, for each kind of wire.

A cutter returns the length of the first whole frame of a buffer, 0 while it is not complete.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hil_sim.device.rtu_server import frame_length

Cutter = Callable[[bytes], int]

_MBAP_LENGTH_ENDS: Final = 6  # transaction, protocol and length field of Modbus TCP
_RTU_COUNTED: Final = (3, 4, 23)  # answers with a byte count
_RTU_EXCEPTION: Final = 0x80


@dataclass(frozen=True)
class Framing:
    """How the frames of each way are told apart."""

    to_device: Cutter
    to_host: Cutter


def modbus_tcp(data: bytes) -> int:
    """Return the length of a Modbus TCP frame by its header."""
    if len(data) < _MBAP_LENGTH_ENDS:
        return 0
    return _whole(data, _MBAP_LENGTH_ENDS + int.from_bytes(data[4:6], "big"))


def rtu_request(data: bytes) -> int:
    """Return the length of a request on a Modbus RTU line."""
    return _whole(data, frame_length(data) or 0)


def rtu_answer(data: bytes) -> int:
    """Return the length of an answer on a Modbus RTU line."""
    if len(data) < 3:
        return 0
    if data[1] & _RTU_EXCEPTION:
        return _whole(data, 5)
    return _whole(data, 5 + data[2] if data[1] in _RTU_COUNTED else 8)


def between_zeros(data: bytes) -> int:
    """Return the length of a frame of the serial protocol: what ends with the next zero."""
    begun = len(data) - len(data.lstrip(b"\0"))
    return data.find(b"\0", begun) + 1 if begun < len(data) else 0


def _whole(data: bytes, length: int) -> int:
    return length if 0 < length <= len(data) else 0
