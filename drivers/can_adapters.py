"""Two of python-can's clients, corrected: socketcand over TCP, slcan on a serial port."""

from __future__ import annotations

import errno
import os
import select
import socket
import time
from typing import Any

import can
from can.interfaces.slcan import slcanBus
from can.interfaces.socketcand import SocketCanDaemonBus

from drivers.serial_transport import port_in_use
from drivers.settings import DRIVER

if os.name == "posix":
    import fcntl


class SocketcandBus(SocketCanDaemonBus):
    """python-can's client, corrected to open a busy bus and to report a connection's end."""

    def _expect_msg(self, msg: str) -> None:
        # The last answer of the greeting may arrive together with the first frames.
        answer = b""
        while not answer.endswith(b">") and (byte := self._end.recv(1)):
            answer += byte
        if answer.decode("ascii", "replace") != msg:
            self._end.close()
            raise can.CanInitializationError(f"expected {msg!r}, got {answer!r}")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        message, filtered = super()._recv_internal(timeout)  # type: ignore[no-untyped-call]
        waiting = message is None and bool(select.select([self._end], [], [], 0)[0])
        if waiting and not self._end.recv(1, socket.MSG_PEEK):
            raise ConnectionResetError(errno.ECONNRESET, "the other end closed it")
        return message, filtered

    @property
    def _end(self) -> socket.socket:
        end: socket.socket = getattr(self, "_SocketCanDaemonBus__socket")  # noqa: B009 - mangled
        return end


class SlcanBus(slcanBus):
    """python-can's client, corrected to read whole texts and to skip a damaged one.

    python-can's opens a port that another program has, reconfigures the adapter and takes bytes
    from that program. Here the port is locked as by pyserial; if `shared`, it is not locked, and
    the adapter keeps its configuration.
    """

    def __init__(self, channel: str, *, shared: bool, **options: Any) -> None:
        self._shared = shared
        self._lock = -1 if shared else _locked(channel.partition("@")[0])
        try:
            super().__init__(channel, **options)
        except BaseException:
            self._unlock()
            raise

    def open(self) -> None:
        """Open the channel, unless the port is shared."""
        if not self._shared:
            super().open()

    def close(self) -> None:
        """Close the channel, unless the port is shared."""
        if not self._shared:
            super().close()

    def set_bitrate(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Set the rates [bit/s], unless the port is shared."""
        if not self._shared:
            super().set_bitrate(bitrate, data_bitrate)

    def shutdown(self) -> None:
        """Close bus and port, and unlock the port."""
        try:
            super().shutdown()
        finally:
            self._unlock()

    def _unlock(self) -> None:
        lock, self._lock = self._lock, -1
        if lock >= 0:
            os.close(lock)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            return super()._recv_internal(timeout)
        except (ValueError, IndexError):  # the adapter's own line has no checksum
            return None, False

    def _read(self, timeout: float | None) -> str | None:
        deadline = None if timeout is None else time.monotonic() + timeout
        port = self.serialPortOrig
        while True:
            if (text := _first_text(self._buffer)) is not None:
                return text
            remaining = DRIVER.can_wait if deadline is None else deadline - time.monotonic()
            wait = min(max(remaining, 0.0), DRIVER.can_wait)
            if select.select([port.fileno()], [], [], wait)[0]:
                self._buffer.extend(port.read(port.in_waiting or 1))
            elif deadline is not None and remaining <= 0.0:
                return None


def _locked(device: str) -> int:
    """Lock a serial port against other programs; return the file whose closing unlocks it.

    Raises PortInUse where another program has locked it, OSError where there is no such port.
    """
    file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(file)
        raise port_in_use(device) from error
    return file


def _first_text(buffer: bytearray) -> str | None:
    """Remove the first complete text, up to its end or error mark, and return it."""
    marks = [at for mark in (b"\r", b"\a") if (at := buffer.find(mark)) >= 0]
    if not marks:
        return None
    text = bytes(buffer[: min(marks) + 1])
    del buffer[: len(text)]
    return text.decode("ascii", "replace")
