"""Modbus requests over a connection: they return bytes, or raise DeviceLost or DeviceError."""

from __future__ import annotations

import logging
import socket
import struct
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import ClassVar, NoReturn

from drivers.base import DeviceError, DeviceLost
from drivers.bench_protocol import DeviceRefused, DeviceSilent
from drivers.modbus_frames import (
    READ_HOLDING,
    REFUSED,
    payload_of,
    read_request,
    read_tcp_frame,
    tcp_frame,
    write_request,
)

logger = logging.getLogger(__name__)

_CHUNK = 4096
_SHORTEST = 1e-3  # [s] of waiting for bytes
_ASK_AGAIN = (5, 6)  # exceptions: acknowledge, server device busy


class DeviceAsksAgain(DeviceRefused):
    """The device is busy: it asks for the request to be sent again later."""


class ModbusConnection(ABC):
    """A connection that is opened once and, once broken, stays closed until reopened.

    One request may be pending without a waiting caller (`ask_ahead`). A request made before its
    answer was taken makes that answer a late one, which is dropped.
    """

    pipelines: ClassVar[bool]  # requests are numbered, so that two may be pending

    def __init__(self, where: str, unit: int, timeout: float) -> None:
        """Store the device's address `where`, its unit, and the time limit of an answer [s]."""
        self.where = where
        self._unit, self._timeout = unit, timeout
        self._factor = 1.0
        self._answered = False  # since it was opened
        self._ahead: tuple[int, bytes, int] | None = None  # number, request, registers
        self._abandoned = -1  # number of a request ahead whose answer is dropped

    @property
    @abstractmethod
    def is_open(self) -> bool:
        """Whether a request may be sent."""

    def open(self) -> None:
        """Connect; raises DeviceLost where nothing listens, DeviceError where it is not allowed."""
        self.close()
        self._answered = False
        self._factor = 1.0
        self._connect()

    @abstractmethod
    def _connect(self) -> None:
        """Open what is closed; raises as `open`."""

    def close(self) -> None:
        """Close the connection if it is open."""
        self._ahead = None
        self._disconnect()

    @abstractmethod
    def _disconnect(self) -> None:
        """Close everything that is open."""

    @abstractmethod
    def settle(self) -> None:
        """Let a late answer pass before the next request."""

    def extend_timeout(self, factor: float) -> None:
        """Multiply the time limit of answers on the open connection by `factor`."""
        self._factor = factor

    def read(self, address: int, count: int, function: int = READ_HOLDING) -> bytes:
        """Read `count` registers (function 3 or 4) as big-endian bytes."""
        request = read_request(function, address, count)
        return self._payload(request, self._exchange(request), count)

    def write(self, address: int, words: list[int]) -> None:
        """Write registers from `address` on (functions 6 and 16)."""
        request = write_request(address, words)
        if self._exchange(request) != request[:5]:
            raise self._mismatch(
                f"the device at {self.where} confirmed another write than that of "
                f"{registers_in_words(address, len(words))}"
            )

    def registers(self, request: bytes, count: int, limit: float | None = None) -> bytes:
        """Return the `count` registers for which a request (a PDU) asks, within `limit` [s]."""
        answer = self._finish_request(self._start_request(request), limit)
        return self._payload(request, answer, count)

    @property
    def asked_ahead(self) -> bool:
        """Whether `answer_ahead` has an answer to wait for."""
        return self._ahead is not None

    def ask_ahead(self, request: bytes, count: int) -> None:
        """Send the request of `registers` for `answer_ahead`; never raises.

        A failed connection is reported at the next request.
        """
        with suppress(DeviceError):
            self._ahead = self._start_request(request), request, count

    def answer_ahead(self, limit: float | None = None) -> bytes:
        """Return the registers requested by `ask_ahead`; raises as `registers`."""
        ahead, self._ahead = self._ahead, None
        if ahead is None:
            raise ValueError("nothing was asked ahead")
        number, request, count = ahead
        return self._payload(request, self._finish_request(number, limit), count)

    def _exchange(self, request: bytes) -> bytes:
        """Return the answer to a request; raises DeviceRefused for a refused one."""
        return self._finish_request(self._start_request(request), None)

    def _start_request(self, request: bytes) -> int:
        """Send a request; returns its number."""
        if self._ahead is not None:
            self._abandoned, self._ahead = self._ahead[0], None
        return self._send(request)

    def _finish_request(self, number: int, limit: float | None) -> bytes:
        """Return the answer to a request by its number."""
        timeout = self._timeout if limit is None else min(limit, self._timeout)
        answer = self._receive(number, self._factor * timeout)
        self._answered = True
        if answer[0] & REFUSED:
            refused = DeviceAsksAgain if answer[1] in _ASK_AGAIN else DeviceRefused
            raise refused(
                f"device at {self.where} refused function {answer[0] & ~REFUSED} "
                f"with Modbus exception {answer[1]}"
            )
        return answer

    @abstractmethod
    def _send(self, request: bytes) -> int:
        """Send a PDU; returns its number. Raises DeviceLost where the connection is closed."""

    @abstractmethod
    def _receive(self, number: int, timeout: float) -> bytes:
        """Return the PDU that answers request `number` within `timeout` [s].

        Raises DeviceLost where the connection is closed.
        """

    def _payload(self, request: bytes, answer: bytes, count: int) -> bytes:
        if answer[0] == request[0] and answer[1] == 2 * count == len(answer) - 2:
            return answer[2:]
        try:
            payload = payload_of(answer)
        except ValueError:
            raise self._no_answer(len(answer)) from None
        if answer[0] != request[0] or len(payload) != 2 * count:
            raise self._mismatch(
                f"the device at {self.where} answered {len(payload)} bytes to function "
                f"{answer[0]}, expected {2 * count} to function {request[0]}"
            )
        return payload

    def _mismatch(self, text: str) -> DeviceError:
        """Return the error of a complete answer to another request; clears the input."""
        self.close()  # other pending bytes would be taken as the next answer
        return DeviceError(text)

    def _no_answer(self, received: int) -> DeviceError:
        """Return the error of `received` bytes that are no Modbus answer; clears the input."""
        self.close()
        return DeviceError(
            f"the device at {self.where} answered {received} bytes that are no Modbus answer "
            "to the request; does another program listen on this port?"
        )

    def _silent(self) -> DeviceSilent:
        """Return the error of a request without an answer."""
        text = f"the device at {self.where} does not answer ({self._timeout:g} s)"
        return DeviceSilent(text if self._answered else f"{text}; {self._never_answered()}")

    @abstractmethod
    def _never_answered(self) -> str:
        """Return possible causes if the device has never answered."""


