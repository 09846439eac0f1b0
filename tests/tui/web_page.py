"""`bramah monitor --web` as a process, and a page of it without a browser: what it is sent."""

from __future__ import annotations

import json
import re
import signal
import subprocess
from codecs import getincrementaldecoder
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from urllib.parse import parse_qs, urlsplit

import aiohttp

from tests.cli.bench import LONG, started

ESCAPES = re.compile(r"\x1b(\[[0-9;?$]*[A-Za-z]|\([A-Z])")
BEGUN = re.compile(r"(\[[0-9;?$]*|\()?")  # of an escape, after its first character


class WebServer:
    """A server that is running: its process and the address that it printed."""

    def __init__(self, process: subprocess.Popen[str], address: str) -> None:
        self.process, self.address = process, address
        parts = urlsplit(address)
        assert parts.port is not None
        self.host, self.port = parts.netloc, parts.port
        self.token = parse_qs(parts.query)["token"][0]

    def at(self, path: str, token: str | None = None) -> str:
        """An address of this server with its token, or with another ('' for none)."""
        chosen = self.token if token is None else token
        return f"http://{self.host}{path}" + (f"?token={chosen}" if chosen else "")

    def screens(self) -> list[int]:
        """The processes that the server has started."""
        words = ["ps", "-o", "pid=,comm=", "--ppid", str(self.process.pid)]
        listed = subprocess.run(words, capture_output=True, text=True, check=False).stdout
        return [int(line.split()[0]) for line in listed.splitlines() if "ps" not in line.split()]

    def end(self, number: signal.Signals) -> tuple[int, str]:
        """Send a signal; returns the exit code and all of standard error."""
        self.process.send_signal(number)
        _, errors = self.process.communicate(timeout=LONG)
        return self.process.returncode, errors


@contextmanager
def web_server(*options: object) -> Iterator[WebServer]:
    """Start a server on a free port; killed at the end if it has not ended."""
    with started("monitor", "--web", *options) as process:
        assert process.stdout is not None
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:"), process.communicate()
        yield WebServer(process, address)


class OpenPage:
    """A page's connection: what its terminal is sent, and the keys that it sends."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self.socket = socket
        self.drawn = ""
        self._rest = ""  # the beginning of an escape whose end has not come yet
        self._decode = getincrementaldecoder("utf-8")("replace").decode
        self.messages: list[list[str]] = []

    async def read(self) -> bool:
        """Read one message; False when the server has closed the connection."""
        message = await self.socket.receive()
        if message.type is aiohttp.WSMsgType.BINARY:
            whole, escape, begun = (self._rest + self._decode(message.data)).rpartition("\x1b")
            torn = escape if BEGUN.fullmatch(begun) else ""
            self._rest = torn + begun if torn else ""
            self.drawn += ESCAPES.sub("", whole if torn else whole + escape + begun)
        elif message.type is aiohttp.WSMsgType.TEXT:
            self.messages.append(json.loads(message.data))
        else:
            return False
        return True

    async def until(self, pattern: str) -> None:
        """Read until what was drawn since the newest key matches; the test's limit ends it."""
        while not re.search(pattern, self.drawn):
            more = await self.read()
            assert more, f"closed before {pattern!r}: {self.messages} {self.drawn[-500:]}"

    async def message(self, kind: str) -> str:
        """Read until a message of this kind has come; returns its value."""
        while not any(message[0] == kind for message in self.messages):
            assert await self.read(), f"closed before {kind!r}: {self.messages}"
        return next(message[1] for message in self.messages if message[0] == kind)

    async def press(self, keys: str) -> None:
        self.drawn = ""
        await self.socket.send_json(["stdin", keys])

    async def resize(self, width: int, height: int) -> None:
        await self.socket.send_json(["resize", {"width": width, "height": height}])


@asynccontextmanager
async def page_of(client: aiohttp.ClientSession, server: WebServer) -> AsyncIterator[OpenPage]:
    """Open a page as a browser does: of the server's own origin, with its token."""
    origin = {"Origin": f"http://{server.host}"}
    async with client.ws_connect(server.at("/ws"), headers=origin) as socket:
        yield OpenPage(socket)
