"""A run in a process of its own, for tests that kill, starve or interrupt it.

Usage: child.py RUN MODE [NUMBER]. Every acknowledged sample count is appended to RUN.ack, what
the device was told to RUN.device; both outlive the process.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from drivers.base import DeviceLost, OutputLaw
from rig.bench.screens.sockets import Publisher
from rig.bench.session import Bench
from rig.model.trips import OperatorStop, RecordingFailed
from rig.runs import archive, journal, recorder, store
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig
from tests.services.fake_driver import FakeDriver, kill_self

RIG = load_rig("shinshu-2dof")


def dying(module: Any, name: str, when: int = 0, *, after: bool = False) -> None:
    """Let a function kill the process at its `when`-th call, before or after its work."""
    real: Callable[..., Any] = getattr(module, name)
    calls = [0]

    def wrapped(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        if calls[0] > when and not after:
            kill_self()
        result = real(*args, **kwargs)
        if calls[0] > when and after:
            kill_self()
        return result

    setattr(module, name, wrapped)


def its_own(module: Any, name: str) -> Any:
    """Give a module a copy of a module it imports, so that a change there meets nobody else."""
    shared = getattr(module, name)
    copy = ModuleType(shared.__name__)
    vars(copy).update(vars(shared))
    setattr(module, name, copy)
    return copy


def fuller_for_the_archive(size: int) -> None:
    """Let the disk take only `size` bytes of records.h5."""
    real = archive.create

    def create(*args: Any) -> Any:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        return real(*args)

    archive.create = create


def torn_write(*_: Any, **__: Any) -> None:
    """Leave half a records.h5.tmp behind and die."""
    fresh = RUN / "records.h5.tmp"
    fresh.write_bytes(fresh.read_bytes()[:1000] + b"torn")
    kill_self()


def prepare(mode: str, number: int) -> dict[str, Any]:
    """Arrange the accident; returns arguments for the driver."""
    if mode == "kill at block":
        return {"before_block": lambda n: kill_self() if n == number else None}
    if mode == "kill in archive":
        places: list[Callable[[], None]] = [
            lambda: dying(archive, "create"),
            lambda: dying(archive, "create", after=True),
            lambda: dying(archive, "write_group", 1),
            lambda: dying(archive, "write_group", 2, after=True),
            lambda: setattr(archive, "verify", torn_write),
            lambda: dying(archive, "verify", after=True),
            lambda: dying(archive, "put_in_place", after=True),
            lambda: dying(recorder, "write_state"),
            lambda: dying(recorder, "write_state", after=True),
            lambda: dying(journal.Journal, "delete", after=True),
        ]
        places[number]()
    elif mode == "kill at start":
        starts: list[Callable[[], None]] = [
            lambda: dying(store, "write_state"),
            lambda: dying(store, "replace_text"),
            lambda: dying(store, "replace_text", after=True),
            lambda: dying(journal.Journal, "create"),
            lambda: dying(journal.Journal, "create", after=True),
            lambda: dying(its_own(journal, "sqlite3"), "connect", after=True),
            lambda: dying(its_own(journal, "json"), "dumps"),
            lambda: dying(its_own(journal, "sqlite3"), "connect", 1),
        ]
        starts[number]()
    elif mode == "kill at end of a lost device":
        dying(recorder, "write_state", after=True)

        def lose(sequence: int) -> None:
            if sequence == number:
                raise DeviceLost("the device does not answer")

        return {"before_block": lose}
    elif mode in ("file limit", "disk full"):
        sys.dont_write_bytecode = True  # the limit would cut it off, and Python would keep it
        resource.setrlimit(resource.RLIMIT_FSIZE, (number, number))
        if mode == "disk full":
            fuller_for_the_archive(number // 2)
    elif mode == "ctrl-c twice":
        real = FakeDriver.zero_outputs

        def zero(self: FakeDriver) -> None:
            os.kill(os.getpid(), signal.SIGINT)  # the second, in the middle of the zeroing
            real(self)
            os.kill(os.getpid(), signal.SIGINT)

        def first(sequence: int) -> None:
            if sequence == number:
                FakeDriver.zero_outputs = zero  # type: ignore[method-assign]
                os.kill(os.getpid(), signal.SIGINT)

        return {"before_block": first}
    elif mode == "serve":
        return {"pace": 0.002}
    return {}


def run(mode: str, number: int) -> int:
    """Take two records of 0.3 s (longer for a limit) and what is around them."""
    blocks = {"serve": number, "file limit": 400, "disk full": 400}.get(mode, 30)
    driver = FakeDriver(RIG, log=RUN.with_suffix(".device"), **prepare(mode, number))
    publisher = Publisher(RIG.name) if mode == "serve" else None
    ack = os.open(RUN.with_suffix(".ack"), os.O_WRONLY | os.O_CREAT)
    try:
        with Bench(RIG, driver, Recorder(RUN, RIG), publisher) as bench:
            bench.apply([OutputLaw(bias=1.0, limit=2.0), OutputLaw()])
            bench.exchange()
            for repeat in (1, 2):
                bench.status(step="s", repeat=repeat, repeats=2, phase="recording")
                with bench.record(step="s", repeat=repeat):
                    for _ in range(blocks):
                        bench.exchange()
                        os.pwrite(ack, b"%08d" % bench.tick, 0)
            bench.exchange()
    except OperatorStop:
        return 130
    except RecordingFailed as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    RUN = Path(sys.argv[1])
    sys.exit(run(sys.argv[2], int(sys.argv[3])))
