"""The simulated bench's side of the messages on a CAN bus."""

from __future__ import annotations

from hil_sim.device.device import Device
from hil_sim.device.message_session import MessageSession
from rig.model.rig import Rig
from rig.model.wire.can_database import database_text
from rig.model.wire.can_frames import CanFrame, PartCollector, block_frames, part_frames, read_alive
from rig.model.wire.can_layout import EXTENDED, CanLayout, read_layout


def layout_of(rig: Rig, *, fd: bool = False) -> CanLayout:
    """Return the messages of the default DBC file of a rig."""
    return read_layout(database_text(rig, fd=fd), f"the DBC made for {rig.name}", rig)


class CanSession:
    """A `MessageSession` with frames of a bus; frames with other identifiers are ignored.

    A node of a bus cannot detect the end of a program; its watchdog zeroes the outputs then.
    """

    def __init__(self, device: Device, layout: CanLayout | None = None) -> None:
        self._device, self._layout = device, layout or layout_of(device.rig)
        self._session = MessageSession(device)
        self._requests = PartCollector()

    def receive(self, frames: list[CanFrame]) -> list[CanFrame]:
        """Execute the messages that frames complete; return the frames of the answers."""
        return [answer for frame in frames for answer in self._received(frame)]

    def _received(self, frame: CanFrame) -> list[CanFrame]:
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

    def ended(self) -> None:
        """Do nothing: an adapter reports no end of a program."""

    def push(self) -> list[CanFrame]:
        """Return the frames of the next block if it may be sent, else none."""
        block = self._session.push()
        return [] if block is None else block_frames(self._layout, self._device.layout, block)
