"""Messages over the frames of a CAN bus, and diagnosis of a wrong bus."""

from __future__ import annotations

import logging

from drivers.can_port import CanPort
from rig.model.wire.can_frames import (
    BlockCollector,
    PartCollector,
    alive_frame,
    part_frames,
    zero_frame,
)
from rig.model.wire.can_layout import CanLayout
from rig.model.wire.frames import WireFrame
from rig.model.wire.registers import BlockLayout
from rig.model.wire.serial_messages import Message

logger = logging.getLogger(__name__)


class CanLine:
    """`drivers.message_link.MessageLine` over a `CanPort`; see there for each call."""

    def __init__(self, port: CanPort, layout: CanLayout, block: BlockLayout, bitrate: int) -> None:
        self._port, self._layout, self._bitrate = port, layout, bitrate
        self._answers = PartCollector()
        self._blocks = BlockCollector(layout, block)
        self._damaged = 0  # when the bus was opened
        self._stream = (0, 0)  # the request that started it, its session

    @property
    def where(self) -> str:
        """The bus's name."""
        return self._port.where

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent and received."""
        return self._port.is_open

    @property
    def damaged(self) -> int:
        """Total of incomplete answers and blocks, and of blocks of other streams."""
        return self._answers.damaged + self._blocks.damaged

    def open(self, *, shared: bool = False) -> None:
        """Open the bus; raises as `CanPort.open`."""
        self._port.open(shared=shared)
        self._answers.reset()
        self._blocks.reset()
        self._damaged = self.damaged

    def send(self, message: WireFrame) -> None:
        """Send a message; raises DeviceLost when the bus is lost."""
        if message.type == Message.ALIVE_NOTE:
            self._port.send(alive_frame(self._layout, message))
            return
        if message.type == Message.ZERO:
            # One frame of highest priority, which cannot mix with requests of others; the request
            # after it is answered.
            self._port.send(zero_frame(self._layout))
        if message.type == Message.START:
            self._stream = (message.number, message.session)
        for frame in part_frames(self._layout.request, message):
            self._port.send(frame)

    def receive(self, patience: float) -> list[WireFrame]:
        """Return the complete messages; raises DeviceLost when the bus is lost."""
        messages = []
        for key, data in self._port.receive(patience):
            if self._blocks.takes(key):
                message = self._blocks.feed(key, data, *self._stream)
            else:
                message = self._answers.feed(data)
            if message is not None:
                messages.append(message)
        return messages

    def complaint(self, heard: int) -> str:
        """Return what may explain missing answers, or ''."""
        seen = self._port.seen
        if seen.errors:
            return (
                f"{seen.errors} error frames came: check that every node runs at {self._bitrate} "
                "bit/s, and the termination"
            )
        if not heard and seen.accepted:
            return (
                f"{seen.accepted} frames with the bench's identifiers came, none a whole message: "
                "another node uses them, or the device has another DBC file"
            )
        if not heard and seen.foreign:
            return (
                f"{seen.foreign} frames came, none with an identifier of {self._layout.source}: "
                "check the DBC file and that this is the bench's bus"
            )
        if not heard:
            return (
                "no frame came: check wiring, termination and that the bus runs at "
                f"{self._bitrate} bit/s"
            )
        if seen.overrun:
            return f"{seen.overrun} frames came faster than this program took them"
        damaged = self.damaged - self._damaged
        return f"{damaged} messages came damaged: check wiring and termination" if damaged else ""

    def close(self) -> None:
        """Close the bus; never raises."""
        self._port.close()
