"""The device's side of the serial wire: bytes in, bytes out; no port, no clock."""

from __future__ import annotations

from hil_sim.device.device import Device
from hil_sim.device.message_session import MessageSession
from rig.model.wire.frames import FrameDecoder, encode_frame


class SerialSession:
    """A `MessageSession` with frames of a serial line."""

    def __init__(self, device: Device) -> None:
        self._session = MessageSession(device)
        self._decoder = FrameDecoder()

    def receive(self, data: bytes) -> bytes:
        """Execute the messages that `data` completes; return the answers."""
        answers = map(self._session.receive, self._decoder.feed(data))
        return b"".join(encode_frame(answer) for answer in answers if answer is not None)

    def push(self) -> bytes:
        """Return the frame of the next block if it may be sent, else nothing."""
        block = self._session.push()
        return b"" if block is None else encode_frame(block)

    def ended(self) -> None:
        """Note that no program has the other end of the line open."""
        self._decoder.reset()
        self._session.ended()
