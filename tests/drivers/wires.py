"""Helpers of wire tests: a device in a process of its own, and a wire that misbehaves."""

from __future__ import annotations

import os
import pty
import select
import socket
import struct
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tests.forked import Forked

ROOT = Path(__file__).parents[2]


@contextmanager
def device_process(mode: str = "virtual") -> Iterator[tuple[Forked, int]]:
    """The integrator's bench as a process; gives (process, port) and ends it afterwards."""
    with device_at(mode, "modbus-tcp") as (process, endpoint):
        assert endpoint.startswith("modbus-tcp://127.0.0.1:"), endpoint
        yield process, int(endpoint.rsplit(":", 1)[1])


@contextmanager
def device_at(mode: str, wire: str) -> Iterator[tuple[Forked, str]]:
    """The integrator's bench as a process on a wire; gives (process, endpoint)."""
    words = (mode, os.getpid(), wire)
    with Forked(words, ROOT, "tests.hil_sim.integrator", told=True) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.terminate()
            process.wait(10)


class BadWire:
    """A TCP proxy on loopback whose way back does what `fault` says, from then on.

    "pass" hands answers on; "lose one" swallows the next one; "silent" swallows all; "garbage"
    replaces them; "close" ends the connection; "short" keeps the tail of each; "fewer" makes each
    a well-formed answer of fewer registers; "miscounted" corrupts the byte count.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        self.fault = "pass"
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def close(self) -> None:
        """End everything."""
        for end in (self._listener, *self._sockets):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()
        for thread in self._threads:
            thread.join(5)

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                host, _ = self._listener.accept()
                device = socket.create_connection(("127.0.0.1", self._target))
                self.connections += 1
                self._sockets += [host, device]
                for pump, source, sink in (
                    (self._forth, host, device),
                    (self._back, device, host),
                ):
                    thread = threading.Thread(target=pump, args=(source, sink), daemon=True)
                    self._threads.append(thread)
                    thread.start()

    @staticmethod
    def _forth(source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(4096):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_RDWR)

    def _back(self, source: socket.socket, sink: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(4096):
                sent = self._spoiled(data)
                if sent is None:
                    break
                sink.sendall(sent)
            sink.shutdown(socket.SHUT_RDWR)

    def _spoiled(self, data: bytes) -> bytes | None:
        fault = self.fault
        if fault == "lose one":
            self.fault = "pass"
            return b""
        return {
            "pass": data,
            "silent": b"",
            "garbage": b"HTTP/1.1 400 Bad Request\r\n\r\n",
            "close": None,
            "short": data[: len(data) // 2],
            "fewer": data[:4] + struct.pack(">HBBB", 7, data[6], data[7], 4) + data[9:13],
            "miscounted": data[:8] + bytes([data[8] ^ 2]) + data[9:],
        }[fault]


class BadLine:
    """A pseudo-terminal in front of another one, whose way back does what `fault` says.

    "pass" hands answers on; "lose one" swallows the next one; "silent" swallows all; "late" keeps
    the next answer until the host asks again, then sends it before the right one; "flip" turns one
    bit of the next answer; "split" sends the next answer in two pieces; "twice" sends it twice.
    """

    def __init__(self, target: str) -> None:
        self.fault = "pass"
        self._device = os.open(target, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._device)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._held = b""
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._pump, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End everything."""
        self._ended.set()
        self._thread.join(5)
        for end in (self._device, self._master, self._slave):
            os.close(end)

    def _pump(self) -> None:
        while not self._ended.is_set():
            ready, _, _ = select.select([self._master, self._device], [], [], 0.02)
            if self._master in ready:
                if self._held:
                    os.write(self._master, self._held)
                    self._held = b""
                os.write(self._device, os.read(self._master, 4096))
            if self._device in ready:
                self._back(self._whole_answer())

    def _whole_answer(self) -> bytes:
        data = os.read(self._device, 4096)
        while select.select([self._device], [], [], 0.005)[0]:
            data += os.read(self._device, 4096)
        return data

    def _back(self, data: bytes) -> None:
        fault, self.fault = self.fault, self.fault if self.fault in ("pass", "silent") else "pass"
        if fault in ("lose one", "silent"):
            return
        if fault == "late":
            self._held = data
            return
        if fault == "flip":
            data = data[:7] + bytes([data[7] ^ 4]) + data[8:]
        if fault == "split":
            os.write(self._master, data[:9])
            data = data[9:]
        os.write(self._master, data * (2 if fault == "twice" else 1))
