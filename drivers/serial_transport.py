"""Bytes of a serial port, the serial driver's interface to the operating system.

To use another library than pyserial, write another class with the methods of `Transport`.
"""

from __future__ import annotations

import errno
import os
import select
import time
from contextlib import suppress
from typing import Protocol

import serial

from drivers.base import DeviceBusy, DeviceError, DeviceLost
from drivers.settings import DRIVER

_CHUNK = 65_536
_ERRORS: tuple[type[Exception], ...] = (OSError,)  # pyserial's own are OSErrors
with suppress(ImportError):  # none on Windows
    import termios

    _ERRORS = (OSError, termios.error)
OPENING_ERRORS: tuple[type[Exception], ...] = (*_ERRORS, ValueError)


class Transport(Protocol):
    """A port that can be opened and closed any number of times."""

    @property
    def where(self) -> str:
        """The port's name."""

    @property
    def is_open(self) -> bool:
        """Whether bytes can be written and read."""

    def open(self, *, shared: bool = False) -> None:
        """Open the port and drop what it had received.

        Raises DeviceLost when there is no such port, DeviceError when it may not be opened or,
        unless `shared`, another program has it.
        """

    def write(self, data: bytes) -> None:
        """Send bytes; raises DeviceLost when the port is lost."""

    def read(self, timeout: float) -> bytes:
        """Return waiting bytes, at once if there are any; none after about `timeout` [s].

        Raises DeviceLost when the port is lost.
        """

    def close(self) -> None:
        """Close the port; never raises."""


def opening_error(device: str, baud: int, error: Exception) -> DeviceError:
    """Return the error of a serial port that cannot be opened, with the remedy."""
    text = str(error)
    if "exclusively lock" in text:
        return port_in_use(device)
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EPERM, errno.EACCES):
        return DeviceError(
            f"no permission to open {device}; on Linux join the group that owns it (often "
            "`dialout`) and log in again"
        )
    if number == errno.ENOENT:
        return DeviceLost(
            f"there is no port {device}; is the device plugged in (or `bramah sim` running there)?"
        )
    if f"({errno.ENOTTY}," in text or number == errno.ENOTTY:
        return DeviceError(f"{device} is no serial port; expected one such as /dev/ttyUSB0 or COM3")
    return DeviceLost(f"cannot open {device} at {baud} baud: {text}")


def _written(file: int, data: bytes) -> int:
    try:
        return os.write(file, data)
    except BlockingIOError:
        return 0


class PortInUse(DeviceBusy):
    """Another program has the port."""


def port_in_use(device: str) -> PortInUse:
    """Return the error of a port that another program has."""
    return PortInUse(
        f"the port {device} is in use by another program, which has control; end it, or wait "
        "for its end"
    )


class PySerialTransport:
    """`Transport` over pyserial: 8 data bits, 1 stop bit, no flow control."""

    def __init__(self, device: str, baud: int, parity: str = "N") -> None:
        self.where, self._baud, self._parity = device, baud, parity
        self._port: serial.Serial | None = None
        self._file: int | None = None

    @property
    def is_open(self) -> bool:
        """Whether bytes can be written and read."""
        return self._port is not None

    def open(self, *, shared: bool = False) -> None:
        """Open the port; see `Transport`."""
        self.close()
        try:
            self._port = serial.Serial(
                self.where,
                self._baud,
                parity=self._parity,
                timeout=DRIVER.serial_wait,
                write_timeout=DRIVER.serial_write,
                exclusive=None if shared else True,
            )
        except OPENING_ERRORS as error:
            raise opening_error(self.where, self._baud, error) from error
        self._file = self._port.fileno() if os.name == "posix" else None

    def write(self, data: bytes) -> None:
        """Send bytes; see `Transport`."""
        port = self._usable()
        try:
            sent = 0 if self._file is None else _written(self._file, data)
            if sent < len(data):  # pyserial waits until there is room
                port.write(data[sent:])
        except serial.SerialTimeoutException as error:
            raise DeviceLost(f"the device at {self.where} takes no more bytes") from error
        except _ERRORS as error:
            raise self._loss() from error

    def read(self, timeout: float) -> bytes:
        """Return what is waiting; see `Transport`."""
        port = self._usable()
        end = time.monotonic() + timeout
        try:
            # One wait and one read where the port is a file: pyserial needs twice as many calls.
            while self._file is not None:
                remaining = end - time.monotonic()
                wait = min(max(remaining, 0.0), DRIVER.serial_wait)
                if select.select([self._file], [], [], wait)[0]:
                    return self._read_file(port, self._file)
                if remaining <= 0.0:
                    return b""
            while True:
                if waiting := port.in_waiting:
                    return self._read_port(port, waiting)
                if time.monotonic() >= end:
                    return b""
                # pyserial waits in the system for the first byte; the rest came with it.
                if first := self._read_port(port, 1):
                    return first + self._read_port(port, port.in_waiting)
        except _ERRORS as error:
            raise self._loss() from error

    def close(self) -> None:
        """Close the port; never raises."""
        port, self._port = self._port, None
        if port is not None:
            with suppress(*_ERRORS):
                port.close()

    @staticmethod
    def _read_file(port: serial.Serial, file: int) -> bytes:
        try:
            data = os.read(file, _CHUNK)
        except BlockingIOError:  # another program that shares the port was quicker
            return b""
        if not data:
            _ = port.in_waiting  # raises OSError where the port is lost
        return data

    def _read_port(self, port: serial.Serial, size: int) -> bytes:
        try:
            return port.read(size) if size else b""
        except serial.SerialException:
            # Another program took the bytes (one that zeroes the outputs, say), or the port is
            # lost: then this raises OSError.
            _ = port.in_waiting
            return b""

    def _usable(self) -> serial.Serial:
        if self._port is None:
            raise DeviceLost(f"the port {self.where} is closed")
        return self._port

    def _loss(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"the port {self.where} has gone: device unplugged or ended")
