"""`bramah monitor --web`: pages for browsers on loopback, and a screen process for each page.

The server has no connection to a run: display and commands go through the page's own screen, a
process that attaches like one in a terminal. No page, script, style or font is external.

Other users of this machine can reach a loopback port too, and a foreign page in the operator's
browser can send requests to it: a request needs this machine's loopback name and the token. The
token is in the query of every address, not in a cookie: cookies are shared by all ports of a host,
so that another user's server would receive it.
"""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import signal
import socket
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import jinja2
import matplotlib as mpl
from aiohttp import WSCloseCode, WSMsgType, web
from textual_serve.server import Server

from rig.tui.web.attached_screen import AttachedScreen

log = logging.getLogger(__name__)
LOOPBACK: Final = "127.0.0.1"
NAMES: Final = frozenset({LOOPBACK, "localhost", "::1"})
MOST_SCREENS: Final = 4  # pages at a time: each is a process on the acquisition's computer
HEARTBEAT: Final = 5.0  # a page that does not answer within half of it counts as closed [s]
LARGEST: Final = 1 << 16  # message of a page [bytes]
SHUTDOWN: Final = 5.0  # longest wait for pages when the server ends [s]
FONTS: Final = ("DejaVuSansMono.ttf", "DejaVuSansMono-Bold.ttf", "DejaVuSans.ttf")
HEADERS: Final = {
    "Cache-Control": "no-store",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
PAGE_POLICY: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; font-src 'self'; "
    "img-src 'self' data:; connect-src ws://{host}; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
# A report has its own scripts and pictures: it may draw, without access to page or network.
REPORT_POLICY: Final = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data:; font-src data:"
)


class _InOneLine(logging.Filter):
    """Removes the traceback from a line of the log, unless everything is logged."""

    def filter(self, record: logging.LogRecord) -> bool:
        if not log.isEnabledFor(logging.DEBUG):
            record.exc_info = None
        return True


def refusal(
    hosts: Sequence[str], origins: Sequence[str], tokens: Sequence[str], token: str
) -> str | None:
    """Return in one line why a request is refused, None if it is accepted.

    hosts, origins, tokens: the values of its headers `Host` and `Origin` and of its query, for
    every occurrence. The port of `Host` may differ (a forwarded one); the name must be a loopback
    name, because a foreign name that resolves to loopback is a foreign page (DNS rebinding).
    """
    host = hosts[0] if len(hosts) == 1 else ""
    if host_name(host) not in NAMES:
        return f"the address names the host {host!r}, expected {LOOPBACK} or localhost"
    if any(origin != f"http://{host}" for origin in origins):
        return f"it comes from a page of {origins[0]!r}, expected http://{host}"
    sent = [text.encode(errors="surrogateescape") for text in tokens]  # any bytes may arrive
    if len(sent) != 1 or not secrets.compare_digest(sent[0], token.encode()):
        return "the address holds no valid token; open the one that `bramah monitor --web` printed"
    return None


def host_name(host: str) -> str:
    """Return the name in a `Host` header without its port, '' for an invalid header."""
    try:
        parts = urlsplit(f"//{host}")
        valid = parts.netloc == host and "@" not in host and (parts.port or 0) >= 0
    except ValueError:
        return ""
    return parts.hostname or "" if valid else ""


