"""Adapters through which programs reach the simulated bus, with clients in python-can.

`SocketcandServer` speaks socketcand's text over TCP, to any number of programs, which also receive
each other's frames, as nodes of one bus do. `SlcanLine` is an adapter with the LAWICEL text
protocol on a pseudo terminal, CAN FD by the letters of the CANable 2.0.
"""

from __future__ import annotations

import logging
import select
import socket
import time
from contextlib import suppress
from typing import Final, Protocol

from hil_sim.device.lifetime import WireEnd, cannot_listen
from hil_sim.device.pty_line import PtyLine
from rig.model.wire.can_frames import CanFrame
from rig.model.wire.can_layout import CLASSIC_BYTES, FD_SIZES

logger = logging.getLogger(__name__)

CHANNEL: Final = "can0"  # the bus's name behind socketcand
_CHUNK = 65_536
_MOST_UNSENT = 1 << 20  # [bytes] buffered for a program that does not read; further frames are lost
_MOST_PARTIAL = 256  # [bytes] of a text without an end
_CLASSIC_RATES = {
    b"S0": 10_000,
    b"S1": 20_000,
    b"S2": 50_000,
    b"S3": 100_000,
    b"S4": 125_000,
    b"S5": 250_000,
    b"S6": 500_000,
    b"S7": 800_000,
    b"S8": 1_000_000,
}


class Adapter(WireEnd[list[CanFrame]], Protocol):
    """The bench's connection to the bus."""

    @property
    def endpoint(self) -> str:
        """The endpoint for programs: ``can://...``."""

    @property
    def attended(self) -> bool:
        """Whether a program has the bus open."""

    def receive(self, timeout: float) -> list[CanFrame]:
        """Return the frames that arrive within `timeout` [s], at once if there are any."""


class _Client:
    """One program at the socketcand server."""

    def __init__(self, end: socket.socket) -> None:
        self.end = end
        self.raw = False  # after its greeting: it receives the bus
        self.unsent = b""
        self._partial = b""

    def lines(self) -> list[bytes] | None:
        """Return the texts between < and > that have arrived; None after a disconnection."""
        try:
            data = self.end.recv(_CHUNK)
        except BlockingIOError:
            return []
        except OSError:
            return None
        if not data:
            return None
        *ended, self._partial = (self._partial + data).split(b">")
        if len(self._partial) > _MOST_PARTIAL:
            self._partial = b""
        return [line.partition(b"<")[2].strip() for line in ended]

    def say(self, data: bytes) -> None:
        """Send, or buffer what cannot be sent now."""
        if len(self.unsent) < _MOST_UNSENT:
            self.unsent += data
        with suppress(BlockingIOError):
            while self.unsent:
                self.unsent = self.unsent[self.end.send(self.unsent) :]


