"""The driver of a bench on Modbus TCP (docs/wire-modbus-tcp.md)."""

from __future__ import annotations

import logging
import math
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple
from typing import Any, ClassVar, Final
from urllib.parse import SplitResult

import numpy as np
from pydantic import Field

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
    AnswerDamaged,
    DeviceRefused,
    DeviceSilent,
    check_identity,
    number_in,
    refusal_text,
    trip_text,
    wave_codes,
)
from drivers.modbus_blocks import BlockDecoder, unwrap
from drivers.modbus_frames import write_and_read_request
from drivers.modbus_transport import ModbusConnection, TcpConnection
from drivers.settings import DRIVER
from rig.model.parts import LOCALHOST, PORT, Wire
from rig.model.rig import Rig
from rig.model.wire import registers as reg
from rig.model.wire.registers import Refusal, Status

logger = logging.getLogger(__name__)

_BLOCK: Final = int(Status.BLOCK)
_STREAMING: Final = int(Status.STREAMING)
_ACKNOWLEDGEMENT: Final = struct.Struct(">HH")  # a block's number, the heartbeat


class TcpSettings(WireSettings):
    """The device's address."""

    example: ClassVar = "modbus-tcp://127.0.0.1:5020"

    host: str = LOCALHOST
    port: int = Field(default=PORT, ge=1, le=65535)

    @classmethod
    def of_endpoint(cls, url: SplitResult) -> Mapping[str, Any]:
        """Return host and port; raises ValueError where one is missing."""
        if not url.hostname or not url.port:
            raise ValueError("no host or no port")
        return {"host": url.hostname, "port": url.port}


