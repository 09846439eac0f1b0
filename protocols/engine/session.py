"""The session with the bench: laws in force, samples read so far, waiting in device time."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from drivers.base import OFF, OutputLaw
from protocols.engine.states import ENERGISED, StateMachine
from rig.bench.session import Bench
from rig.model import channels as ch
from rig.model.rig import Rig

Array = NDArray[np.float64]
Watch = Callable[[], None]


class Session:
    """Holds the laws in force and the recent samples; every wait is in device time."""

    def __init__(
        self, bench: Bench, rig: Rig, keep: int, machine: StateMachine, before_block: Watch
    ) -> None:
        """Keep the last `keep` samples; `before_block` is called before each block."""
        self.bench = bench
        self._machine = machine
        self._before_block = before_block
        self.rig = rig
        self.rate = rig.sample_rate
        self.joints = len(rig.joints)
        self.laws: list[OutputLaw] = [OFF] * self.joints
        self.now = 0  # the tick after the last sample read
        self._columns = {name: column for column, name in enumerate(rig.recorded)}
        # NaN where lost; a channel's samples are adjacent, because they are read by channel.
        self._ring = np.full((len(rig.recorded), keep), np.nan).T

    def apply(self, changes: Mapping[int, OutputLaw], restart: bool = False) -> int:
        """Apply new laws for some joints; return the tick from which they hold.

        Raises RuntimeError for any law but zero while the engine is at rest.
        """
        drives = any(law.limit > 0.0 for law in changes.values())
        if drives and self._machine.state not in ENERGISED:
            raise RuntimeError(f"an output law was requested in state {self._machine.state}")
        for joint, law in changes.items():
            self.laws[joint] = law
        return self.bench.apply(tuple(self.laws), restart)

    def off(self) -> None:
        """Zero every output."""
        self.apply(dict.fromkeys(range(self.joints), OFF))

    def forget(self) -> None:
        """Drop samples and laws, because the device was reconnected."""
        self._ring[:] = np.nan
        self.laws = [OFF] * self.joints
        self.now = 0

    def until(self, tick: int, watch: Watch | None = None) -> None:
        """Read blocks up to sample `tick` - 1; `watch` is called after each."""
        while self.now < tick:
            self._before_block()
            more = tick - self.now > self.bench.info.block_samples
            block = self.bench.exchange(more)
            if block.tick > self.now:
                gap_start = max(self.now, block.tick - len(self._ring))
                self._ring[self._indices(gap_start, block.tick)] = np.nan
            self.now = block.tick + len(block.data)
            self._ring[self._indices(block.tick, self.now)] = block.data
            if watch is not None:
                watch()

    def wait(self, seconds: float, watch: Watch | None = None) -> int:
        """Read for a time from now on; return the tick at its beginning."""
        first = self.now
        self.until(first + max(1, round(seconds * self.rate)), watch)
        return first

    def samples(self, kind: str, joint: int, first: int, last: int) -> Array:
        """Return a channel of joint `joint` (0-based) over ticks [first, last), NaN where lost."""
        return self.channel(ch.channel(kind, joint + 1), first, last)

    def channel(self, name: str, first: int, last: int) -> Array:
        """Return a channel by its name over ticks [first, last), NaN where lost."""
        column, oldest = self._columns[name], self.now - len(self._ring)
        if oldest <= first and last <= self.now:
            return self._ring[self._indices(first, last), column].copy()  # the ring is overwritten
        begin, end = max(first, oldest), min(last, self.now)
        values = np.full(last - first, np.nan)
        if begin < end:
            values[begin - first : end - first] = self._ring[self._indices(begin, end), column]
        return values

    def _indices(self, first: int, last: int) -> slice | NDArray[np.int64]:
        """Return the indices of ticks [first, last) in the ring, a slice if contiguous."""
        size = len(self._ring)
        begin = first % size
        if begin + last - first <= size:
            return slice(begin, begin + max(0, last - first))
        return np.arange(first, last) % size

    def piston(self, joint: int, first: int, last: int) -> Array:
        """Return the piston [m] of joint `joint` (0-based) over ticks [first, last)."""
        return self.samples(ch.PISTON, joint, first, last)

    def command(self, joint: int, first: int, last: int) -> Array:
        """Return the command [V] of joint `joint` (0-based) over ticks [first, last)."""
        return self.samples(ch.COMMAND, joint, first, last)