class SocketcandServer:
    """A socketcand of one bus, `can0`; raises EndpointError where it cannot listen."""

    def __init__(self, host: str, port: int) -> None:
        try:
            self._listener = socket.create_server((host, port))
        except OSError as error:
            raise cannot_listen(host, port, error) from error
        self._listener.setblocking(False)
        host, port = self._listener.getsockname()[:2]
        self.endpoint = f"can://socketcand/{host}:{port}/{CHANNEL}"
        self._clients: list[_Client] = []

    @property
    def free(self) -> bool:
        """Whether a program listens."""
        return any(client.raw for client in self._clients)

    @property
    def attended(self) -> bool:
        """Whether a program is connected."""
        return bool(self._clients)

    def receive(self, timeout: float) -> list[CanFrame]:
        """Return the frames that programs have sent; see `Adapter`."""
        full = [client.end for client in self._clients if client.unsent]
        ends = [self._listener, *(client.end for client in self._clients)]
        ready, writable, _ = select.select(ends, full, [], timeout)
        if self._listener in ready:
            self._accept()
        frames = []
        for client in list(self._clients):
            if client.end in writable:
                self._send_to(client, b"")
            if client.end in ready:
                frames += self._received(client)
        return frames

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames to every program; see `Adapter`."""
        if frames:
            text = b"".join(map(_frame_text, frames))
            for client in list(self._clients):
                if client.raw:
                    self._send_to(client, text)

    def close(self) -> None:
        """Close the server and its connections."""
        for client in self._clients:
            client.end.close()
        self._listener.close()

    def _accept(self) -> None:
        with suppress(OSError):
            end, _ = self._listener.accept()
            end.setblocking(False)
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            client = _Client(end)
            self._clients.append(client)
            self._send_to(client, b"< hi >")

    def _received(self, client: _Client) -> list[CanFrame]:
        lines = client.lines()
        if lines is None:
            self._drop(client)
            return []
        frames = []
        for line in lines:
            frame = self._execute(client, line)
            if frame is not None:
                frames.append(frame)
                for other in list(self._clients):
                    if other.raw and other is not client:
                        self._send_to(other, _frame_text(frame))
        return frames

    def _execute(self, client: _Client, line: bytes) -> CanFrame | None:
        words = line.split()
        if words[:1] == [b"open"] and len(words) == 2:
            is_channel = words[1] == CHANNEL.encode()
            self._send_to(client, b"< ok >" if is_channel else b"< error could not open bus >")
        elif words == [b"rawmode"]:
            self._send_to(client, b"< ok >")
            client.raw = True
        elif words == [b"echo"]:
            self._send_to(client, b"< echo >")
        elif words[:1] == [b"send"] and client.raw:
            return _frame_of_words(words[1:])
        else:
            self._send_to(client, b"< error unknown command >")
        return None

    def _send_to(self, client: _Client, data: bytes) -> None:
        try:
            client.say(data)
        except OSError:
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        if client in self._clients:
            self._clients.remove(client)
            client.end.close()


class SlcanLine:
    """An slcan adapter on a new pseudo terminal, on a bus of `bitrate` [bit/s]."""

    def __init__(self, bitrate: int) -> None:
        self._line = PtyLine()
        self._bitrate = bitrate
        self.endpoint = f"can://slcan{self._line.name}"
        self._partial = b""
        self._opened = False
        self._rate = 0

    @property
    def free(self) -> bool:
        """Whether a program has the bus open and everything has been sent."""
        return self._on_bus and self._line.free

    @property
    def attended(self) -> bool:
        """Whether a program has opened the bus."""
        return self._opened

    @property
    def _on_bus(self) -> bool:
        # At another rate an adapter only receives and causes errors.
        return self._opened and self._rate == self._bitrate

    def receive(self, timeout: float) -> list[CanFrame]:
        """Return the frames that the program has sent; see `Adapter`."""
        data = self._line.receive(timeout)
        if data is None:
            self._partial, self._opened = b"", False
            return []
        *lines, self._partial = (self._partial + data).split(b"\r")
        if len(self._partial) > _MOST_PARTIAL:
            self._partial = b""
        frames = [self._execute(line) for line in lines]
        return [frame for frame in frames if frame is not None and self._on_bus]

    def send(self, frames: list[CanFrame]) -> None:
        """Send frames to the program; see `Adapter`."""
        if frames and self._on_bus:
            self._line.send(b"".join(map(_slcan_text, frames)))

    def close(self) -> None:
        """Remove the terminal."""
        self._line.close()

    def _execute(self, line: bytes) -> CanFrame | None:
        if line in (b"O", b"C"):
            self._opened = line == b"O"
        elif line in _CLASSIC_RATES:
            self._rate = _CLASSIC_RATES[line]
        elif line[:1] in b"tTdDbB" and line:
            return _frame_of_slcan(line)
        elif line[:1] not in b"YVNFL":
            self._line.send(b"\a")
        return None


def _frame_text(frame: CanFrame) -> bytes:
    identifier = f"{frame.identifier:08X}" if frame.extended else f"{frame.identifier:03X}"
    return f"< frame {identifier} {time.time():.6f} {frame.data.hex().upper()} >".encode()


def _frame_of_words(words: list[bytes]) -> CanFrame | None:
    """Return the frame of ``ID LENGTH BYTES...``, None where it is none."""
    with suppress(ValueError, IndexError):
        data = bytes(int(word, 16) for word in words[2:])
        if int(words[1], 16) == len(data) <= CLASSIC_BYTES:
            return CanFrame(int(words[0], 16), data, len(words[0]) > 3)
    return None


def _slcan_text(frame: CanFrame) -> bytes:
    letter = "b" if frame.fd else "t"
    identifier = f"{frame.identifier:03X}"
    if frame.extended:
        letter, identifier = letter.upper(), f"{frame.identifier:08X}"
    length = FD_SIZES.index(len(frame.data))
    return f"{letter}{identifier}{length:X}{frame.data.hex().upper()}\r".encode()


def _frame_of_slcan(line: bytes) -> CanFrame | None:
    """Return the frame of a line such as ``t0801A5``, None where it is none."""
    letter = line[:1]
    extended = letter.isupper()
    end = 9 if extended else 4
    with suppress(ValueError, IndexError):
        size = FD_SIZES[int(line[end : end + 1], 16)]
        data = bytes.fromhex(line[end + 1 : end + 1 + 2 * size].decode("ascii"))
        if len(data) == size and (size <= CLASSIC_BYTES or letter not in b"tT"):
            return CanFrame(int(line[1:end], 16), data, extended, letter not in b"tT")
    return None
