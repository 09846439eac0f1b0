"""Messages over the bytes of a serial port: frames, and diagnosis of a wrong baud rate."""

from __future__ import annotations

from drivers.serial_transport import Transport
from rig.model.wire.frames import FrameDecoder, WireFrame, encode_frame


class SerialLine:
    """`drivers.message_link.MessageLine` over a `Transport`; see there for each call."""

    def __init__(self, transport: Transport) -> None:
        self.transport = transport
        self._decoder = FrameDecoder()
        self._damaged = self._received = 0  # when the line was opened

    @property
    def where(self) -> str:
        """The port's name."""
        return self.transport.where

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent and received."""
        return self.transport.is_open

    def open(self, *, shared: bool = False) -> None:
        """Open the port; raises as `Transport.open`."""
        self.transport.open(shared=shared)
        self._decoder.reset()
        self._damaged, self._received = self._decoder.damaged, self._decoder.received

    def send(self, message: WireFrame) -> None:
        """Send a message; raises DeviceLost when the port is lost."""
        self.transport.write(encode_frame(message))

    def receive(self, patience: float) -> list[WireFrame]:
        """Return the complete messages; raises DeviceLost when the port is lost."""
        return self._decoder.feed(self.transport.read(patience))

    def complaint(self, heard: int) -> str:
        """Return what may explain missing answers, or ''."""
        came = self._decoder.received - self._received
        if came and not heard:
            return (
                f"no valid frame in {came} bytes: check `baud`, which both ends must have, and "
                "that this is the bench's port"
            )
        damaged = self._decoder.damaged - self._damaged
        return f"{damaged} frames came damaged: check cable and baud rate" if damaged else ""

    def close(self) -> None:
        """Close the port; never raises."""
        self.transport.close()