class TcpConnection(ModbusConnection):
    """A connection over TCP, whose answers have the number of their request."""

    pipelines = True

    def __init__(self, host: str, port: int, timeout: float, unit: int = 1) -> None:
        super().__init__(f"{host}:{port}", unit, timeout)
        self._address = host, port
        self._socket: socket.socket | None = None
        self._buffer = b""  # received and not yet read
        self._limit = 0.0  # [s] for which the system waits for bytes
        self._transaction = 0

    @property
    def is_open(self) -> bool:
        """Whether a request may be sent."""
        return self._socket is not None

    def settle(self) -> None:
        """Do nothing: answers with another number are dropped on arrival."""

    def _connect(self) -> None:
        try:
            self._socket = socket.create_connection(self._address, self._timeout)
        except OSError as error:
            raise DeviceLost(
                f"nothing answers at {self.where}; is the device (or `bramah sim`) running there?"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        # With Python's own timeout every call needs two system calls.
        self._socket.setblocking(True)
        self._buffer, self._limit = b"", 0.0

    def _disconnect(self) -> None:
        opened, self._socket = self._socket, None
        if opened is not None:
            opened.close()

    def _send(self, request: bytes) -> int:
        if self._socket is None:
            raise self._closed()
        self._transaction = self._transaction % 0xFFFF + 1
        frame = tcp_frame(self._transaction, self._unit, request)
        try:
            sent = self._socket.send(frame, socket.MSG_DONTWAIT)
        except OSError as error:
            self._lost(error)
        if sent < len(frame):  # no request is that long: the device has stopped reading
            self._lost(None)
        return self._transaction

    def _receive(self, number: int, timeout: float) -> bytes:
        deadline = time.monotonic() + timeout
        dropped = 0
        if not self._buffer:
            self._buffer = self._receive_bytes(timeout)
        while True:
            try:
                frame = read_tcp_frame(self._buffer)
            except ValueError:
                raise self._no_answer(len(self._buffer)) from None
            if frame is None:
                self._buffer += self._receive_bytes(deadline - time.monotonic())
                continue
            self._buffer = self._buffer[frame.used :]
            if frame.transaction == number and frame.unit == self._unit:
                return frame.pdu
            if frame.transaction == self._abandoned:
                continue
            if not dropped:
                logger.warning("a late answer from %s is dropped", self.where)
            dropped += frame.used  # bytes
            if time.monotonic() > deadline:  # answers to others arrive without a pause
                raise self._no_answer(dropped)

    def _receive_bytes(self, timeout: float) -> bytes:
        """Return the bytes that arrive within `timeout` [s]."""
        if self._socket is None:
            raise self._closed()
        try:
            if timeout != self._limit:
                # The system waits in the call that receives; zero would be for ever.
                self._limit = max(timeout, _SHORTEST)
                option = struct.pack("@ll", *divmod(round(self._limit * 1e6), 1_000_000))
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, option)
            data = self._socket.recv(_CHUNK)
        except BlockingIOError:
            raise self._no_answer(len(self._buffer)) if self._buffer else self._silent() from None
        except OSError as error:
            self._lost(error)
        if not data:
            self._lost(None)
        return data

    def _closed(self) -> DeviceLost:
        return DeviceLost(f"the connection to the device at {self.where} is closed")

    def _lost(self, error: OSError | None) -> NoReturn:
        self.close()
        raise DeviceLost(f"the device at {self.where} closed the connection") from error

    def _never_answered(self) -> str:
        return (
            "something takes connections there, but has not answered on this one: check whether "
            "the device hangs, `port`, which another program may have, and the unit's number"
        )


def registers_in_words(address: int, count: int) -> str:
    """Return the numbers of `count` registers from `address` on in words."""
    return f"register {address}" if count == 1 else f"registers {address} to {address + count - 1}"
