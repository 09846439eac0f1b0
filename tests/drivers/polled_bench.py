"""A plain device of inputs and outputs and a clock, both of the test's own making."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from drivers.polled import PolledDriver
from rig.model import channels as ch
from rig.model.rig import Rig
from tests.hil_sim.integrator import PRESSURE, SPEED_PER_VOLT, SPOOL_PER_VOLT, seed_rig

Array = NDArray[np.float64]


class FakeClock:
    """Time that passes only while somebody sleeps or `pass_` is called; `late` delays a waking."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.naps: list[float] = []
        self.late: Callable[[int], float] = lambda _: 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0.0
        self.naps.append(seconds)
        self.now += seconds + self.late(len(self.naps))

    def pass_(self, seconds: float) -> None:
        self.now += seconds


class FakeModule:
    """Reads and writes a plant whose pistons move at a speed proportional to their voltage.

    `signal` replaces what is read by a function of time [s]; `before_read` and `before_write` may
    raise or let time pass; `watchdog` is what the module claims.
    """

    def __init__(self, rig: Rig, clock: FakeClock, watchdog: float | None = 0.5) -> None:
        self.rig = rig
        self.clock = clock
        self.watchdog = watchdog
        self.volts = np.zeros(len(rig.joints))
        self.written: list[tuple[float, Array]] = []
        self.calls: list[str] = []
        self.signal: Callable[[float], Array] | None = None
        self.before_read: Callable[[], None] = lambda: None
        self.before_write: Callable[[], None] = lambda: None
        self._piston = np.zeros(len(rig.joints))
        self._at = clock()

    def open(self) -> str:
        self.calls.append("open")
        return "a module of the test"

    def close(self) -> None:
        self.calls.append("close")

    def read(self) -> Array:
        self.before_read()
        self._advance()
        if self.signal is not None:
            return self.signal(self.clock())
        values = np.zeros(len(self.rig.channels))
        for column, name in enumerate(self.rig.channels):
            kind, joint = ch.kind_of(name)
            i = (joint or 1) - 1
            values[column] = {
                ch.SPOOL: SPOOL_PER_VOLT * self.volts[i],
                ch.PISTON: self._piston[i],
                ch.TEMPERATURE: 40.0,
            }.get(kind, PRESSURE)
        return values

    def write(self, volts: Array) -> None:
        self.before_write()
        self._advance()
        self.volts = volts
        self.written.append((self.clock(), volts))

    def _advance(self) -> None:
        now = self.clock()
        self._piston = self._piston + SPEED_PER_VOLT * self.volts * (now - self._at)
        self._at = now


def polled_bench(
    *, rate: float = 100.0, watchdog: float | None = 0.5, **more: bool
) -> tuple[PolledDriver, FakeModule, FakeClock]:
    """A driver over the module at a sample rate [Hz], not connected yet."""
    rig = seed_rig(timeout=0.2, watchdog=0.5).model_copy(update={"sample_rate": rate})
    clock = FakeClock()
    module = FakeModule(rig, clock, watchdog)
    driver = PolledDriver(rig.wire, rig, module, clock=clock, sleep=clock.sleep, **more)
    return driver, module, clock
