"""One Modbus TCP connection as requests that return bytes or raise DeviceLost / DeviceError."""

from __future__ import annotations

import logging
import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, ClassVar

from pymodbus.client import ModbusSerialClient, ModbusTcpClient
from pymodbus.exceptions import ConnectionException, ModbusException, ModbusIOException
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadWriteMultipleRegistersRequest,
    ReadWriteMultipleRegistersResponse,
)

from drivers.base import DeviceError, DeviceLost
from drivers.bench_protocol import DeviceRefused, DeviceSilent

logger = logging.getLogger(__name__)

_MBAP = struct.Struct(">HHH")  # transaction, protocol (0), length of what follows


class RawAnswer:
    """Mixin: an answer kept as the bytes of its registers, not as a list of integers."""

    payload = b""

    def decode(self, data: bytes) -> None:
        """Keep the registers' bytes; raises ModbusIOException if their count is not as stated."""
        if len(data) < 1 or data[0] != len(data) - 1:
            raise ModbusIOException(f"{len(data) - 1} bytes follow a byte count of {data[0]}")
        self.payload = data[1:]

    def __str__(self) -> str:
        return type(self).__name__


class _Read(RawAnswer, ReadHoldingRegistersResponse):
    pass


class _ReadWrite(RawAnswer, ReadWriteMultipleRegistersResponse):
    pass


def answer_classes() -> tuple[type[ModbusPDU], ...]:
    """Return the answers that a connection understands beside the library's own."""
    return _Read, _ReadWrite


