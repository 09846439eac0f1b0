"""A long queue with random faults whose runner is killed again and again.

The items are those of `tests.queue.program`: real bench sessions with real run folders that fail,
trip, lose their device, are refused or are killed, drawn at random. After each end of the runner a
person's part is played: a trip is cleared, the queue is run again.
"""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rig.bench.latch import STATE_VARIABLE
from rig.queue.items import OVER
from rig.queue.store import QueueStore
from tests.queue.nights import ROOT, Night, reset

_MODES = {
    "done": 0.5,
    "fail": 0.1,
    "refuse": 0.08,
    "unready": 0.04,
    "odd": 0.04,
    "trip": 0.06,
    "die": 0.08,
    "die-early": 0.04,
    "lost": 0.06,
}
_KILL_WITHIN = 8.0  # [s] after its start, a runner that is to be killed
_KILL_ITEM_TOO = 0.5  # how often the item dies with its runner, as when a machine is reset


@dataclass(frozen=True)
class QueueStudy:
    """What became of the items; `wrong` says what must not be."""

    items: int
    states: dict[str, int]
    runner_starts: int
    runner_kills: int
    item_kills: int
    started_twice: int
    seconds: float
    wrong: tuple[str, ...]


def _add(night: Night, jobs: int, rng: np.random.Generator) -> None:
    for _ in range(jobs):
        mode = str(rng.choice(list(_MODES), p=list(_MODES.values())))
        if mode in ("trip", "die", "lost"):
            mode = f"{mode}-{rng.integers(1, 60)}"
        night.add(mode, int(rng.integers(0, 3)), identify=bool(rng.random() < 0.1))


def _kill(night: Night, pid: int, rng: np.random.Generator) -> bool:
    """Kill the runner and now and then the item it runs; says whether an item was killed."""
    os.kill(pid, signal.SIGKILL)
    with QueueStore(night.path) as store:
        children = [item.pid for item in store.items() if item.state == "running" and item.pid]
    killed = False
    if children and rng.random() < _KILL_ITEM_TOO:
        try:
            os.kill(children[0], signal.SIGKILL)
            killed = True
        except ProcessLookupError:
            pass
    return killed


def faulty_queue(folder: Path, jobs: int, runner_kills: int, seed: int) -> QueueStudy:
    """Run a queue of `jobs` items to its end, killing its runner `runner_kills` times."""
    folder.mkdir(parents=True)
    before = os.environ.get(STATE_VARIABLE)
    path = os.environ.get("PYTHONPATH")
    os.environ[STATE_VARIABLE] = str(folder / "state")
    os.environ["PYTHONPATH"] = str(ROOT)
    try:
        return _study(folder, jobs, runner_kills, np.random.default_rng(seed))
    finally:
        for name, value in ((STATE_VARIABLE, before), ("PYTHONPATH", path)):
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value


def _study(folder: Path, jobs: int, runner_kills: int, rng: np.random.Generator) -> QueueStudy:
    began = time.monotonic()
    night = Night(folder)
    _add(night, jobs, rng)
    starts = kills = item_kills = 0
    while any(state not in OVER for state in night.states()):
        if starts > 3 * jobs + runner_kills:
            break  # counted below as items that are not over
        runner = night.process()
        starts += 1
        if kills < runner_kills:
            wait = float(rng.uniform(0.2, _KILL_WITHIN))
            deadline = time.monotonic() + wait
            while runner.poll() is None and time.monotonic() < deadline:
                time.sleep(0.01)
            if runner.poll() is None:
                item_kills += _kill(night, runner.pid, rng)
                kills += 1
        if runner.wait() == 3:
            reset()
    twice = sum(night.starts(k) > 1 for k in range(1, jobs + 1))
    states = Counter(night.states())
    wrong = [f"{state}: no final state" for state in states if state not in OVER]
    wrong += [f"{twice} items were started twice"] if twice else []
    wrong += [f"{sum(states.values())} items of {jobs}"] if sum(states.values()) != jobs else []
    wrong += _unlike(night, jobs)
    return QueueStudy(
        jobs, dict(states), starts, kills, item_kills, twice, time.monotonic() - began, tuple(wrong)
    )


_EXPECTED = {
    "done": {"done", "interrupted"},
    "fail": {"failed", "interrupted"},
    "refuse": {"refused"},
    "unready": {"refused", "failed", "interrupted"},
    "odd": {"failed", "interrupted"},
    "trip": {"tripped", "done", "interrupted"},
    "die": {"interrupted", "done"},
    "die-early": {"interrupted"},
    "lost": {"device lost", "done", "interrupted"},
}


def _unlike(night: Night, jobs: int) -> list[str]:
    """Name items whose state does not follow from what happened to them."""
    found = []
    for number in range(1, jobs + 1):
        item = night.item(number)
        mode = item.job.name
        kind = mode.rpartition("-")[0] if mode[-1].isdigit() else mode
        if item.state not in _EXPECTED[kind]:
            found.append(f"item {number}, {mode}: {item.state}: {item.reason}")
        if item.state != "done" and not item.reason:
            found.append(f"item {number}, {mode}: {item.state} without a reason")
        if (Path(item.run) / "journal.sqlite").exists():
            found.append(f"item {number}, {mode}: its journal was not recovered")
    return found


def queue_text(found: QueueStudy) -> str:
    """Return the counts as text."""
    states = ", ".join(f"{n} {state}" for state, n in sorted(found.states.items()))
    lines = [
        f"{found.items} items: {states}",
        f"runner started {found.runner_starts} times, killed {found.runner_kills} times, "
        f"{found.item_kills} times together with its item; {found.started_twice} items ran twice",
        f"took {found.seconds:.0f} s",
    ]
    return "\n".join([*lines, *(f"WRONG {text}" for text in found.wrong)])
