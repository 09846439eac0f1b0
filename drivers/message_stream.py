"""The driver of a bench that exchanges messages, over any line."""

from __future__ import annotations

import logging
import secrets
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple
from itertools import count
from typing import ClassVar

from drivers.base import (
    Array,
    DeviceBusy,
    DeviceError,
    DeviceInfo,
    DeviceLost,
    OutputLaw,
    SampleBlock,
    WireSettings,
    check_count,
)
from drivers.bench_protocol import (
    VIRTUAL_TIMEOUT_FACTOR,
    DeviceRefused,
    DeviceSilent,
    check_identity,
    number_in,
    refusal_text,
    trip_text,
    wave_codes,
)
from drivers.message_link import MessageLine, MessageLink, RequestRefused
from drivers.modbus_blocks import BlockDecoder, unwrap
from drivers.settings import DRIVER
from rig.model.parts import Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.registers import Refusal, Status, TripCause
from rig.model.wire.serial_messages import Message

logger = logging.getLogger(__name__)

_STATUS_BYTES = 2 * (reg.STATUS_SPAN[1] - reg.STATUS_SPAN[0])
_IDENTITY_BYTES = 2 * (reg.IDENTITY_SPAN[1] - reg.IDENTITY_SPAN[0])


class MessageStreamDriver:
    """`drivers.base.Driver` over a `MessageLine`; see there for each call.

    A subclass for each kind of wire makes the line and names its settings.
    """

    settings: ClassVar[type[WireSettings]] = WireSettings
    host_timed: ClassVar[bool] = False

    def __init__(
        self, wire: Wire, rig: Rig, line: MessageLine, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._wire = wire
        self._rig = rig
        self._link = MessageLink(line, wire.timeout, clock)
        self._clock = clock
        self._layout = reg.block_layout(len(rig.channels), len(rig.joints))
        self._decoder = BlockDecoder(rig)
        self._heartbeat = secrets.randbits(16)
        self._capacity = reg.WAVE_CAPACITY
        self._stream: int | None = None  # number of the request that started it
        self._expected = 0  # number of the next block, modulo 2^16
        self._ready: deque[msg.PushedBlock] = deque()
        self._gap_reported_at: int | None = None  # the block already requested again after a gap
        self.info: DeviceInfo | None = None

    # -- session ----------------------------------------------------------------------------

    def connect(self) -> DeviceInfo:
        """Open the line, check that the device fits the rig, leave its outputs at zero."""
        self._stream = None
        self._link.open()
        try:
            self.info = self._identify()
            if self.info.virtual_time:
                self._link.extend_timeout(VIRTUAL_TIMEOUT_FACTOR)
            # This also zeroes the outputs and stops a stream.
            self._command(Message.OPEN, struct.pack(">H", round(self._wire.watchdog * 1e3)))
            self._decoder.restart(number_in(self._status(), reg.STATUS_TICK))
        except BaseException:
            self._link.close()
            raise
        return self.info

    def close(self) -> None:
        """Zero the outputs if the device still answers, then close; never raises."""
        try:
            if self._link.is_open:
                # With or without control: zero first, then release it.
                self._command(Message.ZERO)
                self._command(Message.CLOSE)
        except DeviceError as error:
            logger.debug("while closing: %s", error)
            # If only answers are lost, the next host need not wait for the watchdog.
            with suppress(DeviceError):
                self._link.send_unanswered(Message.CLOSE)
        finally:
            self._stream = None
            self._link.close()

    def close_tripped(self) -> None:
        """Zero the outputs, then close while streaming, so that the device latches a lost host.

        A device that cannot detect the closing latches it after its watchdog time.
        """
        try:
            if self._link.is_open:
                self._command(Message.ZERO)
        except DeviceError as error:
            logger.debug("while closing after a trip: %s", error)
        finally:
            self._stream = None
            self._link.close()

    def zero_outputs(self) -> None:
        """Put every output to zero now; reopens the line if need be, zero needs no control."""
        if self._link.is_open:
            try:
                self._link.request(Message.ZERO)
            except DeviceError as error:
                logger.warning("zeroing needs a second try: %s", error)
            else:
                return
        with suppress(DeviceBusy):
            self._link.open()
            self._zero_or_close()
            return
        # Another program has the line; messages of both arrive complete, and any host may zero.
        self._link.open(shared=True)
        self._zero_or_close()
        self._link.close()

    def reset(self) -> None:
        """Clear a latched trip of the device; only on a person's request."""
        self._command(Message.RESET, struct.pack(">H", reg.RESET_KEY))

    def trip_cause(self) -> str | None:
        """Return why the device has zeroed its outputs, None if it has not."""
        return trip_text(self._status())

    # -- outputs ----------------------------------------------------------------------------

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of joint `joint`'s (0-based) waveform [V]; it acts from `apply` on."""
        codes = wave_codes(self._rig, joint, wave, self._capacity)
        label = f"waveform of joint {joint + 1}"
        begin = msg.pack_upload_begin(joint + 1, len(codes))
        self._command(Message.UPLOAD_BEGIN, begin, label=label)
        samples = codes.astype(">i2").tobytes()
        for first in range(0, len(codes), msg.PAGE_SAMPLES):
            page = samples[2 * first : 2 * (first + msg.PAGE_SAMPLES)]
            self._command(Message.UPLOAD_PAGE, msg.pack_u32(first) + page, label=label)
        end = msg.pack_u32(reg.wave_checksum(codes))
        self._command(Message.UPLOAD_END, end, label=label)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws at one tick; `restart` starts the waveforms there. Returns that tick."""
        check_count(laws, self._rig)
        flag = reg.APPLY_AND_RESTART if restart else reg.APPLY
        payload = msg.pack_apply(flag, [astuple(law) for law in laws])
        answer = self._command(Message.APPLY, payload, 4, f"laws {list(laws)}")
        tick = int.from_bytes(answer, "big")
        self._decoder.refuse_restarted(tick)
        return unwrap(tick, self._decoder.tick, 32)

    # -- samples ----------------------------------------------------------------------------

    def start(self) -> None:
        """Start streaming blocks, with new sequence numbers and waveform phase."""
        self._decoder.restart()
        self._ready.clear()
        self._expected, self._gap_reported_at = 0, None
        # The first block may come before the answer, if that is lost once.
        self._stream = self._link.next_number()
        self._command(Message.START)

    def stop(self) -> None:
        """Stop streaming."""
        self._stream = None
        self._command(Message.STOP)

    def read_block(self) -> SampleBlock:
        """Return the next block, waiting for it; also feeds the device's watchdog."""
        if self._stream is None:
            self._check_stream(overdue=True)
        self._send_heartbeat()
        period = self._layout.samples / self._rig.sample_rate
        pause = period + min(DRIVER.resend, self._wire.watchdog / 5)
        deadline = self._clock() + period + self._link.answer_timeout
        earlier = ""  # the line's errors before the wait
        for waits in count(1):
            due = min(self._clock() + pause, deadline)
            while not self._ready and (remaining := due - self._clock()) > 0.0:
                self._link.listen(remaining)
                self._queue_blocks()
            if self._ready:
                break
            if waits == 1:
                earlier = self._link.complaint()
            # The heartbeat or the block was lost; the watchdog needs a heartbeat in any case.
            self._send_heartbeat(resend=True)
            if waits % DRIVER.notes_before_status == 0:
                self._check_stream(overdue=self._clock() >= deadline, earlier=earlier)
        block = self._ready.popleft()
        return self._decoder.decode_samples(block.header, block.samples)

    # -- inside -----------------------------------------------------------------------------

    def _address(self) -> str:
        """Return the line's name and rate, for errors before the device's identity is known."""
        return self._link.where

    def _identify(self) -> DeviceInfo:
        where = self._address()
        try:
            data = self._link.request(Message.IDENTIFY, size=_IDENTITY_BYTES)
        except DeviceRefused as refused:
            raise DeviceError(f"{refused}: it is no bench of this protocol") from refused
        except DeviceSilent as silent:
            raise DeviceLost(
                f"nothing answers at {where}; is the device (or `bramah sim`) running there? "
                f"({silent})"
            ) from None
        info = check_identity(data, self._rig, where)
        self._capacity = number_in(data, reg.IDENTITY_CAPACITY, reg.IDENTITY_SPAN[0])
        return info

    def _zero_or_close(self) -> None:
        try:
            self._link.request(Message.ZERO)
        except DeviceError:
            self._link.close()
            raise

    def _status(self) -> bytes:
        return self._link.request(Message.STATUS, size=_STATUS_BYTES)

    def _command(
        self, kind: Message, payload: bytes = b"", size: int = 0, label: str = ""
    ) -> bytes:
        try:
            return self._link.request(kind, payload, size, label)
        except RequestRefused as refused:
            if refused.reason != Refusal.TRIPPED:
                raise
            text = refusal_text(refused.reason, self.trip_cause())
            raise DeviceRefused(f"{refused.what}: {text}") from refused

    def _send_heartbeat(self, *, resend: bool = False) -> None:
        if self._stream is None:  # no block is expected between two streams
            return
        self._heartbeat = (self._heartbeat + 1) & 0xFFFF
        alive = msg.Alive((self._expected - 1) & 0xFFFF, self._heartbeat, resend)
        self._link.note(Message.ALIVE_NOTE, self._stream, msg.pack_alive(alive))

    def _queue_blocks(self) -> None:
        """Move received blocks that are in order to the ready ones; request missing ones again."""
        while self._link.blocks:
            frame = self._link.blocks.popleft()
            if frame.number != self._stream:
                self._link.late += 1
                continue
            try:
                block = msg.unpack_block(frame.payload, self._layout)
            except ValueError as error:
                self._link.close()
                raise DeviceError(f"the device at {self._link.where} sent a {error}") from error
            ahead = (block.header.sequence - self._expected) & 0xFFFF
            oldest_ahead = (block.oldest - self._expected) & 0xFFFF
            if 0 < ahead == oldest_ahead <= 0x7FFF:
                ahead = 0  # the device has dropped those between; the decoder counts them
            if ahead == 0:
                self._ready.append(block)
                self._expected = (block.header.sequence + 1) & 0xFFFF
                self._gap_reported_at = None
            elif ahead <= 0x7FFF and self._gap_reported_at != self._expected:
                logger.warning(
                    "block %d from %s is missing; asking again", self._expected, self._link.where
                )
                self._gap_reported_at = self._expected
                self._send_heartbeat(resend=True)

    def _check_stream(self, *, overdue: bool, earlier: str = "") -> None:
        """Raise DeviceError or DeviceLost if no block will come; `earlier`: the old complaint."""
        where = self._link.where
        try:
            status = self._status()
        except DeviceSilent as silent:
            self._link.close()
            raise DeviceLost(str(silent)) from None
        cause = trip_text(status)
        flags = Status(number_in(status, reg.STATUS_FLAGS))
        if not flags & Status.STREAMING or self._stream is None:
            if self._stream is not None:
                self._decoder.refuse_restarted(number_in(status, reg.STATUS_TICK))
            raise DeviceError(f"the device at {where} does not stream ({cause or 'not started'})")
        if number_in(status, reg.STATUS_CAUSE) == TripCause.FAULT:
            raise DeviceError(f"the device at {where} measures nothing any more: {cause}")
        self._queue_blocks()
        if overdue and not self._ready:
            complaint = self._link.complaint()
            damaged = complaint and complaint != earlier
            what = f"no block came whole; {complaint}" if damaged else "it has measured nothing"
            raise DeviceLost(
                f"the device at {where} answers, but for {self._link.answer_timeout:g} s {what}"
            )