class ModbusConnection:
    """A connection that is opened once and, broken once, stays closed until opened again.

    One request may be under way whose answer nobody waits for yet (`ask_ahead`). Whatever is asked
    before its answer was taken leaves that answer to be dropped, as a late one.
    """

    pipelines: ClassVar[bool] = True  # requests are numbered, so that two may be under way

    def __init__(self, host: str, port: int, timeout: float) -> None:
        self.where = f"{host}:{port}"
        self._host, self._port, self._timeout = host, port, timeout
        self._client: ModbusTcpClient | ModbusSerialClient | None = None
        self._received = 0
        self._answered = False  # ever since it was opened
        self._asked = b""
        self._ahead: ReadWriteMultipleRegistersRequest | None = None
        self._given_up = -1  # transaction number of a request ahead whose answer nobody wants
        self._factor = 1.0
        # What the library logs is raised here as well, in words for people.
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)

    @property
    def is_open(self) -> bool:
        """Whether a request may be sent."""
        return self._client is not None and self._client.connected

    def open(self) -> None:
        """Connect; raises DeviceLost where nothing listens, DeviceError where it may not be."""
        self.close()
        self._answered = False
        self._factor = 1.0
        client = self._new_client()
        client.set_max_no_responses(1_000_000)  # when to give up is decided by the driver
        for kind in answer_classes():
            client.register(kind)
        if not client.connect() or client.socket is None:
            raise self._not_connected()
        self._connected(client)
        self._client = client

    def _new_client(self) -> ModbusTcpClient | ModbusSerialClient:
        return ModbusTcpClient(
            self._host,
            port=self._port,
            timeout=self._timeout,
            retries=0,
            trace_packet=self._note,
        )

    def _not_connected(self) -> DeviceError:
        """Return why `open` has failed."""
        return DeviceLost(
            f"nothing answers at {self.where}; is the device (or `bramah sim`) running there?"
        )

    def _connected(self, client: Any) -> None:
        client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def settle(self) -> None:
        """Let a late answer pass before the next request; TCP's transaction numbers need none."""

    def be_patient(self, factor: float) -> None:
        """Wait `factor` times as long for every answer of the open connection."""
        self._factor = factor
        self._wait(self._timeout)

    @contextmanager
    def waiting(self, seconds: float) -> Iterator[None]:
        """Wait no longer than this for each answer meanwhile."""
        self._wait(min(seconds, self._timeout))
        try:
            yield
        finally:
            self._wait(self._timeout)

    def _wait(self, seconds: float) -> None:
        if self._client is not None:
            self._client.comm_params.timeout_connect = self._factor * seconds

    def close(self) -> None:
        """Close the connection if there is one."""
        self._ahead = None
        client, self._client = self._client, None
        if client is not None:
            client.close()  # type: ignore[no-untyped-call]

    def read(self, address: int, count: int) -> bytes:
        """Read `count` registers (function 3) as big-endian bytes."""
        return self._registers(ReadHoldingRegistersRequest(address=address, count=count), count)

    def write(self, address: int, words: list[int]) -> None:
        """Write registers from `address` on (functions 6 and 16)."""
        client = self._usable()
        try:
            if len(words) == 1:
                answer = self._checked(client.write_register(address, words[0]))
            else:
                answer = self._checked(client.write_registers(address, words))
        except (ModbusException, OSError) as error:
            raise self._failure(error) from error
        if answer.address != address or len(words) not in (answer.count, len(answer.registers)):
            raise self._mismatch(
                f"device at {self.where} confirmed another write than that of "
                f"{len(words)} registers at 0x{address:04X}"
            )

    def write_and_read(self, write_at: int, words: list[int], read_at: int, count: int) -> bytes:
        """Write, then read, in one transaction (function 23)."""
        return self._registers(_write_and_read(write_at, words, read_at, count), count)

    @property
    def asked_ahead(self) -> bool:
        """Whether `answer_ahead` has an answer to wait for."""
        return self._ahead is not None

    def ask_ahead(self, write_at: int, words: list[int], read_at: int, count: int) -> None:
        """Send what `write_and_read` sends, and leave the answer to `answer_ahead`; never raises.

        A connection that cannot send says so at the next request.
        """
        request = _write_and_read(write_at, words, read_at, count)
        request.dev_id = 1
        with suppress(ModbusException, OSError, DeviceLost):
            self._usable().execute(True, request)
            self._ahead = request

    def answer_ahead(self) -> bytes:
        """Return the registers that `ask_ahead` asked for; raises as `write_and_read`."""
        request, self._ahead = self._ahead, None
        if request is None:
            raise ValueError("nothing was asked ahead")
        client: Any = self._usable()
        try:
            answer = client.transaction.sync_get_response(request.dev_id, request.transaction_id)
            return self._payload(self._checked(answer), request.read_count)
        except (ModbusException, OSError) as error:
            raise self._failure(error) from error

    def _registers(self, request: ModbusPDU, count: int) -> bytes:
        request.dev_id = 1
        try:
            answer = self._checked(self._usable().execute(False, request))
        except (ModbusException, OSError) as error:
            raise self._failure(error) from error
        return self._payload(answer, count)

    def _payload(self, answer: ModbusPDU, count: int) -> bytes:
        payload = answer.payload if isinstance(answer, RawAnswer) else b""
        if len(payload) != 2 * count:
            raise self._mismatch(
                f"device at {self.where} answered {len(payload)} bytes, {2 * count} expected"
            )
        return payload

    def _mismatch(self, text: str) -> DeviceError:
        """Return what a whole answer to another request means; leaves nothing behind it."""
        self.close()  # what else is under way would be taken for the next answer
        return DeviceError(text)

    def _usable(self) -> ModbusTcpClient | ModbusSerialClient:
        # The library would reconnect by itself, to a device that has tripped meanwhile.
        client = self._client
        if client is None or not client.connected:
            raise DeviceLost(f"the connection to the device at {self.where} is closed")
        self._received = 0
        if self._ahead is not None:
            self._given_up, self._ahead = self._ahead.transaction_id, None
        return client

    def _checked(self, answer: ModbusPDU) -> ModbusPDU:
        self._answered = True
        if isinstance(answer, ExceptionResponse):
            raise DeviceRefused(
                f"device at {self.where} refused function {answer.function_code & 0x7F} "
                f"with Modbus exception {answer.exception_code}"
            )
        return answer

    def _failure(self, error: Exception) -> DeviceError:
        """Return what a failed request means, and close a connection that is out of step."""
        received = self._received
        if isinstance(error, ConnectionException | ConnectionError):
            self.close()
            return DeviceLost(f"the device at {self.where} closed the connection")
        if received:
            return self._no_answer(received)
        text = f"the device at {self.where} does not answer ({self._timeout:g} s)"
        return DeviceSilent(text if self._answered else f"{text}; {self._never_answered()}")

    def _never_answered(self) -> str:
        """Return what may be wrong where nothing has ever answered."""
        return (
            "something takes connections there, but speaks no Modbus so far: check `port`, which "
            "another program may have, and the unit's number"
        )

    def _no_answer(self, received: int) -> DeviceError:
        """Return what `received` bytes mean that are no answer; leaves nothing of them behind."""
        self.close()
        return DeviceError(
            f"the device at {self.where} answered {received} bytes that are no Modbus answer "
            "to the request; does another program listen on this port?"
        )

    def _note(self, sending: bool, data: bytes) -> bytes:
        if sending:
            self._asked = data
        elif self._answers_earlier_request(data):
            if _MBAP.unpack_from(data)[0] != self._given_up:
                logger.warning("a late answer from %s is dropped", self.where)
        else:
            self._received = len(data)
        return data

    def _answers_earlier_request(self, data: bytes) -> bool:
        """Return whether what came carries the transaction number of another request."""
        head = data[: _MBAP.size]
        if len(head) < _MBAP.size:
            return False
        transaction, protocol, _ = _MBAP.unpack(head)
        return bool(protocol == 0 and transaction != _MBAP.unpack_from(self._asked)[0])


def _write_and_read(
    write_at: int, words: list[int], read_at: int, count: int
) -> ReadWriteMultipleRegistersRequest:
    return ReadWriteMultipleRegistersRequest(
        read_address=read_at,
        read_count=count,
        write_address=write_at,
        write_registers=words,
    )


def unpack(form: str, data: bytes, offset: int = 0) -> int:
    """Read one integer in `struct`'s form from bytes at `offset`."""
    (value,) = struct.unpack_from(form, data, offset)
    return int(value)
