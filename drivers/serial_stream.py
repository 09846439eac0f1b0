"""The driver of a bench on a serial line (docs/wire-serial.md), and its line of messages."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import ClassVar

from pydantic import Field

from drivers.base import DeviceError, DeviceInfo, WireSettings
from drivers.message_stream import MessageStreamDriver
from drivers.serial_transport import PySerialTransport, Transport
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FrameDecoder, WireFrame, encode_frame


class SerialSettings(WireSettings):
    """The serial line: its port and its speed; a pty or USB-CDC ignores the speed."""

    example: ClassVar = "serial:///dev/ttyUSB0?baud=921600"

    device: str = Field(min_length=1, description="the port: /dev/ttyUSB0, COM3")
    baud: int = Field(default=921_600, ge=1200, le=20_000_000, description="[bit/s]")


class SerialLine:
    """`drivers.message_link.MessageLine` over a `Transport`; see there for each call."""

    def __init__(self, transport: Transport) -> None:
        self.transport, self.where = transport, transport.where
        self._decoder = FrameDecoder()
        self._damaged = self._received = 0  # when the line was opened

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

    def receive(self, timeout: float) -> list[WireFrame]:
        """Return the complete messages; raises DeviceLost when the port is lost."""
        return self._decoder.feed(self.transport.read(timeout))

    def complaint(self, heard: int) -> str:
        """Return what may explain missing answers, or ''."""
        received = self._decoder.received - self._received
        if received and not heard:
            return (
                f"no valid frame in {received} bytes: check `baud`, which both ends must have, and "
                "that this is the bench's port"
            )
        damaged = self._decoder.damaged - self._damaged
        return f"{damaged} frames came damaged: check cable and baud rate" if damaged else ""

    def close(self) -> None:
        """Close the port; never raises."""
        self.transport.close()


class SerialStreamDriver(MessageStreamDriver):
    """`drivers.base.Driver` over a serial line; see there for each call."""

    settings: ClassVar[type[WireSettings]] = SerialSettings

    def __init__(
        self,
        wire: Wire,
        rig: Rig,
        *,
        transport: Transport | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        settings = SerialSettings.of(wire)
        self._baud = settings.baud
        port = PySerialTransport(settings.device, settings.baud) if transport is None else transport
        super().__init__(wire, rig, SerialLine(port), clock)

    def connect(self) -> DeviceInfo:
        """Open the line, check that the device fits the rig, leave its outputs at zero."""
        if (problem := self.setup_problem()) is not None:
            raise DeviceError(problem)
        return super().connect()

    def setup_problem(self) -> str | None:
        """Return that the line is too slow for the stream, None if it is not."""
        needed = msg.line_rate(
            reg.block_layout(len(self._rig.channels), len(self._rig.joints)), self._rig.sample_rate
        )
        if self._baud >= needed:
            return None
        return (
            f"wire: baud: {self._baud} baud on {self._link.where} cannot carry "
            f"{len(self._rig.recorded)} values at {self._rig.sample_rate:g} Hz; "
            f"{needed:.0f} at least"
        )

    def _address(self) -> str:
        """Return the port and its speed."""
        return f"{self._link.where} ({self._baud} baud)"
