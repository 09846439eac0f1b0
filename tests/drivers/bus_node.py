"""The simulated bench as a node on a bus of python-can, as no program of Bramah runs it.

`virtual` is a bus inside one process, `socketcan` a real or a virtual one of Linux.
"""

from __future__ import annotations

import errno
import logging
import time
from typing import Any

import can

from hil_sim.device.lifetime import EndpointError
from rig.model.wire.can_frames import CanFrame

logger = logging.getLogger(__name__)


class BusNode:
    """An `Adapter` that is a node of a python-can bus; raises EndpointError without one."""

    def __init__(self, bus: str, **rates: Any) -> None:
        interface, _, channel = bus.partition("/")
        self.endpoint = f"can://{bus}"
        self.free = True
        try:
            self._bus = can.Bus(interface=interface, channel=channel, **rates)
        except (can.CanError, OSError, ValueError, ImportError) as error:
            raise EndpointError(f"cannot be a node of {bus}: {error}") from error

    def receive(self, timeout: float) -> list[CanFrame]:
        """Return the frames of the bus; see `Adapter`."""
        frames = []
        message = self._bus.recv(timeout)
        while message is not None:
            if not message.is_error_frame and not message.is_remote_frame:
                data = bytes(message.data)
                frames.append(
                    CanFrame(message.arbitration_id, data, message.is_extended_id, message.is_fd)
                )
            message = self._bus.recv(0.0)
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames, waiting for room; see `Adapter`."""
        for frame in frames:
            message = can.Message(
                arbitration_id=frame.identifier,
                data=frame.data,
                is_extended_id=frame.extended,
                is_fd=frame.fd,
                bitrate_switch=frame.fd,
            )
            while not self._taken(message):
                time.sleep(0.001)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()

    def _taken(self, message: can.Message) -> bool:
        try:
            self._bus.send(message, timeout=1.0)
        except can.CanError as error:
            if getattr(error, "error_code", None) == errno.ENOBUFS:
                return False
            logger.warning("a frame was not sent: %s", error)
        return True
