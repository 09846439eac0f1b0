"""Modbus requests of the device, decoded as bytes: one numpy view instead of 125 integers."""

from __future__ import annotations

import struct

from pymodbus.constants import ExcCodes
from pymodbus.pdu import ExceptionResponse, ModbusPDU

from hil_sim.device.laws import Refused
from hil_sim.device.register_map import DeviceRegisters
from rig.model.wire.registers import MAX_READ, MAX_WRITE, Refusal

_EXCEPTIONS = {
    Refusal.NOT_IN_CONTROL: ExcCodes.DEVICE_BUSY,
    Refusal.TRIPPED: ExcCodes.DEVICE_FAILURE,
    Refusal.NO_SUCH_REGISTER: ExcCodes.ILLEGAL_ADDRESS,
    Refusal.FAULT: ExcCodes.DEVICE_FAILURE,
}
_MAX_WRITE_BESIDE_READ = 121


class ResponsePdu(ModbusPDU):
    """An answer made of bytes."""

    def __init__(self, function_code: int, data: bytes) -> None:
        super().__init__()
        self.function_code = function_code
        self._data = data

    def encode(self) -> bytes:
        """Return the bytes after the function code."""
        return self._data


class Request(ModbusPDU):
    """A request kept as bytes until its connection answers it.

    `client` identifies the connection, `map` is the register map of the device.
    """

    map: DeviceRegisters
    client: object
    data = b""

    def decode(self, data: bytes) -> None:
        """Store the bytes after the function code."""
        self.data = data

    def __str__(self) -> str:
        return type(self).__name__  # the library formats every request even without a log

    def answer(self) -> bytes:
        """Execute the request; return the bytes after the answer's function code."""
        raise NotImplementedError

    def response_to(self, registers: DeviceRegisters, client: object) -> ModbusPDU:
        """Return the answer to a client, or Modbus's exception response."""
        self.map, self.client = registers, client
        try:
            return ResponsePdu(self.function_code, self.answer())
        except Refused as refused:
            code = _EXCEPTIONS.get(refused.reason, ExcCodes.ILLEGAL_VALUE)
        except (struct.error, ValueError):
            code = ExcCodes.ILLEGAL_VALUE
        return ExceptionResponse(self.function_code, code)

    def _read(self, address: int, count: int) -> bytes:
        if not 1 <= count <= MAX_READ:
            raise ValueError("register count")
        data = self.map.read(self.client, address, count)
        return bytes([len(data)]) + data

    def _write(self, address: int, count: int, data: bytes, largest: int) -> None:
        if not 1 <= count <= largest or len(data) != 2 * count:
            raise ValueError("register count")
        self.map.write(self.client, address, data)


class ReadHolding(Request):
    """Function 3; 4 reads the same map."""

    function_code = 3

    def answer(self) -> bytes:
        """Read one span of registers."""
        address, count = struct.unpack(">HH", self.data)
        return self._read(address, count)


class ReadInput(ReadHolding):
    """Function 4."""

    function_code = 4


class WriteOne(Request):
    """Function 6."""

    function_code = 6

    def answer(self) -> bytes:
        """Write one register, echo the request."""
        (address,) = struct.unpack_from(">H", self.data)
        self._write(address, 1, self.data[2:], MAX_WRITE)
        return self.data


class WriteMany(Request):
    """Function 16."""

    function_code = 16

    def answer(self) -> bytes:
        """Write one span; echo its address and length."""
        address, count, size = struct.unpack_from(">HHB", self.data)
        if size != 2 * count:
            raise ValueError("byte count")
        self._write(address, count, self.data[5:], MAX_WRITE)
        return self.data[:4]


class ReadWrite(Request):
    """Function 23: the write is carried out before the read."""

    function_code = 23

    def answer(self) -> bytes:
        """Write one span, then read one."""
        read_at, read_count, write_at, count, size = struct.unpack_from(">HHHHB", self.data)
        if size != 2 * count:
            raise ValueError("byte count")
        self._write(write_at, count, self.data[9:], _MAX_WRITE_BESIDE_READ)
        return self._read(read_at, read_count)


REQUESTS: list[type[ModbusPDU]] = [ReadHolding, ReadInput, WriteOne, WriteMany, ReadWrite]
