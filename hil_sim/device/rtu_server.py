"""The simulated bench on Modbus RTU: a `Device` behind a pseudo-terminal.

Frames are device address, function, data, CRC-16 (Modbus over Serial Line, section 2.5.1). A frame
that is damaged or for another address gets no answer, as on a real line.
"""

from __future__ import annotations

import asyncio
import logging
import os
import pty
import tty
from collections.abc import Callable
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


class RtuLine:
    """A serial line with one device's registers; `endpoint` is its other end.

    It is the device's client: one permanent host, whose end is not detectable.
    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._registers = DeviceRegisters(device)
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._slave = slave  # held open, so that a host that closes its end does not end the line
        os.set_blocking(self._master, False)
        self.endpoint = f"modbus-rtu://{os.ttyname(slave)}"
        self._received = b""
        self._last_byte = 0.0

    def attach(self, loop: asyncio.AbstractEventLoop) -> None:
        """Answer requests on this event loop."""
        self._loop = loop
        loop.add_reader(self._master, self._arrived)

    def close(self) -> None:
        """End the line."""
        self._loop.remove_reader(self._master)
        os.close(self._master)
        os.close(self._slave)

    def _arrived(self) -> None:
        data = os.read(self._master, 4096)
        now = self._loop.time()
        if now - self._last_byte > GAP:
            self._received = b""
        self._last_byte = now
        self._received += data
        while (length := frame_length(self._received)) is not None:
            if len(self._received) < length:
                break
            frame, self._received = self._received[:length], self._received[length:]
            try:
                self._answer(frame)
            except OSError as error:
                logger.error("a request failed: %s", error)
        self._device.prefetch()

    def _answer(self, frame: bytes) -> None:
        if self._device.restarting:
            return
        if not checksum_matches(frame):
            logger.debug("a damaged frame of %d bytes is left unanswered", len(frame))
            self._received = b""
            return
        if frame[0] != ADDRESS:
            return
        request_class = _BY_FUNCTION.get(frame[1])
        if request_class is None:
            answer: ModbusPDU = ExceptionResponse(frame[1], 1)
        else:
            request = request_class()
            assert isinstance(request, Request)
            request.decode(frame[2:-2])
            answer = request.response_to(self._registers, self)
        if self._device.restarting:  # since it has begun to answer
            return
        body = bytes([ADDRESS, answer.function_code]) + answer.encode()
        os.write(self._master, body + checksum(body))


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


async def serve_line(
    stop: asyncio.Event, device: Device, *, on_ready: Callable[[str], None]
) -> None:
    """Serve `device` on a new pseudo-terminal until `stop` is set; `on_ready` gets the endpoint."""
    line = RtuLine(device)
    line.attach(asyncio.get_running_loop())
    try:
        on_ready(line.endpoint)
        while not stop.is_set():
            device.poll()
            await asyncio.sleep(device.idle_seconds())
    finally:
        device.zero()
        line.close()
