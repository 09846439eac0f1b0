"""The simulated bench on a CAN bus: a `Device` behind an adapter, until a signal.

A node of a bus cannot detect the end of a program; its watchdog zeroes the outputs then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from hil_sim.device.can.adapters import Adapter
from hil_sim.device.device import Device
from hil_sim.device.lifetime import run_until, termination_signals
from hil_sim.device.message_session import MessageSession
from rig.model.rig import Rig
from rig.model.wire.can_database import database_text
from rig.model.wire.can_frames import (
    CanFrame,
    PartCollector,
    block_frames,
    part_frames,
    read_alive,
)
from rig.model.wire.can_layout import EXTENDED, CanLayout, read_layout


def layout_of(rig: Rig, *, fd: bool = False) -> CanLayout:
    """Return the messages of the default DBC file of a rig."""
    return read_layout(database_text(rig, fd=fd), f"the DBC made for {rig.name}", rig)


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


def serve_can(
    device: Device,
    adapter: Adapter,
    layout: CanLayout | None,
    on_ready: Callable[[str], None],
    parent: int | None,
) -> None:
    """Serve a device on a bus until SIGTERM, SIGINT or the end of process `parent`.

    `on_ready` is called once with the adapter's endpoint.
    """
    try:
        with termination_signals() as ended:
            on_ready(adapter.endpoint)
            run_device(adapter, device, layout or layout_of(device.rig), ended, parent)
    finally:
        device.zero()
        adapter.close()


def run_device(
    adapter: Adapter,
    device: Device,
    layout: CanLayout,
    ended: Sequence[object],
    parent: int | None = None,
    lock: AbstractContextManager[object] | None = None,
) -> None:
    """Serve a device until `ended` is not empty, or process `parent` has ended.

    `lock` is held except while waiting for frames, for other users of the device.
    """
    lock = lock or nullcontext()
    session = CanSession(device, layout)

    def step() -> None:
        received = adapter.receive(device.idle_seconds())
        with lock:
            for frame in received:
                adapter.send(session.receive(frame))
            device.poll()
            while adapter.free and (block := session.push()):
                adapter.send(block)

    run_until(ended, parent, step)