class PageServer(Server):
    """Serves the page and its files, and starts a screen for each open page."""

    def __init__(self, words: Sequence[str], token: str) -> None:
        super().__init__(command=words[0], host=LOOPBACK, title="bramah monitor")
        self._words, self._token = tuple(words), token
        self._pages: set[web.WebSocketResponse] = set()
        self._folder = files("rig.tui.web") / "page"
        page = (self._folder / "index.html").read_text(encoding="utf-8")
        self._template = jinja2.Template(page, autoescape=True)

    async def make_app(self) -> web.Application:
        """Return the application with its few routes, each behind the same check."""
        app = web.Application(middlewares=[self._checked])
        app.add_routes(
            [
                web.get("/", self.handle_index),
                web.get("/page.js", self.handle_script),
                web.get("/ws", self.handle_websocket),
                web.get("/fonts/{name}", self.handle_font),
                web.get("/download/{key}", self.handle_download),
                web.static("/static", self.statics_path),
            ]
        )
        app.on_response_prepare.append(self._with_headers)
        app.on_shutdown.append(self.on_shutdown)
        return app

    @web.middleware
    async def _checked(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        origins = request.headers.getall("Origin", [])
        if request.path == "/ws" and not origins:  # every browser names one
            origins = [""]
        reason = refusal(
            request.headers.getall("Host", []),
            origins,
            request.query.getall("token", []),
            self._token,
        )
        if reason is not None:
            log.info("refused a request from %s: %s", request.remote, reason)
            return web.Response(status=403, text=f"bramah: refused: {reason}\n")
        return await handler(request)

    async def _with_headers(self, request: web.Request, response: web.StreamResponse) -> None:
        report = request.path.startswith("/download/")
        policy = REPORT_POLICY if report else PAGE_POLICY.format(host=request.host)
        # A refused host is in no header.
        response.headers["Content-Security-Policy"] = (
            policy if response.status != web.HTTPForbidden.status_code else "default-src 'none'"
        )
        response.headers.update(HEADERS)

    async def handle_index(self, request: web.Request) -> web.Response:
        """Return the page, whose addresses all contain the token and lead to this server."""
        text = self._template.render(
            title=self.title,
            query=f"token={self._token}",
            # Where the browser reached it: the port may be a forwarded one. The terminal's script
            # appends "?width=…", which ends in an unused key; the size follows in a message.
            websocket=f"ws://{request.host}/ws?token={self._token}&terminal=",
        )
        return web.Response(text=text, content_type="text/html")

    async def handle_script(self, request: web.Request) -> web.Response:
        """Return the script of the page."""
        text = (self._folder / "page.js").read_text(encoding="utf-8")
        return web.Response(text=text, content_type="text/javascript")

    async def handle_font(self, request: web.Request) -> web.FileResponse:
        """Return one of the fonts with every letter of the screen, from matplotlib."""
        name = request.match_info["name"]
        if name not in FONTS:
            raise web.HTTPNotFound
        return web.FileResponse(Path(mpl.get_data_path()) / "fonts" / "ttf" / name)

    async def handle_websocket(self, request: web.Request) -> web.WebSocketResponse:
        """Start a screen for a page, and end it with the page."""
        page = web.WebSocketResponse(heartbeat=HEARTBEAT, max_msg_size=LARGEST)
        await page.prepare(request)
        if len(self._pages) >= MOST_SCREENS:
            await self._end(page, f"{MOST_SCREENS} pages are open already; close one of them.")
            return page
        screen = AttachedScreen(
            self._words,
            write_bytes=page.send_bytes,
            write_str=partial(self._send, page),
            ended=partial(self._end, page),
            downloads=self.download_manager,
        )
        self._pages.add(page)
        try:
            await screen.start(80, 24)
            await self._process_messages(page, screen)
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            log.warning("a page was closed: %s", error)
            await self._end(page, f"The page's connection failed: {error}")
        finally:
            self._pages.discard(page)
            await asyncio.shield(screen.stop())
        return page

    async def _process_messages(  # type: ignore[override]
        self, page: web.WebSocketResponse, screen: AttachedScreen
    ) -> None:
        """Pass keys, sizes and beats to the screen until the page is closed."""
        async for message in page:
            if message.type is not WSMsgType.TEXT:
                continue
            kind, *values = message.json()
            if kind == "stdin":
                await screen.send_bytes(values[0].encode())
            elif kind == "resize":
                await screen.set_terminal_size(values[0]["width"], values[0]["height"])
            elif kind == "beat":
                await screen.beat(values[0])
            elif kind == "focus":
                await screen.focus()
            elif kind == "blur":
                await screen.blur()

    async def _send(self, page: web.WebSocketResponse, text: str) -> None:
        """Send a screen's request to a page; the address of a download needs the token."""
        kind, mark = json.loads(text)
        if kind == "deliver_file_start":
            mark = f"{mark}?token={self._token}"
        await page.send_json([kind, mark])

    async def _end(self, page: web.WebSocketResponse, reason: str) -> None:
        """Show on a page why its screen has ended, and close it."""
        if not page.closed:
            await page.send_json(["ended", reason])
            await page.close()

    async def on_shutdown(self, app: web.Application) -> None:
        """End every page, and thereby every screen."""
        for page in tuple(self._pages):
            await page.close(code=WSCloseCode.GOING_AWAY)


def listen(port: int) -> socket.socket:
    """Return a socket at a port of loopback, 0 for a free one; raises OSError if it is taken."""
    return socket.create_server((LOOPBACK, port))


def serve(words: Sequence[str], listening: socket.socket, ready: Callable[[str], None]) -> int:
    """Serve screens started by `words` until a signal; return the exit code.

    `ready` is called with the address, which contains the token. SIGINT ends with 130, SIGTERM and
    a closed terminal with 0.
    """
    return asyncio.run(_serve(words, listening, ready))


async def _serve(
    words: Sequence[str], listening: socket.socket, ready: Callable[[str], None]
) -> int:
    ended: asyncio.Future[signal.Signals] = asyncio.get_running_loop().create_future()

    def on_signal(number: signal.Signals) -> None:
        if not ended.done():
            ended.set_result(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        asyncio.get_running_loop().add_signal_handler(number, on_signal, number)
    # Another program's requests must not cause tracebacks in the operator's terminal.
    logging.getLogger("aiohttp.server").addFilter(_InOneLine())
    logging.getLogger("textual-serve").setLevel(logging.CRITICAL)  # a screen states why it ended
    token = secrets.token_urlsafe(32)  # 256 random bits
    app = await PageServer(words, token).make_app()
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=SHUTDOWN)
    await runner.setup()
    try:
        await web.SockSite(runner, listening).start()
        ready(f"http://{LOOPBACK}:{listening.getsockname()[1]}/?token={token}")
        number = await ended
    finally:
        await runner.cleanup()
    return 130 if number is signal.SIGINT else 0
