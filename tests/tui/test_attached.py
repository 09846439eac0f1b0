"""The screen on a run of another process, over the real local sockets."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from textual.pilot import Pilot

from rig.tui.app import Monitor
from rig.tui.following.link import LinkStage
from rig.tui.words import notices
from tests.forked import Forked

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # of a test with a process that ought to have acted long ago [s]


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # A socket's address holds about 100 bytes: the usual temporary folder of a test is too deep.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
def start(sockets: Path) -> Iterator[Callable[..., Forked]]:
    started: list[Forked] = []

    def begin(*arguments: str) -> Forked:
        words = ("--total", 600, *arguments)
        started.append(Forked(words, ROOT, "tests.tui.fake_run", told=True))
        return started[-1]

    yield begin
    for process in started:
        with process:
            process.kill()


async def until(pilot: Pilot[int], so: Callable[[], bool]) -> None:
    """Wait until something is so; the test's own time limit ends a wait in vain."""
    while not so():
        await pilot.pause(0.02)


def told(app: Monitor) -> str:
    return " ".join(
        n.text for n in notices(app.link.frame, app.stop_asked, app.clock(), paused=False)
    )


@pytest.mark.timeout(PATIENCE)
async def test_the_screen_waits_joins_the_run_that_appears_and_stops_it(
    start: Callable[..., Forked],
) -> None:
    app = Monitor("shinshu-2dof")
    async with app.run_test(size=(80, 24)) as pilot:
        assert app.link.frame.stage is LinkStage.WAITING
        process = start()
        await until(pilot, lambda: len(app.link.frame.window.time) > 40)
        assert app.link.frame.snapshot is not None
        assert app.link.frame.snapshot.pid == process.pid
        await pilot.press("s")
        await until(pilot, lambda: "STOP SENT, OUTPUTS ZEROED" in told(app))
        assert process.wait(PATIENCE) == 0
        await until(pilot, lambda: app.link.frame.stage is LinkStage.ENDED)
        assert app.link.frame.snapshot.state == "aborted"


@pytest.mark.timeout(PATIENCE)
async def test_a_screen_that_leaves_does_not_disturb_the_run(
    start: Callable[..., Forked],
) -> None:
    process = start()

    async def look_and_leave() -> None:
        app = Monitor(None)
        async with app.run_test(size=(80, 24)) as pilot:
            await until(pilot, lambda: app.link.frame.snapshot is not None)
            await pilot.press("q")

    await look_and_leave()
    assert process.poll() is None
    await look_and_leave()
    assert process.poll() is None


@pytest.mark.timeout(PATIENCE)
async def test_a_run_that_does_not_answer_is_reported_and_one_that_dies_is_gone(
    start: Callable[..., Forked],
) -> None:
    process = start("--deaf", "0", "--rig", "press")
    app = Monitor("press")
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.link.frame.snapshot is not None)
        await pilot.press("s")
        await until(pilot, lambda: "STOP: NO ANSWER" in told(app))
        process.kill()
        await until(pilot, lambda: "RUN GONE" in told(app))


class Terminal:
    """`bramah monitor` in a terminal of its own."""

    def __init__(self, sockets: Path, **environment: str) -> None:
        self.inner, outer = pty.openpty()
        self.outer = outer
        self.resize(100, 30)
        words = [sys.executable, "-c", "from rig.cli.main import run; run()", "monitor"]
        other = ("NO_COLOR", "COLORTERM", "COLUMNS", "LINES")  # the terminal says its own size
        known = {k: v for k, v in os.environ.items() if k not in other}
        self.process = subprocess.Popen(
            words, cwd=ROOT, stdin=outer, stdout=outer, stderr=outer, start_new_session=True,
            env={**known, "XDG_RUNTIME_DIR": str(sockets), "TERM": "xterm", **environment},
        )  # fmt: skip
        self.drawn = ""

    def resize(self, width: int, height: int) -> None:
        size = struct.pack("HHHH", height, width, 0, 0)
        fcntl.ioctl(self.outer, termios.TIOCSWINSZ, size)

    def until(self, words: str) -> None:
        """Read what is drawn until some words are in it, colours left out."""
        while words not in self.drawn:
            assert select.select([self.inner], [], [], PATIENCE)[0], f"no {words!r}"
            raw = os.read(self.inner, 1 << 16).decode(errors="replace")
            self.raw = getattr(self, "raw", "") + raw
            self.drawn += re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", raw)

    def press(self, keys: str) -> None:
        self.drawn = ""
        os.write(self.inner, keys.encode())

    def end(self) -> int:
        """Press q and read the rest; returns the exit code."""
        self.press("q")
        while self.process.poll() is None:
            if select.select([self.inner], [], [], 0.05)[0]:
                self.drawn += os.read(self.inner, 1 << 16).decode(errors="replace")
        return self.process.returncode


@pytest.fixture
def terminal(sockets: Path) -> Iterator[Callable[..., Terminal]]:
    opened: list[Terminal] = []

    def begin(**environment: str) -> Terminal:
        opened.append(Terminal(sockets, **environment))
        return opened[-1]

    yield begin
    for one in opened:
        one.process.kill()
        one.process.wait()
        os.close(one.inner)
        os.close(one.outer)


@pytest.mark.timeout(2 * PATIENCE)
def test_a_terminal_of_16_colours_resized_to_nothing_and_back_goes_on(
    start: Callable[..., Forked], terminal: Callable[..., Terminal]
) -> None:
    run = start()
    screen = terminal()
    screen.until("to nearest limit")
    assert "38;2;" not in screen.raw, "no colour beyond the terminal's own 16"
    for size in ((1, 1), (0, 0), (30, 5)):
        screen.resize(*size)
        os.kill(screen.process.pid, signal.SIGWINCH)
    screen.until("SPACE STOPS")
    screen.drawn = ""
    screen.resize(100, 30)
    os.kill(screen.process.pid, signal.SIGWINCH)
    screen.until("to nearest limit")
    screen.press(" ")
    screen.until("OUTPUTS ZEROED")
    assert run.wait(PATIENCE) == 0
    assert screen.end() == 0
    assert "Traceback" not in screen.drawn


@pytest.mark.timeout(2 * PATIENCE)
def test_without_colours_and_beside_the_sockets_of_a_dead_run_it_still_speaks(
    sockets: Path, start: Callable[..., Forked], terminal: Callable[..., Terminal]
) -> None:
    dead = start("--rig", "dead")
    while not list(sockets.glob("bramah/dead-*.pub")):
        time.sleep(0.01)
    dead.kill()
    dead.wait()
    screen = terminal(NO_COLOR="1")
    screen.until("No protocol is running")
    start()
    screen.until("limit")
    screen.press("4")
    screen.until("time of the device")
    assert not re.search(r"\x1b\[[0-9;]*\b(3[1-7]|4[1-7])\b[0-9;]*m", screen.raw)
    assert screen.end() == 0
