"""Runs in separate processes for a screen to watch and stop, timed on the device's clock.

The simulated bench runs on the same computer, and its sample clock follows the monotonic clock
of all processes, so that sample n was taken at `origin` + n / rate. A block arrives after its
last sample, hence

    origin <= min over blocks of (arrival - ticks at its end / rate),

and this minimum serves as the origin. It is late by the shortest transmission time of a block,
1 to 2 ms, so that delays after a key and ages are never underestimated.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
from numpy.typing import NDArray

from drivers import make_driver
from drivers.base import OFF, Driver, OutputLaw, SampleBlock
from rig.bench.guard import FREE
from rig.bench.latch import BenchState
from rig.bench.screens.sockets import Publisher
from rig.bench.session import Bench
from rig.cli.bench.screen.terminal import SESSIONS
from rig.cli.errors import WorkError
from rig.cli.execution.device import reached_at
from rig.runs.recorder import Recorder
from rig.runs.rigs import load_rig

Array = NDArray[np.float64]

RIG: Final = "digger-3dof"  # three joints: 17 values a sample
SQUARE: Final = 0.05  # amplitude of the square wave [V], never zero
HALF_PERIOD: Final = 0.02  # half period of the square wave [s]
ZERO_TAIL: Final = 0.1  # recorded at the end with the outputs at zero [s]
END_TIMEOUT: Final = 20.0  # of a run's process, from the request to its end [s]


@dataclass(frozen=True)
class RunTimes:
    """Blocks of a run: `ends` [s of device time], `arrivals` [monotonic s], each shape (blocks,).

    `zeroed`: device time [s] from which on all outputs were zero, NaN if never. `zeroings`:
    monotonic times [s] at which the run commanded zero outputs. `lost`: number of lost samples.
    `reason`: how the run ended. `held`: whether a screen was in command.
    """

    ends: Array
    arrivals: Array
    lost: int
    zeroed: float
    zeroings: tuple[float, ...]
    reason: str
    held: bool

    @property
    def origin(self) -> float:
        """The monotonic time [s] of device time 0, late by the shortest transmission of a block."""
        return float((self.arrivals - self.ends).min())


class StampedDriver:
    """A driver that records when each block arrived and when an output was last not zero."""

    def __init__(self, driver: Driver, inputs: int, rate: float) -> None:
        self._driver, self._inputs, self._rate = driver, inputs, rate
        self.ends: list[float] = []
        self.arrivals: list[float] = []
        self.zeroings: list[float] = []
        self.last_output = -1  # the tick of the newest sample with an output

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    def read_block(self) -> SampleBlock:
        """Return the next block."""
        block = self._driver.read_block()
        self.arrivals.append(time.monotonic())
        self.ends.append((block.tick + len(block.data)) / self._rate)
        nonzero = np.flatnonzero((block.data[:, self._inputs :] != 0.0).any(axis=1))
        if len(nonzero):
            self.last_output = block.tick + int(nonzero[-1])
        return block

    def zero_outputs(self) -> None:
        """Put every output to zero."""
        self.zeroings.append(time.monotonic())
        self._driver.zero_outputs()

    def times(self, lost: int, reason: str, *, held: bool) -> RunTimes:
        """Return the recorded times."""
        has_moved = self.last_output >= 0
        zeroed = (self.last_output + 1) / self._rate if has_moved else float("nan")
        ends, arrivals = np.array(self.ends), np.array(self.arrivals)
        return RunTimes(ends, arrivals, lost, zeroed, tuple(self.zeroings), reason, held)


def play(endpoint: str, runtime: Path, out: Path, driven: bool, pipe: Connection) -> None:
    """Play one run into `out` in this process until it is stopped or `pipe` receives anything.

    `runtime` holds the folder of sockets. `driven` puts a square wave on the first joint. Sends
    "watched" once a screen is attached, "held" once it is in command, and the RunTimes at the end.
    """
    rig = reached_at(load_rig(RIG), endpoint)
    driver = StampedDriver(make_driver(rig.wire, rig), len(rig.channels), rig.sample_rate)
    publisher = Publisher(rig.name, runtime / SESSIONS)
    state = BenchState(rig.wire, runtime)
    recorder = Recorder(out, rig)
    reason, lost, held = "", 0, False
    try:
        with Bench(rig, cast("Driver", driver), recorder, publisher, state=state) as bench:
            bench.recorded_after = ZERO_TAIL
            bench.guard([FREE] * len(rig.joints))
            if driven:
                half = np.ones(round(HALF_PERIOD * rig.sample_rate))
                bench.upload(0, SQUARE * np.concatenate((half, -half)))
                laws = [OutputLaw(gain=1.0, limit=2 * SQUARE), *[OFF] * (len(rig.joints) - 1)]
                bench.apply(laws, restart=True)
            reported = ""
            while not pipe.poll():
                bench.exchange()
                lost = bench.lost_samples
                word = "held" if publisher.holder else "watched" if publisher.watched else ""
                held = bool(publisher.holder)
                if word and word != reported:
                    reported = word
                    pipe.send(word)
    except Exception as error:
        reason = str(error) or repr(error)
    pipe.send(driver.times(lost, reason, held=held))


class PlayedRun:
    """A run in a separate process and the messages it has sent."""

    def __init__(self, pipe: Connection) -> None:
        self._pipe = pipe
        self._words: list[str] = []
        self.times: RunTimes | None = None

    def has_sent(self, word: str, timeout: float) -> bool:
        """Return whether the run has sent a word; waits `timeout` [s] for it, or for the end."""
        self._receive(timeout, lambda: word in self._words)
        return word in self._words

    def ended(self) -> RunTimes:
        """Return the times of a run that ends by itself; raises WorkError if it does not."""
        self._receive(END_TIMEOUT, lambda: self.times is not None)
        if self.times is None:
            raise WorkError(f"bench --only screen: a run did not end within {END_TIMEOUT:g} s")
        return self.times

    def end(self) -> RunTimes:
        """End the run and return its times."""
        with suppress(OSError):
            self._pipe.send("end")
        return self.ended()

    def _receive(self, timeout: float, complete: Callable[[], bool]) -> None:
        deadline = time.monotonic() + timeout
        while not complete() and self.times is None:
            try:
                if not self._pipe.poll(max(deadline - time.monotonic(), 0.0)):
                    return
                message = self._pipe.recv()
            except EOFError as error:
                raise WorkError("bench --only screen: a run's process was lost") from error
            if isinstance(message, RunTimes):
                self.times = message
            else:
                self._words.append(message)


@contextmanager
def played(endpoint: str, runtime: Path, out: Path, *, driven: bool) -> Iterator[PlayedRun]:
    """Play a run in a separate process (see `play`), and end the process afterwards."""
    context = get_context("forkserver")  # starts a process with all imports in 20 ms
    context.set_forkserver_preload([__name__])
    pipe, run_pipe = context.Pipe()
    process = context.Process(target=play, args=(endpoint, runtime, out, driven, run_pipe))
    process.start()
    run_pipe.close()
    try:
        yield PlayedRun(pipe)
    finally:
        with suppress(OSError):
            pipe.send("end")
        process.join(END_TIMEOUT)
        if process.is_alive():
            process.kill()
            process.join()
        pipe.close()
