"""What the tests of the screen stand on: sessions made of recorded snapshots, and a clock."""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from textual.pilot import Pilot

from rig.bench.screens.commands import Command
from rig.bench.screens.snapshot import PastMinute
from rig.bench.screens.sockets import Endpoint, Snapshot
from rig.tui.app import Monitor
from rig.tui.words import StopAnswer


def endpoint(rig: str = "shinshu-2dof", pid: int = 4711) -> Endpoint:
    """Return where a session of this rig would be."""
    return Endpoint(rig, pid, Path(f"{rig}-{pid}.pub"), Path(f"{rig}-{pid}.cmd"))


class Recorded:
    """A run that says what it was given, and takes commands (or does not answer)."""

    def __init__(self, snapshots: Iterable[Snapshot] = (), *, answers: bool = True) -> None:
        self.waiting = deque(snapshots)
        self.answers = answers
        self.commands: list[str] = []
        self.asked: list[tuple[str, str]] = []
        self.refusal: str | None = None
        self.lately: PastMinute | None = None

    def ask(self, command: Command) -> str | None:
        self.asked.append((command.word, command.value))
        return self.refusal

    def past(self, timeout: float) -> PastMinute | None:
        return self.lately

    def receive(self, timeout: float) -> Snapshot | None:
        return self.waiting.popleft() if self.waiting else None

    def send(self, command: str) -> bool:
        self.commands.append(command)
        return self.answers

    def close(self) -> None:
        pass


class Machine:
    """The sessions of a machine: runs come and go."""

    def __init__(self, runs: dict[Endpoint, Any] | None = None) -> None:
        self.runs = dict(runs or {})

    def find(self) -> list[Endpoint]:
        return list(self.runs)

    def open(self, where: Endpoint) -> Any:
        if where not in self.runs:
            raise ConnectionError(f"{where} has gone")
        return self.runs[where]


class Clock:
    """A monotonic clock that a test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


class Glass:
    """An operator in front of the screen: time passes, keys are pressed, text is read."""

    def __init__(self, app: Monitor, pilot: Pilot[int], clock: Clock) -> None:
        self.app, self.pilot, self.clock = app, pilot, clock

    async def watch(self, seconds: float = 0.0) -> None:
        """Let time pass, take in all that the run has said, and draw."""
        self.clock.now += seconds
        before = None
        while before is not self.app.link.frame:
            before = self.app.link.frame
            self.app.link.step(0.0)
        self.app.draw(force=True)
        await self.pilot.pause()

    async def press(self, key: str) -> None:
        await self.pilot.press(key)
        await self.pilot.pause()

    async def answered(self) -> None:
        """Wait until the stop that was pressed has an answer, and draw."""
        while self.app.stop_asked is None or self.app.stop_asked.answer is StopAnswer.SENDING:
            await self.pilot.pause(0.005)
        await self.watch()

    async def said(self, start: str) -> None:
        """Wait until an act's answer stands in the line of remarks, and draw."""
        while not self.app.remark.startswith(start) or self.app.remark.endswith("..."):
            await self.pilot.pause(0.005)
        await self.watch()

    @property
    def lines(self) -> list[str]:
        """The screen as text, line by line."""
        return [strip.text for strip in self.app.screen._compositor.render_strips()]

    @property
    def text(self) -> str:
        return "\n".join(self.lines)

    @property
    def sentences(self) -> str:
        """The screen as running text: where a long path wraps its sentence does not matter."""
        return " ".join(self.text.split())


@asynccontextmanager
async def glass(
    machine: Machine, size: tuple[int, int] = (100, 30), rig: str | None = None
) -> AsyncIterator[Glass]:
    """Open a screen on a machine, with the link stepped by hand: nothing depends on speed."""
    clock = Clock()
    app = Monitor(rig, machine, clock, threaded=False)
    async with app.run_test(size=size) as pilot:
        shown = Glass(app, pilot, clock)
        await shown.watch()
        yield shown
