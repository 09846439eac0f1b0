"""The end of a frame in a stream of bytes, for each kind of wire.

A cutter returns the length of the first complete frame of a buffer, 0 while it is incomplete. On a
CAN bus behind an adapter, the adapter's text for a frame counts as the frame; other texts are not
traffic of the bus.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from hil_sim.device.rtu_server import frame_length
from hil_sim.faults.wire import Carrier

Cutter = Callable[[bytes], int]

_MBAP_LENGTH_ENDS: Final = 6  # transaction, protocol and length field of Modbus TCP
_RTU_COUNTED: Final = (3, 4, 23)  # answers with a byte count
_RTU_EXCEPTION: Final = 0x80


def every_frame(frame: bytes) -> bool:
    """Return True: every frame is one of the wire."""
    del frame
    return True


def no_error(frame: bytes) -> bytes:
    """Return no bytes in place of a frame that a controller has dropped."""
    del frame
    return b""


@dataclass(frozen=True)
class Framing:
    """How the frames of each direction are separated, and the layer that handles damaged ones.

    `on_wire` separates frames of the wire from an adapter's own messages, which no fault affects;
    `carrier` is None if it follows from the kind of link; `error_of` returns the host adapter's
    text for a frame that its controller has dropped.
    """

    to_device: Cutter
    to_host: Cutter
    on_wire: Callable[[bytes], bool] = every_frame
    carrier: Carrier | None = None
    error_of: Callable[[bytes], bytes] = no_error


def modbus_tcp(data: bytes) -> int:
    """Return the length of a Modbus TCP frame by its header."""
    if len(data) < _MBAP_LENGTH_ENDS:
        return 0
    return _if_complete(data, _MBAP_LENGTH_ENDS + int.from_bytes(data[4:6], "big"))


def rtu_request(data: bytes) -> int:
    """Return the length of a request on a Modbus RTU line."""
    return _if_complete(data, frame_length(data) or 0)


def rtu_answer(data: bytes) -> int:
    """Return the length of an answer on a Modbus RTU line."""
    if len(data) < 3:
        return 0
    if data[1] & _RTU_EXCEPTION:
        return _if_complete(data, 5)
    return _if_complete(data, 5 + data[2] if data[1] in _RTU_COUNTED else 8)


def between_zeros(data: bytes) -> int:
    """Return the length of a frame of the serial protocol, which ends with a zero byte."""
    first = len(data) - len(data.lstrip(b"\0"))
    return data.find(b"\0", first) + 1 if first < len(data) else 0


def socketcand_text(data: bytes) -> int:
    """Return the length of a text of socketcand: up to the next ``>``."""
    return data.find(b">") + 1


def socketcand_frame(text: bytes) -> bool:
    """Return whether a text of socketcand is a frame of the bus."""
    return text.split()[:2] in ([b"<", b"frame"], [b"<", b"send"])


def socketcand_error(text: bytes) -> bytes:
    """Return socketcand's text of an error frame, as candump shows one: class ``bus error``."""
    return b"< error 00000088 %s >" % text.split()[3]  # at the time of the frame that it replaces


def slcan_text(data: bytes) -> int:
    """Return the length of a text of an slcan adapter: up to its end or its error mark."""
    ends = [at for mark in (b"\r", b"\a") if (at := data.find(mark)) >= 0]
    return min(ends) + 1 if ends else 0


def slcan_frame(text: bytes) -> bool:
    """Return whether a text of an slcan adapter is a frame of the bus."""
    return text[:1] in (b"t", b"T", b"d", b"D", b"b", b"B")


def _if_complete(data: bytes, length: int) -> int:
    return length if 0 < length <= len(data) else 0
