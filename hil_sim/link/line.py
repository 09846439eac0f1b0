"""A faulty link on a serial line: a pseudo-terminal in front of the device's own."""

from __future__ import annotations

import os
import select
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

from hil_sim.device.lifetime import EndpointError
from hil_sim.device.pty_line import PtyLine
from hil_sim.faults.wire import End, WireFault
from hil_sim.link.link import FaultyLink

_CHUNK: Final = 65_536
_UNPLUGGED_SECONDS: Final = 0.01  # between two checks for a host


class LineLink(FaultyLink):
    """A pty with a permanent name: a symbolic link in a folder, like udev's links by id.

    A host that opens it opens the device's line at `target`, ``serial:///dev/pts/3``, and closes it
    by closing. One direction that ends is silent; if both end, the host's side is unplugged.
    """

    def _open(self, target: str, port: int) -> None:
        kind, self._target = _prefix_and_device(target)
        self._folder = TemporaryDirectory(prefix="bramah-line-")
        self._name = Path(self._folder.name) / "line"
        self.endpoint = f"{kind}{self._name}"
        self._device: int | None = None
        self._unsent = b""
        self._to_device, self._to_host = self._ways()
        self._plug_in()

    def use(self, faults: Sequence[WireFault]) -> None:
        """Replace the faults from now on; an ended direction is restored."""
        super().use(faults)
        self._to_device.restore()
        self._to_host.restore()

    def _plug_in(self) -> None:
        self._line = PtyLine()
        new_link = self._name.with_suffix(".new")
        new_link.symlink_to(self._line.name)
        new_link.replace(self._name)

    def _step(self) -> None:
        line = self._line
        if line.connected and self._device is not None:
            ways = (self._to_device, self._to_host)
            reading = [line.fd, *([] if self._to_host.full else [self._device])]
            timeout = self._longest_wait(ways, time.monotonic())
            ready, _, _ = select.select(reading, [], [], timeout)
            if self._device in ready:
                self._from_device(self._device)
        data = line.receive(0.0 if line.connected else _UNPLUGGED_SECONDS)
        if data is None:
            self._close_device()
        elif data or (line.connected and self._device is None):
            self._open_device()
            now = time.monotonic()
            if self._to_device.take(data, now, self.seconds()):
                self._to_host.other_way(now)
        self._send()

    def _from_device(self, device: int) -> None:
        data = b""
        with suppress(BlockingIOError, OSError):
            data = os.read(device, _CHUNK)
        now = time.monotonic()
        if data and self._to_host.take(data, now, self.seconds()):
            self._to_device.other_way(now)
        elif not data:
            self._unplug()  # the device has ended

    def _send(self) -> None:
        now = time.monotonic()
        for piece in self._to_device.due(now):
            self._unsent += piece.data
            if piece.end is End.LINK:
                self._unplug()
                return
        for piece in self._to_host.due(now):
            self._line.send(piece.data)
            if piece.end is End.LINK:
                self._unplug()
                return
        if self._unsent and self._device is not None:
            with suppress(BlockingIOError):
                self._unsent = self._unsent[os.write(self._device, self._unsent) :]

    def _open_device(self) -> None:
        if self._device is None:
            try:
                flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
                self._device = os.open(self._target, flags)
            except OSError as error:
                raise EndpointError(f"cannot open {self._target}: {error.strerror}") from error

    def _close_device(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            os.close(device)
        self._unsent = b""
        self._to_device, self._to_host = self._ways()

    def _unplug(self) -> None:
        self._close_device()
        old = self._line
        self._plug_in()  # first, so that the name is always valid
        old.close()

    def _hang_up(self) -> None:
        if self._line.connected or self._device is not None:
            self._unplug()

    def _end(self) -> None:
        self._line.close()
        self._folder.cleanup()


def _prefix_and_device(target: str) -> tuple[str, str]:
    """Split an endpoint into what precedes the device file, ``can://slcan``, and the file."""
    kind, _, rest = target.partition("://")
    before, _, path = rest.partition("/")
    return f"{kind}://{before}", f"/{path}"
