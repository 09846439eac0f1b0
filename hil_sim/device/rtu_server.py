"""The simulated bench on Modbus RTU.

Frames are device address, function, data, CRC-16 (Modbus over Serial Line, section 2.5.1). A frame
that is damaged or for another address gets no answer, as on a real line.
"""

from __future__ import annotations

import logging
import time
from typing import Final

from pymodbus.framer.rtu import FramerRTU
from pymodbus.pdu import ExceptionResponse, ModbusPDU

from hil_sim.device.device import Device
from hil_sim.device.pdu import REQUESTS, Request
from hil_sim.device.register_map import DeviceRegisters

logger = logging.getLogger(__name__)

ADDRESS: Final = 1  # of this device on its line
GAP: Final = 0.02  # [s] of silence after which an unfinished frame is dropped
_FIXED: Final = {3: 8, 4: 8, 6: 8}  # whole length of requests without a byte count
# Position of the byte count, length without its bytes.
_COUNTED: Final = {16: (6, 9), 23: (10, 13)}
_BY_FUNCTION: Final = {request.function_code: request for request in REQUESTS}


class RtuSession:
    """The requests of a host on a serial line: it is permanent, its end is not detectable."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._registers = DeviceRegisters(device)
        self._received = b""
        self._last_byte = 0.0

    def receive(self, data: bytes) -> bytes:
        """Execute the requests that `data` completes; return the answers."""
        now = time.monotonic()
        if now - self._last_byte > GAP:
            self._received = b""
        self._last_byte = now
        self._received += data
        answers = b""
        while (length := frame_length(self._received)) is not None:
            if len(self._received) < length:
                break
            frame, self._received = self._received[:length], self._received[length:]
            answers += self._answer(frame)
        return answers

    def push(self) -> bytes:
        """Return nothing: a host asks for every block. Until then the next one is computed."""
        self._device.prefetch()
        return b""

    def ended(self) -> None:
        """Do nothing, as on a line without control signals."""

    def _answer(self, frame: bytes) -> bytes:
        if self._device.restarting:
            return b""
        if not checksum_matches(frame):
            logger.debug("a damaged frame of %d bytes is left unanswered", len(frame))
            self._received = b""
            return b""
        if frame[0] != ADDRESS:
            return b""
        request_class = _BY_FUNCTION.get(frame[1])
        if request_class is None:
            answer: ModbusPDU = ExceptionResponse(frame[1], 1)
        else:
            request = request_class()
            assert isinstance(request, Request)
            request.decode(frame[2:-2])
            answer = request.response_to(self._registers, self)
        if self._device.restarting:  # since it has begun to answer
            return b""
        body = bytes([ADDRESS, answer.function_code]) + answer.encode()
        return body + checksum(body)


def frame_length(data: bytes) -> int | None:
    """Return the length [bytes] of the first request in `data`, None if not known yet.

    An unknown function is taken as the shortest frame.
    """
    if len(data) < 2:
        return None
    if data[1] in _COUNTED:
        at, bare = _COUNTED[data[1]]
        return None if len(data) <= at else bare + data[at]
    return _FIXED.get(data[1], 4)


def checksum(data: bytes) -> bytes:
    """Return the CRC-16 of a frame's bytes, low byte first."""
    return FramerRTU.compute_CRC(data).to_bytes(2, "big")


def checksum_matches(frame: bytes) -> bool:
    """Return whether a frame's checksum is correct."""
    return frame[-2:] == checksum(frame[:-2])
