"""A headless browser, driven over its debugging socket; any of the Chromium family will do.

BRAMAH_BROWSER names the program where it is not found by its name; BRAMAH_PICTURES a folder in
which tests leave pictures of what they saw.
"""

from __future__ import annotations

import asyncio
import base64
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import aiohttp

VARIABLE = "BRAMAH_BROWSER"
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome")
SWITCHES = (
    "--headless=new", "--remote-debugging-port=0", "--no-first-run", "--disable-gpu",
    "--disable-dev-shm-usage", "--disable-background-networking", "--disable-sync",
    "--disable-component-update", "--window-size=1280,800", "about:blank",
)  # fmt: skip
# The page draws its terminal as a picture. Its text stands in the terminal's buffer, which is
# reached where the first of xterm's add-ons notes the terminal that it was loaded into.
NOTE_TERMINAL = """
Object.defineProperty(Object.prototype, "_terminal", {
  configurable: true,
  set(terminal) {
    window.shownTerminal ??= terminal;
    Object.defineProperty(this, "_terminal", {value: terminal, writable: true, configurable: true});
  },
});
"""
READ_TERMINAL = """
(() => {
  const buffer = window.shownTerminal?.buffer.active;
  if (!buffer) return "";
  const rows = Array.from({length: buffer.length}, (_, row) => buffer.getLine(row));
  return rows.map((row) => row.translateToString(true)).join("\\n");
})()
"""


def browser_path() -> str | None:
    """Return the program that the variable names or that is found by name, None without one."""
    named = os.environ.get(VARIABLE)
    return named or next((path for name in NAMES if (path := shutil.which(name))), None)


class BrowserTab:
    """A tab: opens addresses, presses keys, reads what the page shows and has asked for."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse) -> None:
        self._socket = socket
        self._numbers = count(1)
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.requested: list[str] = []  # addresses that the page has loaded, pictures in it apart
        self.complaints: list[str] = []  # what the browser's console reports as an error

    async def listen(self) -> None:
        """Take answers and events until the browser is gone."""
        async for message in self._socket:
            said = message.json()
            if "id" in said:
                self._answers.pop(said["id"]).set_result(said)
            elif said["method"] == "Network.requestWillBeSent":
                self.requested.append(said["params"]["request"]["url"])
            elif said["method"] == "Network.webSocketCreated":
                self.requested.append(said["params"]["url"])
            elif said["method"] == "Runtime.exceptionThrown":
                self.complaints.append(str(said["params"]["exceptionDetails"]))
            elif said["method"] == "Log.entryAdded" and said["params"]["entry"]["level"] == "error":
                self.complaints.append(said["params"]["entry"]["text"])

    async def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """Call a method of the debugging protocol; returns its result."""
        number = next(self._numbers)
        answer = self._answers[number] = asyncio.get_running_loop().create_future()
        await self._socket.send_json({"id": number, "method": method, "params": parameters})
        said = await answer
        assert "error" not in said, (method, said)
        result: dict[str, Any] = said["result"]
        return result

    async def open(self, address: str) -> None:
        for domain in ("Network", "Page", "Runtime", "Log"):
            await self.call(f"{domain}.enable")
        await self.call("Emulation.setFocusEmulationEnabled", enabled=True)
        await self.call("Page.addScriptToEvaluateOnNewDocument", source=NOTE_TERMINAL)
        await self.call("Page.navigate", url=address)

    async def evaluate(self, script: str) -> Any:
        result = await self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    async def terminal(self) -> str:
        """The text in the page's terminal, line by line."""
        return str(await self.evaluate(READ_TERMINAL))

    async def notice(self) -> str:
        """What the page says above its terminal, '' where it says nothing."""
        shown = "[...document.querySelectorAll('.notice.shown')].map(n => n.innerText).join(' ')"
        return str(await self.evaluate(shown))

    async def press(self, key: str, code: str, number: int) -> None:
        """Press a key: one letter writes itself, a name of several letters writes nothing."""
        text = {"text": key} if len(key) == 1 else {}
        named = {"key": key, "code": code, "windowsVirtualKeyCode": number}
        await self.call("Input.dispatchKeyEvent", type="keyDown", **named, **text)
        await self.call("Input.dispatchKeyEvent", type="keyUp", **named)

    async def picture(self, path: Path) -> bytes:
        """Write what is seen as PNG."""
        png = base64.b64decode((await self.call("Page.captureScreenshot", format="png"))["data"])
        path.write_bytes(png)
        return png


@contextmanager
def browser(program: str) -> Iterator[str]:
    """Start a browser with a profile of its own, killed at the end; yields where to debug it."""
    with tempfile.TemporaryDirectory(prefix="browser", ignore_cleanup_errors=True) as profile:
        # A container's root has no user namespace for the browser's sandbox.
        rooted = ["--no-sandbox"] if os.geteuid() == 0 else []
        words = [program, f"--user-data-dir={profile}", *rooted, *SWITCHES]
        with subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        ) as process:
            try:
                port = Path(profile, "DevToolsActivePort")
                while not (port.exists() and len(port.read_text().splitlines()) > 1):
                    assert process.poll() is None, f"{program} ended with {process.returncode}"
                    time.sleep(0.05)
                yield f"http://127.0.0.1:{port.read_text().splitlines()[0]}"
            finally:
                process.kill()


@asynccontextmanager
async def browser_tab(address: str) -> AsyncIterator[BrowserTab]:
    """Open a tab of a browser that runs; closed at the end."""
    async with aiohttp.ClientSession() as client:
        async with client.put(f"{address}/json/new?about:blank") as answer:
            about = await answer.json()
        async with client.ws_connect(about["webSocketDebuggerUrl"], max_msg_size=0) as socket:
            tab = BrowserTab(socket)
            listening = asyncio.create_task(tab.listen())
            try:
                yield tab
            finally:
                listening.cancel()
        async with client.get(f"{address}/json/close/{about['id']}") as answer:
            assert answer.status == 200