class ModbusTcpDriver:
    """`drivers.base.Driver` over Modbus TCP; see there for each call."""

    settings: ClassVar[type[WireSettings]] = TcpSettings
    host_timed: ClassVar[bool] = False

    def __init__(
        self, wire: Wire, rig: Rig, *, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        self._wire = wire
        self._rig = rig
        self._sleep = sleep
        # Two tries before a silent device counts as lost.
        self._link = self.connection(wire, wire.timeout / 2)
        # A block is requested again early enough that a lost answer trips neither watchdog.
        self._wait = min(wire.timeout / 2, wire.watchdog / 4)
        self._tries = math.ceil(wire.timeout / self._wait - 1e-9)
        self._layout = reg.block_layout(len(rig.channels), len(rig.joints))
        self._period = self._layout.samples / rig.sample_rate  # [s] of a block
        self._decoder = BlockDecoder(rig)
        # The request for a block, to which the acknowledgement is appended.
        self._block_request = write_and_read_request(
            reg.CONTROL_ACK.address, [0, 0], reg.BLOCK.address, self._layout.words
        )[: -_ACKNOWLEDGEMENT.size]
        self._heartbeat = 0
        self._due: float | None = None  # when the next block can be ready [s], by time.monotonic
        self.info: DeviceInfo | None = None

    @staticmethod
    def connection(wire: Wire, timeout: float) -> ModbusConnection:
        """Return the closed connection to the device, which waits `timeout` [s] for an answer."""
        settings = TcpSettings.of(wire)
        return TcpConnection(settings.host, settings.port, timeout)

    # -- session ----------------------------------------------------------------------------

    def connect(self) -> DeviceInfo:
        """Open the wire, check that the device fits the rig, leave its outputs at zero."""
        self._link.open()
        try:
            self.info = self._identify()
            if self.info.virtual_time:
                self._link.extend_timeout(VIRTUAL_TIMEOUT_FACTOR)
            self._command(reg.CONTROL_WATCHDOG, round(self._wire.watchdog * 1e3))
            self._command(reg.CONTROL_ZERO, reg.ZERO_NOW)
            self._command(reg.CONTROL_STREAM, reg.STREAM_STOP)
            self._decoder.restart(number_in(self._status(), reg.STATUS_TICK))
        except BaseException:
            self._link.close()
            raise
        return self.info

    def close(self) -> None:
        """Zero the outputs if the device still answers, then close; never raises."""
        if self._command_before_closing(reg.CONTROL_ZERO, reg.ZERO_NOW):
            self._command_before_closing(reg.CONTROL_STREAM, reg.STREAM_STOP)
        # A device that lost its controller zeroes its outputs by itself.
        with suppress(OSError):
            self._link.close()

    def close_tripped(self) -> None:
        """Zero the outputs, then close while streaming, so that the device latches a lost host."""
        self._command_before_closing(reg.CONTROL_ZERO, reg.ZERO_NOW)
        with suppress(OSError):
            self._link.close()

    def _command_before_closing(self, register: reg.Register, value: int) -> bool:
        """Write one command, twice if the first answer is late or damaged; return its success."""
        for _ in range(2):
            if not self._link.is_open:
                return False
            try:
                self._command(register, value)
            except DeviceError as error:
                logger.debug("while closing: %s", error)
            else:
                return True
        return False

    def zero_outputs(self) -> None:
        """Put every output to zero now; reconnects if need be, zero needs no control."""
        if self._link.is_open:
            try:
                self._link.write(reg.CONTROL_ZERO.address, [reg.ZERO_NOW])
            except DeviceError as error:
                logger.warning("zeroing needs a second try: %s", error)
            else:
                return
        self._link.open()
        try:
            self._link.write(reg.CONTROL_ZERO.address, [reg.ZERO_NOW])
        except DeviceError:
            self._link.close()
            raise

    def reset(self) -> None:
        """Clear a latched trip of the device; only on a person's request."""
        self._command(reg.CONTROL_RESET, reg.RESET_KEY)

    def trip_cause(self) -> str | None:
        """Return why the device has zeroed its outputs, None if it has not."""
        return trip_text(self._status())

    # -- outputs ----------------------------------------------------------------------------

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of joint `joint`'s (0-based) waveform [V]; it acts from `apply` on."""
        codes = wave_codes(self._rig, joint, wave)
        label = f"waveform of joint {joint + 1}"
        words = codes.view(np.uint16).tolist()
        self._control(reg.UPLOAD_JOINT.address, [joint + 1, *_u32(len(words))], label)
        for first in range(0, len(words), reg.PAGE_SAMPLES):
            page = words[first : first + reg.PAGE_SAMPLES]
            self._control(reg.UPLOAD_OFFSET.address, [*_u32(first), *page], label)
        self._control(reg.UPLOAD_COMMIT.address, _u32(reg.wave_checksum(codes)), label)

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        """Set all laws at one tick; `restart` starts the waveforms there. Returns that tick."""
        check_count(laws, self._rig)
        values = np.array([astuple(law) for law in laws])
        with np.errstate(over="ignore"):  # the device refuses values beyond single precision
            words = reg.float_words(values)
        self._control(reg.LAWS.address, words, f"laws {list(laws)}")
        flag = reg.APPLY_AND_RESTART if restart else reg.APPLY
        apply = write_and_read_request(
            reg.CONTROL_APPLY.address, [flag], reg.STATUS_APPLY_TICK.address, 2
        )
        try:
            answer = self._link.registers(apply, 2)
        except DeviceRefused as refused:
            raise self._with_reason(refused, "apply") from refused
        tick = int.from_bytes(answer, "big")
        self._decoder.refuse_restarted(tick)
        return unwrap(tick, self._decoder.tick, 32)

    # -- samples ----------------------------------------------------------------------------

    def start(self) -> None:
        """Start streaming blocks, with new sequence numbers and waveform phase."""
        self._command(reg.CONTROL_STREAM, reg.STREAM_START)
        self._decoder.restart()
        self._due = None

    def stop(self) -> None:
        """Stop streaming."""
        self._command(reg.CONTROL_STREAM, reg.STREAM_STOP)

    def ask_ahead(self) -> None:
        """Request the next block of a device in virtual time, which computes it meanwhile."""
        if self.info is not None and self.info.virtual_time and self._link.pipelines:
            self._link.ask_ahead(self._next_request(), self._layout.words)

    def read_block(self) -> SampleBlock:
        """Return the next block, waiting for it; also feeds the device's watchdog."""
        period = self._period
        now = time.monotonic()
        if self._due is not None and now < self._due:
            self._sleep(self._due - now)
        deadline = now + period + self._wire.timeout
        at_once = True
        while True:
            answer = self._request_block()
            header = reg.unpack_header(answer)
            if header.status & _BLOCK and self._decoder.was_decoded(header):
                # The device does not repeat an acknowledged block: a late answer.
                logger.warning("block %d came a second time; asking again", header.sequence)
                self._link.settle()
            elif header.status & _BLOCK:
                self._due = self._next_due(header.backlog, period, at_once=at_once)
                return self._decoder.decode(header, answer)
            elif not header.status & _STREAMING:
                self._decoder.refuse_restarted(header.tick)
                raise DeviceError(
                    f"the device at {self._link.where} does not stream "
                    f"({self.trip_cause() or 'not started'})"
                )
            now = time.monotonic()
            if now > deadline:
                raise DeviceLost(
                    f"the device at {self._link.where} answers, but has measured nothing for "
                    f"{self._wire.timeout:g} s"
                )
            at_once = False
            self._sleep(DRIVER.retry * period)

    # -- inside -----------------------------------------------------------------------------

    def _next_due(self, backlog: int, period: float, *, at_once: bool) -> float | None:
        """Return when the next block can be ready [s, monotonic], None if it may be now.

        Requests cost time at both ends. A block that was ready at the first request may have
        waited: the next is requested slightly earlier, so that the host finds the device's clock
        and follows it.
        """
        if backlog or (self.info is not None and self.info.virtual_time):
            return None
        if not at_once:
            return time.monotonic() + (1.0 - DRIVER.earlier) * period
        if self._due is None:  # it may have waited for almost a period
            return time.monotonic() + DRIVER.retry * period
        return self._due + (1.0 - DRIVER.earlier) * period

    def _request_block(self) -> bytes:
        last_error: DeviceSilent | None = None
        for attempt in range(self._tries):
            try:
                if attempt:
                    self._link.settle()
                if self._link.asked_ahead:
                    answer = self._link.answer_ahead(self._wait)
                else:
                    request = self._next_request()
                    answer = self._link.registers(request, self._layout.words, self._wait)
            except DeviceRefused as refused:
                raise self._with_reason(refused, "block") from refused
            except DeviceSilent as silent:
                # The block stays in the device until acknowledged, so that it is sent again.
                last_error = silent
                if attempt < self._tries - 1:
                    logger.warning("%s; asking again", silent)
                continue
            if attempt:
                # This may have been the late answer to the first try; another may follow.
                self._link.settle()
            return answer
        self._link.close()
        damaged = f"; {last_error}" if isinstance(last_error, AnswerDamaged) else ""
        raise DeviceLost(
            f"the device at {self._link.where} has not answered for {self._wire.timeout:g} s"
            f"{damaged}"
        )

    def _next_request(self) -> bytes:
        """Return the request for a block, which writes the last number and a new heartbeat."""
        self._heartbeat = (self._heartbeat + 1) & 0xFFFF
        return self._block_request + _ACKNOWLEDGEMENT.pack(
            self._decoder.acknowledge, self._heartbeat
        )

    def _status(self) -> bytes:
        first, end = reg.STATUS_SPAN
        return self._link.read(first, end - first)

    def _command(self, register: reg.Register, value: int) -> None:
        self._control(register.address, [value], register.name)

    def _control(self, address: int, words: list[int], label: str) -> None:
        try:
            self._link.write(address, words)
        except DeviceRefused as refused:
            raise self._with_reason(refused, label) from refused

    def _with_reason(self, refused: DeviceRefused, label: str) -> DeviceError:
        """Return the refusal's error with the reason that the device's registers state."""
        status = self._status()
        reason = number_in(status, reg.STATUS_REFUSAL)
        joint = number_in(status, reg.STATUS_REFUSAL_JOINT)
        if reason not in Refusal.__members__.values():
            return DeviceRefused(f"{refused} (reason {reason}): {label}")
        if reason == Refusal.NOT_IN_CONTROL:
            return DeviceBusy(f"another client has control of the device at {self._link.where}")
        trip = self.trip_cause() if reason == Refusal.TRIPPED else None
        text = refusal_text(Refusal(reason), trip)
        at = f" (joint {joint})" if joint else ""
        return DeviceRefused(f"device at {self._link.where} refused {label}{at}: {text}")

    def _identify(self) -> DeviceInfo:
        first, end = reg.IDENTITY_SPAN
        try:
            data = self._link.read(first, end - first)
        except DeviceRefused as refused:
            raise DeviceError(f"{refused}: it is no bench of this protocol") from refused
        return check_identity(data, self._rig, self._link.where)


def _u32(value: int) -> list[int]:
    return [value >> 16, value & 0xFFFF]
