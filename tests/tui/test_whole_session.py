"""One operator, one screen, a simulated bench behind a real wire: from the check to the reset."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from textual.pilot import Pilot

from drivers import wire_at
from rig.bench.latch import BenchState
from rig.bench.screens.sockets import Snapshot
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from rig.tui.app import Monitor
from rig.tui.browse import BrowserState
from tests.cli.bench import SHORT, simulated

RIG = "shinshu-2dof"
PROMPTED = SHORT.replace(
    "steps:\n",
    "steps:\n  - {prompt: 'Load on?', answers: ['yes', 'no'], default: 'no', timeout: 600 s}\n",
)
PATIENCE = 60.0  # of a test whose processes ought to have acted long ago [s]


@pytest.fixture(autouse=True)
def verbs() -> None:
    """Let the screen start the real verbs."""


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="b", dir="/tmp") as folder:
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "short.yaml").write_text(PROMPTED)
    return tmp_path


class Session:
    """A screen of its own process time, and what is seen on it."""

    def __init__(self, app: Monitor, pilot: Pilot[int]) -> None:
        self.app, self.pilot = app, pilot

    async def keys(self, *names: str) -> None:
        for name in names:
            await self.pilot.press(name)

    async def until(self, so: Callable[[], bool]) -> None:
        while not so():
            await self.pilot.pause(0.02)

    async def remark(self, start: str) -> str:
        """Wait for an act's answer."""
        await self.until(lambda: self.app.remark.startswith(start) and "..." not in self.app.remark)
        return self.app.remark

    async def shows(self, so: Callable[[Snapshot], bool]) -> Snapshot:
        """Wait until the run is as wanted."""

        def found() -> bool:
            snapshot = self.app.link.frame.snapshot
            return snapshot is not None and so(snapshot)

        await self.until(found)
        assert self.app.link.frame.snapshot is not None
        return self.app.link.frame.snapshot

    async def choose(self, words: str) -> None:
        """Choose what to do with the protocol of the folder, which is listed first."""
        await self.keys("0")
        await self.until(lambda: not self.app.browsed.reading)
        await self.keys("home", "enter")
        assert self.app.dialog is not None
        for _ in range(self.app.dialog.choices.index(words)):
            await self.keys("down")
        await self.keys("enter")

    async def over(self) -> None:
        """Wait until the verb that was started here has ended."""
        await self.until(
            lambda: self.app.browsed.job is not None and self.app.browsed.job.code is not None
        )


def screen(folder: Path, endpoint: str) -> Monitor:
    return Monitor(None, browsed=BrowserState(folder=folder, rig=RIG, endpoint=endpoint))


@pytest.mark.timeout(PATIENCE)
async def test_check_start_answer_abort_then_jog_and_lock_by_hand(folder: Path) -> None:
    with simulated() as (endpoint, _):
        app = screen(folder, endpoint)
        async with app.run_test(size=(120, 40)) as pilot:
            session = Session(app, pilot)
            await session.choose("check on the twin")
            assert await session.remark("check: done")
            assert "joint 2   piston" in app.browsed.job.output  # type: ignore[union-attr]

            await session.choose("start on the bench")
            await session.keys("down", "enter")
            await session.shows(lambda s: bool(s.prompt))
            await session.keys("a", "enter")
            await session.remark("answer: 'yes' taken")
            await session.shows(lambda s: s.engine in ("homing", "locked", "exciting"))
            await session.keys("x")
            if app.dialog is not None:  # at rest between two steps it asks first
                await session.keys("down", "enter")
            ended = await session.shows(lambda s: s.state == "aborted")
            assert "aborted by process" in ended.message
            await session.over()

            await session.keys("9", "enter", "down", "enter")
            await session.shows(lambda s: s.kind == "manual" and s.state == "running")
            before = app.link.frame.snapshot.channels["piston_1"].last  # type: ignore[union-attr]
            await session.keys("up")
            await session.remark("jog: taken")
            await session.shows(lambda s: s.channels["piston_1"].last > before + 1e-3)
            await session.shows(lambda s: s.channels["command_1"].last == 0.0)
            await session.keys("l")
            await session.shows(lambda s: s.roles[0] == "locked")
            await session.keys("space")
            ended = await session.shows(lambda s: s.state == "aborted")
            assert ended.message == "stopped by operator (from the screen)"
            await session.over()


@pytest.mark.timeout(PATIENCE)
async def test_a_trip_is_acknowledged_and_reset_with_a_reason(folder: Path) -> None:
    scenario = folder / "scenario.yaml"
    offset = "{name: sensor_offset, channel: cap_pressure_2, offset: 6 MPa}"
    scenario.write_text(f"effects: [{offset}]\n")
    with simulated("--scenario", scenario) as (endpoint, _):
        app = screen(folder, endpoint)
        async with app.run_test(size=(120, 40)) as pilot:
            session = Session(app, pilot)
            await session.choose("start on the bench")
            await session.keys("down", "enter")
            await session.shows(lambda s: bool(s.prompt))
            await session.keys("a", "enter")  # the trip comes as soon as something moves
            await session.shows(lambda s: s.state == "tripped")
            await session.over()
            await session.until(lambda: app.link.frame.over)
            wire = wire_at(endpoint, load_rig(RIG).wire)
            assert BenchState(wire).read_trip() is not None
            await session.keys("5", "r")
            assert "acknowledge" in app.remark
            await session.keys("k", "r", *"sensor", "space", *"replaced", "enter")
            assert "cap_pressure_2" in await session.remark("reset: cleared")
            assert BenchState(wire).read_trip() is None
            run = Path(app.link.frame.snapshot.run)  # type: ignore[union-attr]
            said = {event["event"]: event for event in read_events(run)}
            assert said["alarm acknowledged"]["by"] == app.me
            assert said["trip cleared"]["reason"] == "sensor replaced"
