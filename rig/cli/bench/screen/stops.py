"""Delay from the stop key to zero outputs, on the device's clock, with every core busy."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import numpy as np

from rig.cli.bench.figure import Figure
from rig.cli.bench.screen.runs import RIG, PlayedRun, played
from rig.cli.bench.screen.terminal import Screen
from rig.cli.errors import WorkError
from rig.cli.simulated.simulated_bench import simulated_bench

STOP_LIMIT: Final = 100.0  # [ms] from key to zero outputs, 99 %
ATTACH: Final = 30.0  # time in which a screen attaches to a run on a busy machine [s]
AGAIN: Final = 1.0  # time after which the key that takes control is pressed again [s]
SOON, LATE = 0.2, 0.5  # time from taking control to the stop key [s]
SEED: Final = 100
FAILURES, FAILURE_SHARE = 3, 0.1  # largest number of runs that may fail before their stop
FROM_SCREEN: Final = "from the screen"  # part of the reason of a run that a screen stopped
_BUSY: Final = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: sum(range(100000))"


class RunFailed(Exception):
    """A run ended before the stop key was pressed; the message is its reason."""


@contextmanager
def busy_cores(count: int) -> Iterator[None]:
    """Keep `count` cores busy with processes of the same priority as this one."""
    working = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for process in working:
            process.kill()
            process.wait()


def one_stop(screen: Screen, run: PlayedRun, wait: float) -> tuple[float, float]:
    """Return the delays [s] from a stop key to the run's zero command and to zero outputs.

    Takes control of a new run by the screen and presses the key `wait` [s] later. Both delays are
    infinite if the key did not stop the run. Raises RunFailed if the run ends before the key.
    """
    if not run.has_sent("watched", ATTACH) and run.times is None:
        raise WorkError("bench --only screen: the screen did not attach to the run")
    time.sleep(SOON)
    deadline = time.monotonic() + ATTACH
    screen.press("t")
    while not run.has_sent("held", AGAIN) and run.times is None and time.monotonic() < deadline:
        screen.press("t")
    run.has_sent("nothing", wait)  # returns early only at the run's end
    if run.times is not None:
        raise RunFailed(run.times.reason)
    pressed = screen.press(" ")
    times = run.ended()
    if not times.held or FROM_SCREEN not in times.reason:
        return math.inf, math.inf
    acted = min(at for at in times.zeroings if at > pressed)
    return acted - pressed, times.origin + times.zeroed - pressed


def many_stops(
    runtime: Path, say: Callable[[str], None], count: int
) -> tuple[list[tuple[float, float]], int]:
    """Return the delays [s] of `count` stops, and how many runs failed before the key.

    A bench that tripped because the computer was busy is replaced.
    """
    rng = np.random.default_rng(SEED)
    delays: list[tuple[float, float]] = []
    failed = 0
    with Screen(runtime) as screen:
        while len(delays) < count:
            with simulated_bench(RIG, seed=SEED, real_time=True) as endpoint, suppress(RunFailed):
                while len(delays) < count:
                    out = runtime / f"stop-{failed}-{len(delays)}"
                    failed += 1  # taken back below if the key stopped it
                    wait = float(rng.uniform(SOON, LATE))
                    with played(endpoint, runtime, out, driven=True) as run:
                        delays.append(one_stop(screen, run, wait))
                    failed -= 1
                    shutil.rmtree(out)
                    if len(delays) % 20 == 0:
                        say(f"screen: {len(delays)} of {count} stops")
            if failed > FAILURES + FAILURE_SHARE * count:
                raise WorkError(
                    f"bench --only screen: {failed} runs failed; the machine is too busy"
                )
    return delays, failed


def stop_figures(runtime: Path, say: Callable[[str], None], count: int) -> list[Figure]:
    """Stop `count` runs of the simulated bench by a key, each from a screen in command.

    As many processes as there are cores keep the cores busy.
    """
    busy = os.cpu_count() or 1
    say(f"screen: {count} stops by key, in real time, beside {busy} busy processes")
    with busy_cores(busy):
        delays, failed = many_stops(runtime, say, count)
    acted, late = 1e3 * np.array(delays).T
    return [
        Figure("screen", f"stops by key, beside {busy} busy processes", count),
        Figure("screen", "runs that failed before their stop", failed),
        Figure("screen", "key to output zero, median", float(np.median(late)), "ms"),
        Figure("screen", "key to output zero, 99 %", float(np.quantile(late, 0.99)), "ms",
               STOP_LIMIT),
        Figure("screen", "of it until the run acts, 99 %", float(np.quantile(acted, 0.99)), "ms"),
        Figure("screen", "key to output zero, worst", float(late.max()), "ms"),
    ]  # fmt: skip
