"""Execute a host's messages on the device and return answers and blocks; no line, no clock.

Glossary: a request is *late* when a newer one of its session was carried out: it is dropped. The
newest one is *remembered* with its answer, which is sent again when the request is repeated.
"""

from __future__ import annotations

import logging
import struct
from collections.abc import Callable
from dataclasses import dataclass

from hil_sim.device.device import Device
from hil_sim.device.laws import Refused
from hil_sim.device.register_map import DeviceRegisters
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FRAME_VERSION, FrameDecoder, WireFrame, encode_frame
from rig.model.wire.registers import BlockHeader, Refusal, Register, Status
from rig.model.wire.serial_messages import ANSWER, FOR_ANYBODY, WINDOW, Message

logger = logging.getLogger(__name__)

_U32 = 0xFFFF_FFFF
_LATE = 0x8000  # numbers further ahead than this count as older


@dataclass(eq=False)
class _Host:
    """One session: the device's client."""

    session: int
    number: int  # of the newest request executed
    answer: WireFrame | None = None


class MessageSession:
    """Executes messages on one device; returns the messages to send."""

    def __init__(self, device: Device) -> None:
        self._device = device
        device.on_restart = self._restarted
        self._registers = DeviceRegisters(device)
        self._host: _Host | None = None
        self._stream = 0  # number of the request that started it
        self._next = 0  # number of the block to be sent next
        laws = 2 + 2 * reg.LAW_WORDS * device.laws.joints
        # What a request does, and the least and the largest size of its payload [bytes].
        self._requests: dict[int, tuple[Callable[[_Host, bytes], bytes], int, int]] = {
            Message.CLOSE: (self._close, 0, 0),
            Message.START: (self._start, 0, 0),
            Message.STOP: (self._stop, 0, 0),
            Message.APPLY: (self._apply, laws, laws),
            Message.RESET: (self._writer_of(reg.CONTROL_RESET), 2, 2),
            Message.UPLOAD_BEGIN: (self._writer_of(reg.UPLOAD_JOINT), 6, 6),
            Message.UPLOAD_PAGE: (self._writer_of(reg.UPLOAD_OFFSET), 6, 4 + 2 * msg.PAGE_SAMPLES),
            Message.UPLOAD_END: (self._writer_of(reg.UPLOAD_COMMIT), 4, 4),
        }

    @property
    def session(self) -> int | None:
        """The number of the session in control, None without one."""
        return None if self._host is None else self._host.session

    def receive(self, frame: WireFrame) -> WireFrame | None:
        """Execute a message; return its answer, None if it has none."""
        if self._device.restarting:
            return None
        if frame.type == Message.ALIVE_NOTE:
            self._take_heartbeat(frame)
            return None
        host = self._host
        current = host is not None and host.session == frame.session
        if host is not None and current and frame.version == FRAME_VERSION:
            age = (frame.number - host.number) & 0xFFFF
            if frame.type not in FOR_ANYBODY:
                if age == 0 and host.answer is not None:
                    return host.answer
                if age == 0 or age >= _LATE:
                    logger.debug("late request %d dropped", frame.number)
                    return None
            if 0 < age < _LATE:
                host.number, host.answer = frame.number, None
        try:
            answer = WireFrame(
                frame.type | ANSWER, frame.number, frame.session, self._execute(frame, current)
            )
        except Refused as refused:
            payload = msg.pack_refusal(msg.DeviceRefusal(refused.reason, refused.joint))
            answer = WireFrame(Message.REFUSED, frame.number, frame.session, payload)
        host = self._host
        if host is not None and host.session == frame.session and frame.type not in FOR_ANYBODY:
            host.answer = answer
        return None if self._device.restarting else answer

    def push(self) -> WireFrame | None:
        """Return the next block that may be sent, else None."""
        device, host = self._device, self._host
        oldest = device.queue.queued(0)
        if host is None or oldest is None or not device.streaming:
            return None
        index = (self._next - oldest.sequence) & 0xFFFF
        if index > len(device.queue):
            index = 0  # the next block was dropped from a full queue
        block = device.queue.queued(index)
        if block is None or index >= WINDOW:
            return None
        self._next = (block.sequence + 1) & 0xFFFF
        status = device.status | Status.BLOCK
        backlog = len(device.queue) - index - 1
        header = BlockHeader(block.sequence, block.tick & _U32, status, backlog)
        payload = msg.pack_block(msg.PushedBlock(oldest.sequence, header, block.samples))
        return WireFrame(Message.BLOCK, self._stream, host.session, payload)

    def _restarted(self) -> None:
        self._host, self._stream, self._next = None, 0, 0

    def ended(self) -> None:
        """Handle the end of the connection: no program has the other end of the line open."""
        host, self._host = self._host, None
        if host is not None:
            self._device.disconnected(host)

    # -- requests ---------------------------------------------------------------------------

    def _execute(self, frame: WireFrame, current: bool) -> bytes:
        if frame.version != FRAME_VERSION:
            raise Refused(Refusal.NO_SUCH_REGISTER)
        if frame.type in FOR_ANYBODY:
            _require_size(frame.payload, 0, 0)
            return self._for_anybody(frame.type)
        if frame.type == Message.OPEN:
            return self._open(frame, current)
        if frame.type not in self._requests:
            raise Refused(Refusal.NO_SUCH_REGISTER)
        if self._host is None or not current:
            raise Refused(Refusal.NOT_IN_CONTROL)
        request, least, most = self._requests[frame.type]
        _require_size(frame.payload, least, most)
        return request(self._host, frame.payload)

    def _for_anybody(self, kind: int) -> bytes:
        if kind == Message.ZERO:
            self._device.zero()
            return b""
        first, end = reg.IDENTITY_SPAN if kind == Message.IDENTIFY else reg.STATUS_SPAN
        return self._registers.read(None, first, end - first)

    def _open(self, frame: WireFrame, current: bool) -> bytes:
        _require_size(frame.payload, 2, 2)
        host = self._host if current and self._host else _Host(frame.session, frame.number)
        self._device.take_control(host)
        self._host = host
        self._registers.write(host, reg.CONTROL_WATCHDOG.address, frame.payload)
        self._device.zero()
        self._device.stop()
        return b""

    def _close(self, host: _Host, payload: bytes) -> bytes:
        self._device.take_control(host)
        self._device.zero()
        self._device.stop()
        self._device.disconnected(host)
        return b""

    def _start(self, host: _Host, payload: bytes) -> bytes:
        self._command(host, reg.CONTROL_STREAM, reg.STREAM_START)
        self._stream, self._next = host.number, 0
        return b""

    def _stop(self, host: _Host, payload: bytes) -> bytes:
        self._command(host, reg.CONTROL_STREAM, reg.STREAM_STOP)
        return b""

    def _apply(self, host: _Host, payload: bytes) -> bytes:
        self._registers.write(host, reg.LAWS.address, payload[2:])
        self._registers.write(host, reg.CONTROL_APPLY.address, payload[:2])
        return self._registers.read(host, reg.STATUS_APPLY_TICK.address, 2)

    def _writer_of(self, register: Register) -> Callable[[_Host, bytes], bytes]:
        def write(host: _Host, payload: bytes) -> bytes:
            self._registers.write(host, register.address, payload)
            return b""

        return write

    def _command(self, host: _Host, register: Register, value: int) -> None:
        self._registers.write(host, register.address, struct.pack(">H", value))

    # -- the stream -------------------------------------------------------------------------

    def _take_heartbeat(self, frame: WireFrame) -> None:
        host, device = self._host, self._device
        if host is None or frame.session != host.session or frame.version != FRAME_VERSION:
            return
        try:
            alive = msg.unpack_alive(frame.payload)
            device.beat(host, alive.heartbeat)
            if frame.number != self._stream or not device.streaming:
                return
            device.queue.release(alive.acknowledge)
            oldest = device.queue.queued(0)
            if alive.resend and oldest is not None:
                self._next = oldest.sequence
            device.measure_ahead()
        except (Refused, struct.error) as error:
            logger.debug("note of the host dropped: %s", error)


def _require_size(payload: bytes, least: int, most: int) -> None:
    if not least <= len(payload) <= most or len(payload) % 2:
        raise Refused(Refusal.NO_SUCH_REGISTER)


class SerialSession:
    """A `MessageSession` with frames of a serial line.

    When the last program closes the port, the device counts its host as lost, as if by DTR.
    """

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
