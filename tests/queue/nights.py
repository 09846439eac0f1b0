"""A queue with its jobs, and its runner in this process or in one that can be killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest

from rig.bench.latch import BenchState
from rig.queue import processes
from rig.queue.hook import Hook
from rig.queue.items import Item, QueueJob
from rig.queue.processes import LockFile
from rig.queue.runner import QueueReport, QueueSettings, Runner
from rig.queue.store import QueueStore
from rig.runs.rigs import load_rig
from rig.runs.runstate import read_events
from tests.forked import Forked

ROOT = Path(__file__).parents[2]
PROGRAM = (sys.executable, "-m", "tests.queue.program")
Process = Forked | subprocess.Popen[bytes]
QUICK = QueueSettings(
    poll=0.02, wait_poll=0.05, probe_every=0.05, in_use_seconds=0.05, probe_seconds=60.0
)
LONG = 120.0  # [s] a hang ends in an error that says so


class Night:
    """A queue file in a folder; `add` takes the mode of `program`.

    Runners and items are forked (`tests.forked`); unless `forked`, they are started anew.
    """

    def __init__(self, folder: Path, *, forked: bool = True) -> None:
        self.folder = folder
        self.forked = forked
        self.path = folder / "queue.sqlite"
        self.said: list[str] = []

    def add(self, mode: str, priority: int = 0, **job: object) -> int:
        with QueueStore(self.path) as store:
            out = str(self.folder / f"run{store.next_number()}")
            what = QueueJob(mode, "shinshu-2dof", out, name=mode, **job)  # type: ignore[arg-type]
            return store.add(what, priority, {"seconds": 1.0}).id

    def run(
        self, *command: str, serve: bool = False, settings: QueueSettings = QUICK
    ) -> QueueReport:
        with QueueStore(self.path) as store, self._starts():
            hook = Hook(command, self.folder / "hook.log", seconds=1.5)
            with Runner(
                store, self.say, hook, serve=serve, program=PROGRAM, settings=settings
            ) as runner:
                return runner.run()

    def say(self, line: str) -> None:
        self.said.append(line)
        if __name__ == "__main__":
            sys.stderr.write(line + "\n")
            sys.stderr.flush()

    def item(self, number: int) -> Item:
        with QueueStore(self.path) as store:
            return store.item(number)

    def states(self) -> list[str]:
        with QueueStore(self.path) as store:
            return [item.state for item in sorted(store.items(), key=lambda item: item.id)]

    def events(self, number: int) -> list[str]:
        with QueueStore(self.path) as store:
            return [line.event for line in store.history(number)]

    def starts(self, number: int) -> int:
        """How often an item got as far as its bench."""
        return sum(
            len(path.read_text().splitlines())
            for path in self.folder.glob("*.starts")
            if path.stem.partition("-")[0] == f"run{number}"
        )

    def recorded(self, number: int) -> bool:
        """Whether an item's run has a complete record on the disk."""
        run = Path(self.item(number).run)
        return any(event["event"] == "record complete" for event in read_events(run))

    def process(self) -> Process:
        """Start a runner as a process, without the runs' progress."""
        with (self.folder / "runner.log").open("ab") as log:
            if self.forked:
                files = log.fileno(), log.fileno()
                return Forked([self.folder], ROOT, "tests.queue.nights", files=files)
            line = [sys.executable, "-m", "tests.queue.nights", str(self.folder), "anew"]
            environment = {**os.environ, "PYTHONPATH": str(ROOT)}
            return subprocess.Popen(line, env=environment, cwd=ROOT, stdout=log, stderr=log)

    @contextmanager
    def _starts(self) -> Iterator[None]:
        with pytest.MonkeyPatch.context() as patch:
            if self.forked:
                patch.setattr(processes, "start", _forked)
            yield


def until(true: Callable[[], bool], what: str) -> None:
    """Wait until something holds."""
    deadline = time.monotonic() + LONG
    while not true():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def reset() -> None:
    """Clear the bench's latched trip, as a person does."""
    BenchState(load_rig("shinshu-2dof").wire).clear("looked at it", None)


def _forked(
    words: Sequence[str], output: IO[bytes], errors: IO[bytes] | int, lock: LockFile | None = None
) -> Forked:
    """As `processes.start`, with the program forked."""
    assert tuple(words[: len(PROGRAM)]) == PROGRAM
    said = output.fileno()
    files = said, said if isinstance(errors, int) else errors.fileno()
    inherited = () if lock is None else (lock.fileno(),)
    try:
        return Forked(words[len(PROGRAM) :], module=PROGRAM[-1], files=files, inherited=inherited)
    finally:
        if lock is not None:
            lock.close()


def _die_at(place: str, after: bool) -> None:
    """Let this process die by SIGKILL at a change of the queue, before or after it."""
    real = getattr(QueueStore, place)

    def dying(self: QueueStore, *arguments: object) -> object:
        if after:
            real(self, *arguments)
        os.kill(os.getpid(), signal.SIGKILL)
        return None

    setattr(QueueStore, place, dying)


if __name__ == "__main__":
    if "TEST_KILL" in os.environ:
        where, when = os.environ.pop("TEST_KILL").split()
        _die_at(where, when == "1")
    sys.exit(Night(Path(sys.argv[1]), forked=len(sys.argv) == 2).run().code)
