"""The device's end of a pseudo terminal.

The other end, ``/dev/pts/N``, can be opened like a serial port; its baud rate has no effect.
"""

from __future__ import annotations

import errno
import os
import select
import time
import tty
from contextlib import suppress

from hil_sim.device.lifetime import EndpointError

_CHUNK = 65_536
_UNPLUGGED_SECONDS = 0.01  # between two checks for a host
_MOST_UNSENT = 1 << 16  # buffered for a host that does not read; then no requests are read


class PtyLine:
    """The device's end of a new pty; raises EndpointError if there are no ptys."""

    def __init__(self) -> None:
        try:
            self.fd, slave = os.openpty()
            self.name = os.ttyname(slave)
            tty.setraw(slave)
            os.close(slave)
        except (AttributeError, OSError) as error:
            raise EndpointError(f"cannot make a pseudo terminal: {error}") from error
        os.set_blocking(self.fd, False)
        self._poll = select.poll()
        self.connected = False
        self._unsent = b""

    @property
    def free(self) -> bool:
        """Whether a host listens and everything has been sent."""
        return self.connected and not self._unsent

    def receive(self, timeout: float) -> bytes | None:
        """Return the bytes that arrive within `timeout` [s]; None when the host has closed."""
        events = select.POLLOUT if self._unsent else 0
        if len(self._unsent) < _MOST_UNSENT:
            events |= select.POLLIN
        self._poll.register(self.fd, events)
        if not self.connected:
            timeout = min(timeout, _UNPLUGGED_SECONDS)
        ready = self._poll.poll(timeout * 1e3 if self.connected else 0)
        ready_events = ready[0][1] if ready else 0
        if ready_events & select.POLLIN:
            self.connected = True
            with suppress(BlockingIOError):
                return self._read()
        if ready_events & select.POLLHUP:
            was_connected, self.connected = self.connected, False
            if was_connected:
                return None
            time.sleep(timeout)
            return b""
        self.connected = True
        if ready_events & select.POLLOUT:
            self.send(b"")
        return b""

    def send(self, data: bytes) -> None:
        """Send, or buffer what cannot be sent now."""
        self._unsent += data
        try:
            if self._unsent:
                self._unsent = self._unsent[os.write(self.fd, self._unsent) :]
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno != errno.EIO:
                raise
            self._unsent = b""

    def close(self) -> None:
        """Close the terminal; a program that has it open detects this."""
        os.close(self.fd)

    def _read(self) -> bytes | None:
        try:
            return os.read(self.fd, _CHUNK)
        except OSError as error:
            if error.errno != errno.EIO:
                raise
        self.connected = False
        self._unsent = b""
        return None
