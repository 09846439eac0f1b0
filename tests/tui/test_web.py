"""The screen in a browser, as its server and a client of HTTP see it; the browser comes later."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from threading import Thread

import aiohttp
import pytest
from hypothesis import given
from hypothesis import strategies as st
from textual.app import App

from rig.runs.listing.summary import summarise
from rig.tui.web.attached_screen import CLOSED
from rig.tui.web.page_driver import PageDriver
from rig.tui.web.server import NAMES, host_name, refusal
from tests.cli.bench import LONG, SHORT, bramah, simulated, started, wait_for
from tests.forked import Forked
from tests.tui.test_attached import sockets, start
from tests.tui.web_page import OpenPage, WebServer, page_of, web_server

__all__ = ["sockets", "start"]  # fixtures: a folder of sockets, and a run that publishes there

PATIENCE = 60.0  # of a test whose processes ought to have acted long ago [s]
ATTACHED = r"cap +\d\.\d\d MPa"  # the waiting page names a rig, but shows no pressure
PATHS = (
    "/", "/ws", "/page.js", "/static/js/textual.js", "/static/css/xterm.css",
    "/fonts/DejaVuSans.ttf", "/download/key", "/nowhere",
)  # fmt: skip
# An address anywhere but on loopback, as a browser would load it.
OUTSIDE = re.compile(r"""(?:https?:|wss?:|["'(=]\s*)//(?!127\.0\.0\.1[:/])[\w.-]+\.\w+""")


@pytest.fixture
async def client() -> AsyncIterator[aiohttp.ClientSession]:
    async with aiohttp.ClientSession() as session:
        yield session


@pytest.fixture(scope="module")
def lasting_server() -> Iterator[WebServer]:
    """A server for the tests that leave it as it was; no run is to be seen from it."""
    with (
        tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("XDG_RUNTIME_DIR", folder)
        with web_server() as served:
            yield served


@pytest.fixture
def server(sockets: Path) -> Iterator[WebServer]:
    with web_server() as served:
        yield served


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    # Nobody may have waited for it yet.
    words = ["ps", "-o", "stat=", "-p", str(pid)]
    state = subprocess.run(words, capture_output=True, text=True, check=False).stdout
    return not state.strip() or state.startswith("Z")


async def until(so: Callable[[], bool]) -> None:
    """Wait until something is so; the test's own time limit ends a wait in vain."""
    while not so():
        await asyncio.sleep(0.02)


@given(st.text(max_size=30) | st.sampled_from(sorted(NAMES)).map(lambda name: f"{name}:8000"))
def test_only_loopback_names_are_hosts_of_the_page(host: str) -> None:
    why = refusal([host], [], ["right"], "right")
    plain = host.rpartition(":")[0] if re.search(r":\d*$", host) and "]" not in host else host
    name = re.sub(r"^\[(.*)\](:\d*)?$", r"\1", plain).lower()
    assert (why is None) == (host_name(host) in NAMES)
    assert why is not None or name in NAMES


@pytest.mark.parametrize(
    ("hosts", "origins", "tokens", "why"),
    [
        (["127.0.0.1:8000"], ["http://127.0.0.1:8000"], ["right"], None),
        (["localhost:9"], [], ["right"], None),  # a forwarded port
        (["[::1]:8000"], [], ["right"], None),
        (["127.0.0.1:8000"], [], [], "token"),
        (["127.0.0.1:8000"], [], ["righ"], "token"),
        (["127.0.0.1:8000"], [], ["ünicode"], "token"),
        (["127.0.0.1:8000"], [], ["right\udcff"], "token"),
        (["127.0.0.1:8000"], [], ["wrong", "right"], "token"),
        (["bench.example:8000"], [], ["right"], "host"),
        (["127.0.0.1.example"], [], ["right"], "host"),
        (["example@127.0.0.1"], [], ["right"], "host"),
        (["[::1"], [], ["right"], "host"),
        (["127.0.0.1:8000; script-src *"], [], ["right"], "host"),
        ([], [], ["right"], "host"),
        (["127.0.0.1", "127.0.0.1"], [], ["right"], "host"),
        (["127.0.0.1:8000"], ["http://127.0.0.1:9000"], ["right"], "page of"),
        (["127.0.0.1:8000"], ["https://bench.example"], ["right"], "page of"),
        (["127.0.0.1:8000"], ["null"], ["right"], "page of"),
    ],
)
def test_a_refusal_says_why(
    hosts: list[str], origins: list[str], tokens: list[str], why: str | None
) -> None:
    said = refusal(hosts, origins, tokens, "right")
    assert said is None if why is None else why in str(said)


@pytest.mark.timeout(PATIENCE)
async def test_without_the_token_or_from_elsewhere_nothing_is_served(
    lasting_server: WebServer, client: aiohttp.ClientSession
) -> None:
    for path in PATHS:
        for token in ("", "wrong", lasting_server.token[:-1]):
            async with client.get(lasting_server.at(path, token)) as answer:
                assert answer.status == 403, path
                assert lasting_server.token not in await answer.text()
        for headers in (
            {"Host": f"bench.example:{lasting_server.port}"},
            {"Origin": "http://a.example"},
        ):
            async with client.get(lasting_server.at(path), headers=headers) as answer:
                assert answer.status == 403, (path, headers)
    for origin in ({}, {"Origin": "http://127.0.0.1:1"}, {"Origin": "http://bench.example"}):
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await client.ws_connect(lasting_server.at("/ws"), headers=origin)
        assert refused.value.status == 403
    assert not lasting_server.screens()


@pytest.mark.timeout(PATIENCE)
async def test_page_and_files_name_no_address_elsewhere(
    lasting_server: WebServer, client: aiohttp.ClientSession
) -> None:
    async with client.get(lasting_server.at("/")) as answer:
        assert answer.status == 200
        policy = answer.headers["Content-Security-Policy"]
        page = await answer.text()
    assert "default-src 'none'" in policy
    assert f"connect-src ws://{lasting_server.host};" in policy
    inside = re.findall(r'(?:src|href|data-terminal)="([^"]+)"|url\("([^"]+)"\)', page)
    paths = [one or other for one, other in inside if not (one or other).startswith("data:")]
    assert len(paths) == 7
    assert not OUTSIDE.search(page)
    for path in paths:
        async with client.get(f"http://{lasting_server.host}/{path}") as answer:
            assert answer.status == 200, path
            if ".ttf" not in path:
                text = re.sub(r"/\*.*?\*/", "", await answer.text(), flags=re.DOTALL)
                assert not OUTSIDE.search(text), path
    for foreign in ('src="//cdn.example/a.js"', "url(https://fonts.example/b)"):
        assert OUTSIDE.search(foreign)
    # Behind a forwarded port the page leads back to where the browser reached it.
    async with client.get(lasting_server.at("/"), headers={"Host": "localhost:9"}) as answer:
        assert "ws://localhost:9/ws?" in await answer.text()


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no list of sockets in /proc")
@pytest.mark.timeout(PATIENCE)
def test_it_listens_on_loopback_alone(lasting_server: WebServer) -> None:
    lines = [*Path("/proc/net/tcp").read_text().splitlines()[1:]]
    if Path("/proc/net/tcp6").exists():
        lines += Path("/proc/net/tcp6").read_text().splitlines()[1:]
    at = [line.split()[1] for line in lines if line.split()[3] == "0A"]
    port = f"{lasting_server.port:04X}"
    assert [address for address in at if address.endswith(f":{port}")] == [f"0100007F:{port}"]


@pytest.mark.timeout(2 * PATIENCE)
async def test_pages_come_and_go_and_every_screen_ends_with_its_page(
    server: WebServer, client: aiohttp.ClientSession, start: Callable[..., Forked]
) -> None:
    run = start()
    async with page_of(client, server) as page, page_of(client, server) as other:
        await page.resize(120, 40)
        await page.until(ATTACHED)
        await other.until(ATTACHED)
        assert len(server.screens()) == 2
        await page.socket.send_json(["beat", "17.5"])
        assert await page.message("beat") == "17.5"
        await page.press("q")
        assert await page.message("ended") == CLOSED
        assert not await page.read()
        await until(lambda: len(server.screens()) == 1)
        os.kill(server.screens()[0], signal.SIGKILL)
        assert "with code -9" in await other.message("ended")
    async with page_of(client, server) as page:
        await page.until(ATTACHED)
    await until(lambda: not server.screens())
    assert run.poll() is None
    async with page_of(client, server) as page:
        await page.until(ATTACHED)
        await page.press(" ")
        await page.until("OUTPUTS ZEROED")
        assert run.wait(PATIENCE) == 0
        screens = server.screens()
        code, errors = server.end(signal.SIGINT)
        assert code == 130
        assert "Traceback" not in errors
        await until(lambda: all(map(gone, screens)))


@pytest.mark.parametrize(
    "nonsense",
    [
        ("{", '["resize", {"width": 1000000, "height": 2}]'),
        pytest.param(("[]", '["stdin", 7]'), marks=pytest.mark.slow),
    ],
)
@pytest.mark.timeout(PATIENCE)
async def test_nonsense_from_a_page_ends_that_page_alone(
    server: WebServer, client: aiohttp.ClientSession, nonsense: tuple[str, ...]
) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        raw.sendall(b"\x00\xff nonsense\r\n\r\n")
        assert b"400" in raw.recv(1 << 12)
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        raw.sendall(b"GET /?token=\xff\xfe HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert b" 40" in raw.recv(1 << 12).splitlines()[0]
    for text in nonsense:
        async with page_of(client, server) as page:
            await page.socket.send_str(text)
            await page.message("ended")
    async with page_of(client, server) as page:
        await page.until("No protocol is running")
    code, errors = server.end(signal.SIGTERM)
    assert (code, "Traceback" in errors) == (0, False), errors


@pytest.mark.timeout(PATIENCE)
async def test_the_fifth_page_is_refused_in_a_sentence(
    lasting_server: WebServer, client: aiohttp.ClientSession
) -> None:
    async with AsyncExitStack() as opened:
        for _ in range(4):
            await opened.enter_async_context(page_of(client, lasting_server))
        await until(lambda: len(lasting_server.screens()) == 4)
        fifth = await opened.enter_async_context(page_of(client, lasting_server))
        assert "close one" in await fifth.message("ended")


@pytest.mark.timeout(2 * PATIENCE)
async def test_a_killed_server_takes_its_screen_along_and_the_run_goes_on(
    server: WebServer, client: aiohttp.ClientSession, start: Callable[..., Forked]
) -> None:
    run = start()
    async with page_of(client, server) as page:
        await page.until(ATTACHED)
        (screen,) = server.screens()
        assert server.end(signal.SIGKILL)[0] == -signal.SIGKILL
        await until(lambda: gone(screen))
    assert run.poll() is None


@pytest.mark.slow
@pytest.mark.timeout(2 * LONG)
async def test_a_killed_server_leaves_the_run_of_a_bench_complete(
    sockets: Path, tmp_path: Path, client: aiohttp.ClientSession
) -> None:
    protocol, out = tmp_path / "short.yaml", tmp_path / "run"
    protocol.write_text(
        SHORT.replace("warm_up: 2", "warm_up: 1").replace("repeats: 2", "repeats: 1")
    )
    words = ["run", protocol, "--rig", "shinshu-2dof", "--out", out, "--unattended"]
    with (
        simulated("--real-time") as (endpoint, _),
        web_server("--runs", tmp_path) as server,
        started(*words, "--endpoint", endpoint) as run,
    ):
        async with page_of(client, server) as page:
            await page.resize(120, 40)
            await page.until(r"step1 +warm-up")
            await page.until(r"cap +\d\.\d\d MPa")
            await page.until(r"rod +\d\.\d\d MPa")
            (screen,) = server.screens()
            assert server.end(signal.SIGKILL)[0] == -signal.SIGKILL
            assert run.poll() is None
            await until(lambda: gone(screen))
        wait_for("done", run)
        assert run.wait(LONG) == 0
    summary = summarise(out)
    assert (summary.state, summary.records, summary.lost_samples) == ("done", 1, 0)


@pytest.mark.parametrize("killed", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.timeout(2 * PATIENCE)
async def test_a_screen_that_hangs_outlives_neither_its_page_nor_a_killed_server(
    client: aiohttp.ClientSession, *, killed: bool
) -> None:
    hangs = (
        "import time; from textual.app import App\n"
        "class Hanging(App):\n"
        "    def on_key(self): time.sleep(3600)\n"
        "Hanging().run()"
    )
    serving = (
        "import sys; from functools import partial; from rig.tui.web.server import listen, serve\n"
        "serve([sys.executable, '-c', sys.argv[1]], listen(0), partial(print, flush=True))"
    )
    words = [sys.executable, "-c", serving, hangs]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        server = WebServer(process, process.stdout.readline().strip())
        hanging: list[int] = []

        async def hang(page: OpenPage) -> int:
            await page.message("beat")
            (screen,) = server.screens()
            hanging.append(screen)
            await page.press("x")
            while len(page.messages) < 50:  # until one does not come back
                await page.socket.send_json(["beat", "2"])
                with suppress(TimeoutError):
                    await asyncio.wait_for(page.read(), 0.5)
                    continue
                break
            return screen

        try:
            async with page_of(client, server) as page:
                await page.socket.send_json(["beat", "1"])
                screen = await hang(page)
                if killed:
                    process.kill()
                    await until(lambda: gone(screen))
            await until(lambda: gone(screen))
        finally:
            process.kill()
            for screen in hanging:
                with suppress(ProcessLookupError):
                    os.kill(screen, signal.SIGKILL)


@pytest.mark.timeout(PATIENCE)
async def test_a_frame_never_splits_a_piece_of_a_report(monkeypatch: pytest.MonkeyPatch) -> None:
    keys, page = os.pipe(), os.pipe()
    with (
        open(keys[0], "rb") as stdin,
        open(keys[1], "wb"),
        open(page[0], "rb") as received,
        open(page[1], "wb") as stdout,
    ):
        monkeypatch.setattr(sys, "__stdin__", stdin)
        monkeypatch.setattr(sys, "__stdout__", stdout)
        driver = PageDriver(App())
        sent = [(b"P", b"report " * 9000, 30), (b"D", b"frame " * 700, 300)]

        def write(kind: bytes, payload: bytes, count: int) -> None:
            for _ in range(count):
                driver._write(kind + len(payload).to_bytes(4, "big") + payload)

        threads = [Thread(target=write, args=job, daemon=True) for job in sent]
        for thread in threads:
            thread.start()
        payloads = {kind: payload for kind, payload, _ in sent}
        for _ in range(sum(count for *_, count in sent)):
            kind = received.read(1)
            assert int.from_bytes(received.read(4), "big") == len(payloads[kind])
            assert received.read(len(payloads[kind])) == payloads[kind]


@pytest.mark.timeout(2 * PATIENCE)
async def test_a_report_opened_on_the_page_comes_through_the_server_once(
    sockets: Path, tmp_path: Path, client: aiohttp.ClientSession
) -> None:
    run = tmp_path / "monday"
    run.mkdir()
    (run / "run.yaml").write_text("{}\n")
    (run / "state").write_text("done\n")
    (run / "trace.html").write_text("<h1>What the model lacks</h1>" + 200_000 * "-")
    with web_server("--runs", tmp_path) as server:
        async with page_of(client, server) as page:
            await page.until("No protocol is running")
            await page.press("0")
            await page.until("lock-and-excite")
            await page.press("\x1b[C")  # right: the runs
            await page.until("monday")
            await page.press("\r")
            await page.until("open its report")
            await page.press("\x1b[B\x1b[B\r")
            key = await page.message("deliver_file_start")
            address = f"http://{server.host}/download/{key}"
            async with client.get(address.partition("?")[0]) as answer:
                assert answer.status == 403
            async with client.get(address) as answer:
                assert answer.status == 200
                assert "sandbox" in answer.headers["Content-Security-Policy"]
                assert answer.content_type == "text/html"
                assert await answer.text() == (run / "trace.html").read_text()
            async with client.get(address) as answer:
                assert answer.status == 404


def refused(*words: object) -> tuple[int, str]:
    """The exit code and the one line that a wrong call ends with."""
    ended = bramah("monitor", *words)
    assert ended.stdout == ""
    assert ended.stderr.count("\n") == 1, ended.stderr
    return ended.returncode, ended.stderr


def test_a_port_in_use_ends_in_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        code, said = refused("--web", "--port", port)
    assert code == 1
    assert said.startswith(f"bramah: --port {port}: Address already in use")


@pytest.mark.parametrize(
    "words",
    [
        ("--web", "--plain"),
        pytest.param(("--port", 8000), marks=pytest.mark.slow),
        pytest.param(("--web", "--port", 70000), marks=pytest.mark.slow),
        pytest.param(("--web", "--rig", Path(__file__)), marks=pytest.mark.slow),  # no rig file
    ],
)
def test_wrong_options_end_in_one_line(words: tuple[object, ...]) -> None:
    assert refused(*words)[0] == 2


def test_without_its_package_the_page_names_the_command_that_installs_it() -> None:
    hidden = "import sys; sys.modules['textual_serve'] = None; from rig.cli.main import run; run()"
    ended = subprocess.run(
        [sys.executable, "-c", hidden, "monitor", "--web"],
        capture_output=True, text=True, timeout=LONG, check=False,
    )  # fmt: skip
    assert ended.returncode == 1
    assert ended.stderr.splitlines() == [
        "bramah: --web needs the package textual-serve, which is not installed: "
        "pip install 'bramah[web]'"
    ]
