"""A faulty link over TCP: any number of connections, each forwarded to the device."""

from __future__ import annotations

import math
import re
import select
import socket
import time
from contextlib import suppress
from dataclasses import dataclass, field
from typing import ClassVar, Final
from urllib.parse import urlsplit

from hil_sim.device.lifetime import EndpointError
from hil_sim.faults.wire import Carrier, End
from hil_sim.link.link import FaultyLink
from hil_sim.link.way import Way

_CHUNK: Final = 65_536
# In modbus-tcp://HOST:PORT, can://socketcand/HOST:PORT/can0.
_ADDRESS: Final = re.compile(r"[^/]+:\d+")
_SEND_SECONDS: Final = 1.0  # longest wait for an end that does not read, before its link ends


@dataclass(eq=False)
class _Side:
    """One end of a connection: its socket, its outgoing and its incoming bytes."""

    end: socket.socket
    sends: Way
    receives: Way
    other: _Side = field(init=False)
    finished: bool = False  # it has closed its sending direction


class TcpLink(FaultyLink):
    """Listens on loopback and connects to the device at `target` for each host."""

    carrier: ClassVar[Carrier] = Carrier.TCP

    def _open(self, target: str, port: int) -> None:
        match = _ADDRESS.search(target)
        url = urlsplit(f"//{match.group()}" if match else "")
        self._target = (str(url.hostname), int(url.port or 0))
        try:
            self._listener = socket.create_server(("127.0.0.1", port))
        except OSError as error:
            raise EndpointError(
                f"cannot listen on 127.0.0.1:{port}: {error.strerror}; end what uses the port, "
                "or choose another one (0: any free one)"
            ) from error
        address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        self.endpoint = _ADDRESS.sub(address, target, count=1)
        self._sides: dict[socket.socket, _Side] = {}

    def _step(self) -> None:
        ways = [side.sends for side in self._sides.values()]
        reading = [
            end for end, side in self._sides.items() if not side.finished and not side.sends.full
        ]
        timeout = self._longest_wait(ways, time.monotonic())
        ready, _, _ = select.select([self._listener, *reading], [], [], timeout)
        for end in ready:
            if end is self._listener:
                self._accept()
            elif end in self._sides:
                self._receive(self._sides[end])
        for side in list(self._sides.values()):
            self._send(side)

    def _accept(self) -> None:
        host, _ = self._listener.accept()
        try:
            device = socket.create_connection(self._target)
        except OSError:
            host.close()
            return
        to_device, to_host = self._ways()
        sides = _Side(host, to_device, to_host), _Side(device, to_host, to_device)
        sides[0].other, sides[1].other = sides[1], sides[0]
        for side in sides:
            side.end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            side.end.settimeout(_SEND_SECONDS)
            self._sides[side.end] = side

    def _receive(self, side: _Side) -> None:
        try:
            data = side.end.recv(_CHUNK)
        except OSError:
            self._forget(side)
            return
        now = time.monotonic()
        if not data:
            side.finished = True
        elif side.sends.take(data, now, self.seconds()):
            side.receives.other_way(now)

    def _send(self, side: _Side) -> None:
        """Forward the bytes of `side` that are due."""
        if side.end not in self._sides:
            return
        sink = side.other.end
        try:
            for piece in side.sends.due(time.monotonic()):
                sink.sendall(piece.data)
                if piece.end is End.WAY:
                    sink.shutdown(socket.SHUT_WR)
                elif piece.end is End.LINK:
                    self._forget(side)
                    return
        except OSError:
            self._forget(side)
            return
        # The end of one side ends the connection; a half-closed one is caused by a fault.
        if side.finished and side.sends.next_time() == math.inf:
            self._forget(side)

    def _forget(self, side: _Side) -> None:
        for end in (side, side.other):
            self._sides.pop(end.end, None)
            with suppress(OSError):
                end.end.shutdown(socket.SHUT_RDWR)
            end.end.close()

    def _hang_up(self) -> None:
        for side in list(self._sides.values()):
            self._forget(side)

    def _end(self) -> None:
        self._listener.close()
