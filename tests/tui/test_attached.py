"""The screen on a run of another process, over the real local sockets."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from textual.pilot import Pilot

from rig.tui.app import Monitor
from rig.tui.following.link import LinkStage
from rig.tui.words import notices

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # of a test with a process that ought to have acted long ago [s]


@pytest.fixture
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # A socket's address holds about 100 bytes: the usual temporary folder of a test is too deep.
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
def start(sockets: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    started: list[subprocess.Popen[bytes]] = []

    def begin(*arguments: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", "tests.tui.fake_run", "--total", "600", *arguments]
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(sockets)}
        started.append(subprocess.Popen(command, cwd=ROOT, env=environment))
        return started[-1]

    yield begin
    for process in started:
        process.kill()
        process.wait()


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
    start: Callable[..., subprocess.Popen[bytes]],
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
    start: Callable[..., subprocess.Popen[bytes]],
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
    start: Callable[..., subprocess.Popen[bytes]],
) -> None:
    process = start("--deaf", "0", "--rig", "press")
    app = Monitor("press")
    async with app.run_test(size=(80, 24)) as pilot:
        await until(pilot, lambda: app.link.frame.snapshot is not None)
        await pilot.press("s")
        await until(pilot, lambda: "STOP: NO ANSWER" in told(app))
        process.kill()
        await until(pilot, lambda: "RUN GONE" in told(app))
