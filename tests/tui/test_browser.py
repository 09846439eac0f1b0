"""The operator's screen in a real browser, on a run of a simulated bench."""

from __future__ import annotations

import asyncio
import os
import re
import signal
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from tests.cli.bench import ENDLESS, LONG, outputs_are_zero, simulated, started
from tests.tui.browser import NAMES, VARIABLE, BrowserTab, browser, browser_path, browser_tab
from tests.tui.web_page import WebServer, web_server

PROGRAM = browser_path()
pytestmark = pytest.mark.skipif(
    PROGRAM is None,
    reason=f"no browser: none of {', '.join(NAMES)} is on the path, and {VARIABLE} names none",
)


@pytest.fixture(scope="module", autouse=True)
def sockets() -> Iterator[None]:
    with (
        tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("XDG_RUNTIME_DIR", folder)
        yield


@pytest.fixture(scope="module")
def server(sockets: None) -> Iterator[WebServer]:
    with web_server() as served:
        yield served


@pytest.fixture(scope="module")
def started_browser() -> Iterator[str]:
    assert PROGRAM is not None
    with browser(PROGRAM) as address:
        yield address


@pytest.fixture
async def tab(started_browser: str) -> AsyncIterator[BrowserTab]:
    async with browser_tab(started_browser) as opened:
        yield opened


async def until(read: Callable[[], Awaitable[str]], pattern: str) -> str:
    """Read until a pattern is in it; the test's own time limit ends a wait in vain."""
    while not re.search(pattern, text := await read()):
        await asyncio.sleep(0.05)
    return text


def pictures(tmp_path: Path) -> Path:
    """Where pictures go: the folder that a person named to look at them, or the test's."""
    return Path(os.environ.get("BRAMAH_PICTURES", tmp_path))


@pytest.mark.timeout(2 * LONG)
async def test_an_operator_watches_a_run_in_a_browser_and_stops_it(
    server: WebServer, tab: BrowserTab, tmp_path: Path
) -> None:
    protocol, out = tmp_path / "endless.yaml", tmp_path / "run"
    protocol.write_text(ENDLESS)
    words = ["run", protocol, "--rig", "shinshu-2dof", "--out", out, "--unattended"]
    with (
        simulated("--real-time") as (endpoint, _),
        started(*words, "--endpoint", endpoint) as run,
    ):
        await tab.open(server.address)
        await until(tab.terminal, r"step1 +warm-up")
        seen = await until(tab.terminal, r"cap +\d\.\d\d MPa")
        await until(tab.notice, "^$")
        assert re.search(r"rod +\d\.\d\d MPa", seen)
        assert "▣ locked" in seen
        assert seen.count("SPACE STOP") == 1, "one size, that of the page"
        assert re.search(r"^ SPACE STOP .{80,}q quit", seen, re.MULTILINE)
        await until(tab.terminal, r"command +[+−]0\.[1-9]")  # the outputs are not zero
        png = await tab.picture(pictures(tmp_path) / "running.png")
        assert len(png) > 20_000, "a page that is drawn is no plain area"
        await tab.press(" ", "Space", 32)
        await until(tab.terminal, "STOP SENT, OUTPUTS ZEROED: the run confirmed it")
        assert run.wait(LONG) == 130
        assert outputs_are_zero(endpoint)
        await tab.picture(pictures(tmp_path) / "stopped.png")
    assert not tab.complaints
    assert {address.split("/")[2] for address in tab.requested} == {server.host}
    assert all(f"token={server.token}" in address for address in tab.requested)
    assert sum(".ttf" in address for address in tab.requested) >= 3


@pytest.mark.timeout(LONG)
async def test_keys_reach_the_screen_whatever_was_clicked_and_q_closes_it(
    server: WebServer, tab: BrowserTab
) -> None:
    await tab.open(server.address)
    await until(tab.terminal, "No protocol is running")
    await tab.evaluate("document.activeElement.blur()")
    focused = "document.activeElement.className"
    await until(lambda: tab.evaluate(focused), "xterm-helper-textarea")
    await tab.press("?", "Slash", 191)
    await until(tab.terminal, "all outputs to zero, at once")
    await tab.press("Escape", "Escape", 27)
    await tab.evaluate("document.hasFocus = () => false")  # another window has the keys
    await until(tab.notice, "KEYS GO ELSEWHERE")
    await tab.evaluate("delete document.hasFocus")
    await until(tab.notice, "^$")
    await tab.press("q", "KeyQ", 81)
    await until(tab.notice, "The screen is closed. A run that it showed goes on. open the screen")


@pytest.mark.timeout(LONG)
async def test_the_address_without_its_token_shows_a_sentence(
    server: WebServer, tab: BrowserTab
) -> None:
    await tab.open(f"http://{server.host}/")
    await until(lambda: tab.evaluate("document.body?.innerText ?? ''"), "no valid token")


# Ends the server that all share, so it comes last.
@pytest.mark.timeout(2 * LONG)
async def test_a_page_without_its_server_says_that_its_picture_is_old(
    server: WebServer, tab: BrowserTab, tmp_path: Path
) -> None:
    await tab.open(server.address)
    await until(tab.terminal, "No protocol is running")
    await until(tab.notice, "^$")
    while len(server.screens()) > 1:  # of pages that the tests before have closed
        await asyncio.sleep(0.02)
    (screen,) = server.screens()
    os.kill(screen, signal.SIGSTOP)
    assert "emergency stop" in await until(tab.notice, "STALE: this picture is .* s old")
    os.kill(screen, signal.SIGCONT)
    await until(tab.notice, "^$")
    server.end(signal.SIGKILL)
    assert "emergency stop" in await until(tab.notice, "DISCONNECTED")
    await tab.picture(pictures(tmp_path) / "disconnected.png")
