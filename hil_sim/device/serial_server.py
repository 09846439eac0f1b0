"""The simulated bench on a serial line: a `Device` behind a pty, until a signal.

When the last program closes the port, the device counts its host as lost, as if by DTR.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

from hil_sim.device.device import Device
from hil_sim.device.lifetime import run_until, termination_signals
from hil_sim.device.message_session import MessageSession
from hil_sim.device.pty_line import PtyLine
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
        """Handle the end of the connection: no program has the other end of the line open."""
        self._decoder.reset()
        self._session.ended()


def serve_serial(device: Device, on_ready: Callable[[str], None], parent: int | None) -> None:
    """Serve a device on a new pty until SIGTERM, SIGINT or the end of process `parent`.

    `on_ready` is called once with the endpoint, ``serial:///dev/pts/3``. Raises EndpointError where
    there are no pseudo terminals.
    """
    line = PtyLine()
    try:
        with termination_signals() as ended:
            on_ready(f"serial://{line.name}")
            serve_port(line, device, ended, parent)
    finally:
        device.zero()
        line.close()


def serve_port(
    line: PtyLine,
    device: Device,
    ended: Sequence[object],
    parent: int | None = None,
    lock: AbstractContextManager[object] | None = None,
) -> None:
    """Serve a device on a pty until `ended` is not empty, or process `parent` has ended.

    `lock` is held except while waiting for bytes, for other users of the device.
    """
    lock = lock or nullcontext()
    session = SerialSession(device)

    def step() -> None:
        received = line.receive(device.idle_seconds())
        with lock:
            if received is None:
                session.ended()
            elif received:
                line.send(session.receive(received))
            device.poll()
            while line.free and (block := session.push()):
                line.send(block)

    run_until(ended, parent, step)
