"""A wire-tap: a TCP proxy between host and device that keeps every byte of both ways."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from urllib.parse import urlsplit


class Tap:
    """What crossed the wire so far, host to device and device to host."""

    def __init__(self) -> None:
        self.sent, self.received = bytearray(), bytearray()

    @property
    def everything(self) -> bytes:
        """Both ways, one after the other."""
        return bytes(self.sent) + b"|" + bytes(self.received)


@contextmanager
def tapped(endpoint: str) -> Iterator[tuple[str, Tap]]:
    """Stand between a host and the device at `endpoint`: (endpoint to use instead, tap)."""
    parts, tap = urlsplit(endpoint), Tap()
    listener = socket.create_server(("127.0.0.1", 0))
    threads: list[threading.Thread] = []

    def pump(source: socket.socket, sink: socket.socket, kept: bytearray) -> None:
        with suppress(OSError):  # one side went away: so does the other
            while data := source.recv(65536):
                kept.extend(data)
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def accept() -> None:
        while True:
            try:
                host, _ = listener.accept()
            except OSError:
                return
            device = socket.create_connection((str(parts.hostname), int(parts.port or 0)))
            for end in (host, device):
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with host, device:
                both = [
                    threading.Thread(target=pump, args=(host, device, tap.sent)),
                    threading.Thread(target=pump, args=(device, host, tap.received)),
                ]
                for thread in both:
                    thread.start()
                for thread in both:
                    thread.join()

    threads.append(threading.Thread(target=accept))
    threads[0].start()
    try:
        yield f"{parts.scheme}://127.0.0.1:{listener.getsockname()[1]}", tap
    finally:
        # Closing alone does not wake a thread that waits in accept.
        listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        threads[0].join(10.0)
