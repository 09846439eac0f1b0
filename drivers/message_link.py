"""One host's session over a line of messages: requests with answers, and pushed blocks.

A request is repeated with the same number until its answer comes; the device executes it once. An
answer counts only with the number and the session of the pending request, so that a late answer to
an earlier request is dropped.
"""

from __future__ import annotations

import logging
import secrets
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Protocol

from drivers.base import DeviceBusy, DeviceError
from drivers.bench_protocol import DeviceRefused, DeviceSilent
from drivers.settings import DRIVER
from rig.model.wire import registers as reg
from rig.model.wire import serial_messages as msg
from rig.model.wire.frames import FRAME_VERSION, WireFrame
from rig.model.wire.registers import Refusal
from rig.model.wire.serial_messages import ANSWER, Message

logger = logging.getLogger(__name__)

_UNKNOWN_REQUEST = "it knows no such request, or not of this size"


class RequestRefused(DeviceRefused):
    """A refusal with the device's reason; `what` names the request and the device."""

    def __init__(self, what: str, reason: Refusal) -> None:
        text = _UNKNOWN_REQUEST if reason == Refusal.NO_SUCH_REGISTER else reg.REFUSAL_TEXT[reason]
        super().__init__(f"{what}: {text}")
        self.what, self.reason = what, reason


class MessageLine(Protocol):
    """A carrier of complete messages: a serial port, a CAN bus. It can be reopened."""

    @property
    def where(self) -> str:
        """The line's name."""

    @property
    def is_open(self) -> bool:
        """Whether messages can be sent and received."""

    def open(self, *, shared: bool = False) -> None:
        """Open the line and drop earlier received data.

        Raises DeviceLost if there is none, DeviceError if it may not be opened, DeviceBusy if
        another program has it, unless `shared`.
        """

    def send(self, message: WireFrame) -> None:
        """Send a message; raises DeviceLost when the line is lost."""

    def receive(self, timeout: float) -> Sequence[WireFrame]:
        """Return waiting messages, at once if there are any; none after about `timeout` [s].

        Damaged ones are left out. Raises DeviceLost when the line is lost.
        """

    def complaint(self, received: int) -> str:
        """Return what may explain missing answers after `received` messages, or ''."""

    def close(self) -> None:
        """Close the line; never raises."""


class MessageLink:
    """A line that is opened once and, once broken, stays closed until reopened.

    `blocks` holds the messages of pushed blocks of this session, at most four windows of them; the
    oldest is dropped when a device sends more than it may.
    """

    def __init__(
        self, line: MessageLine, timeout: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._line, self.where = line, line.where
        self._timeout = self.answer_timeout = timeout  # [s] of an answer
        self._clock = clock
        self._session = 0
        self._number = 0
        self._answers: dict[int, WireFrame] = {}
        self._received = 0  # messages since the line was opened
        self.blocks: deque[WireFrame] = deque(maxlen=4 * msg.WINDOW)
        self.late = 0  # answers and blocks of earlier requests, streams and sessions

    @property
    def is_open(self) -> bool:
        """Whether a request may be sent."""
        return self._line.is_open

    def open(self, *, shared: bool = False) -> None:
        """Open the line for a new session; raises as `MessageLine.open`."""
        self._line.open(shared=shared)
        self._received = 0
        self._session = secrets.randbits(32)
        self.answer_timeout = self._timeout
        self._answers.clear()
        self.blocks.clear()

    def extend_timeout(self, factor: float) -> None:
        """Multiply the time limit of answers by `factor` until the line is reopened."""
        self.answer_timeout = factor * self._timeout

    def close(self) -> None:
        """Close the line if it is open; never raises."""
        self._line.close()

    def next_number(self) -> int:
        """Return the number that the next request will have."""
        return (self._number + 1) & 0xFFFF

    def request(self, kind: Message, payload: bytes = b"", size: int = 0, label: str = "") -> bytes:
        """Return the answer's payload, `size` bytes.

        Raises DeviceSilent without an answer in time, DeviceRefused with the device's reason,
        DeviceError for an answer of another size or version, DeviceLost when the line is lost.
        """
        self._number = self.next_number()
        self._answers.clear()
        message = WireFrame(kind, self._number, self._session, payload)
        end = self._clock() + self.answer_timeout
        while (now := self._clock()) < end:
            self._line.send(message)
            answer = self._wait_for_answer(min(end, now + self._timeout / DRIVER.tries))
            if answer is not None:
                return self._payload_of(answer, kind, size, label)
        raise DeviceSilent(self._silence_text())

    def send_unanswered(self, kind: Message) -> None:
        """Send a request once without waiting; raises DeviceLost when the line is lost."""
        self._number = self.next_number()
        self.note(kind, self._number, b"")

    def note(self, kind: Message, number: int, payload: bytes) -> None:
        """Send a message without answer; raises DeviceLost when the line is lost."""
        self._line.send(WireFrame(kind, number, self._session, payload))

    def listen(self, timeout: float) -> None:
        """Receive what is waiting, or arrives within `timeout` [s]; raises DeviceLost."""
        for frame in self._line.receive(timeout):
            self._dispatch(frame)

    def _wait_for_answer(self, end: float) -> WireFrame | None:
        while self._number not in self._answers:
            remaining = end - self._clock()
            if remaining <= 0.0:
                return None
            self.listen(remaining)
        return self._answers.pop(self._number)

    def _dispatch(self, frame: WireFrame) -> None:
        self._received += 1
        if frame.session != self._session:
            self.late += 1
        elif frame.type == Message.BLOCK:
            self.blocks.append(frame)
        elif frame.type & ANSWER and frame.number == self._number:
            self._answers[frame.number] = frame
        else:
            self.late += 1
            logger.debug("late answer to request %d dropped", frame.number)

    def _payload_of(self, answer: WireFrame, kind: Message, size: int, label: str) -> bytes:
        label = label or kind.name.lower()
        if answer.version != FRAME_VERSION:
            raise DeviceError(
                f"the device at {self.where} speaks version {answer.version} of the "
                f"message protocol, this program version {FRAME_VERSION}; update the older of "
                "the two"
            )
        if answer.type == Message.REFUSED:
            raise self._refused(answer.payload, label)
        if answer.type != kind | ANSWER or len(answer.payload) != size:
            raise DeviceError(
                f"the device at {self.where} answered {label} with a message of type "
                f"0x{answer.type:02X} and {len(answer.payload)} bytes; type "
                f"0x{kind | ANSWER:02X} and {size} bytes expected"
            )
        return answer.payload

    def _refused(self, payload: bytes, label: str) -> DeviceError:
        try:
            refusal = msg.unpack_refusal(payload)
        except struct.error:
            return DeviceError(f"the device at {self.where} refused {label} without a reason")
        at = f" (joint {refusal.joint})" if refusal.joint else ""
        what = f"device at {self.where} refused {label}{at}"
        if refusal.reason not in Refusal.__members__.values():
            return DeviceRefused(f"{what}: reason {refusal.reason}")
        if refusal.reason == Refusal.NOT_IN_CONTROL:
            return DeviceBusy(f"another client has control of the device at {self.where}")
        return RequestRefused(what, Refusal(refusal.reason))

    def complaint(self) -> str:
        """Return what may explain missing messages, or ''."""
        return self._line.complaint(self._received)

    def _silence_text(self) -> str:
        text = f"the device at {self.where} has not answered for {self.answer_timeout:g} s"
        complaint = self.complaint()
        return f"{text}; {complaint}" if complaint else text
