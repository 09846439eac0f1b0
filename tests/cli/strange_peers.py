"""What may stand at the other end of a wire by mistake: other programs, other settings."""

from __future__ import annotations

import random
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from hil_sim.device.pty_line import PtyLine


@contextmanager
def web_server() -> Iterator[int]:
    """An HTTP server on a free port, which it gives."""
    with _serving(ThreadingHTTPServer(("127.0.0.1", 0), _Quiet)) as port:
        yield port


@contextmanager
def talking_server(greeting: bytes) -> Iterator[int]:
    """A TCP server that says something of its own first, as a mail or SSH server does."""

    class Greet(socketserver.BaseRequestHandler):
        def handle(self) -> None:
            self.request.sendall(greeting)
            while self.request.recv(4096):
                pass

    server = socketserver.ThreadingTCPServer(("127.0.0.1", 0), Greet)
    server.daemon_threads = True
    with _serving(server) as port:
        yield port


@contextmanager
def other_baud_rate(seed: int = 1) -> Iterator[str]:
    """A port whose far end answers each request with what another baud rate makes of an answer.

    Bits read at another rate are bytes without relation to those that were sent.
    """
    rng = random.Random(seed)
    with _line(lambda data: rng.randbytes(3 * len(data))) as name:
        yield name


@contextmanager
def _line(answer: Callable[[bytes], bytes]) -> Iterator[str]:
    line, ended = PtyLine(), threading.Event()

    def serve() -> None:
        while not ended.is_set():
            if data := line.receive(0.02):
                line.send(answer(data))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    try:
        yield line.name
    finally:
        ended.set()
        thread.join(5)
        line.close()


@contextmanager
def _serving(server: Any) -> Iterator[int]:
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
    thread.start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()
        thread.join(5)


class _Quiet(BaseHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Say nothing on the test's terminal."""
