"""The device's side of the CAN wire: frames in, frames out; no bus, no clock."""

from __future__ import annotations

from hil_sim.device.device import Device
from hil_sim.device.message_session import MessageSession
from rig.model.wire.can_frames import (
    CanFrame,
    PartCollector,
    block_frames,
    part_frames,
    read_alive,
)
from rig.model.wire.can_layout import EXTENDED, CanLayout


class CanSession:
    """A `MessageSession` with frames of a bus; frames with other identifiers are ignored."""

    def __init__(self, device: Device, layout: CanLayout) -> None:
        self._device, self._layout = device, layout
        self._session = MessageSession(device)
        self._requests = PartCollector()

    def receive(self, frame: CanFrame) -> list[CanFrame]:
        """Execute the message that a frame completes; return the frames of the answer."""
        key = frame.identifier | (EXTENDED if frame.extended else 0)
        if key == self._layout.zero.key:
            self._device.zero()
        elif key == self._layout.alive.key:
            session = self._session.session
            note = None if session is None else read_alive(self._layout, frame.data, session)
            if note is not None:
                self._session.receive(note)
        elif key == self._layout.request.key:
            request = self._requests.feed(frame.data)
            answer = None if request is None else self._session.receive(request)
            if answer is not None:
                return part_frames(self._layout.answer, answer)
        return []

    def push(self) -> list[CanFrame]:
        """Return the frames of the next block if it may be sent, else none."""
        block = self._session.push()
        return [] if block is None else block_frames(self._layout, self._device.layout, block)
