"""A simple honest device for tests: deterministic blocks, faults on demand, a log of its outputs.

Its pistons and pressures move as sines of the tick; its commands follow the output law. Every
change of the outputs is appended to `log` (a file, so that a killed process leaves it behind).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drivers.base import OFF, DeviceInfo, DeviceLost, OutputLaw, SampleBlock
from rig.model.rig import Rig

Array = NDArray[np.float64]


def samples(rig: Rig, ticks: NDArray[np.int64]) -> Array:
    """What the sensors say at these ticks, shape (n, recorded); commands and spools at zero."""
    t = ticks / rig.sample_rate
    data = np.zeros((len(ticks), len(rig.recorded)))
    for column, name in enumerate(rig.channels):
        wave = np.sin(2 * np.pi * t + column)
        if name.startswith("piston"):
            data[:, column] = 0.03 * wave
        elif "pressure" in name:
            data[:, column] = 3e6 + 1e6 * wave
        elif name.startswith("oil"):
            data[:, column] = 40 + 0.1 * wave
    return data


class FakeDriver:
    """Implements `drivers.base.Driver`; `before_block` may raise, kill or sleep at a block."""

    def __init__(
        self,
        rig: Rig,
        *,
        virtual: bool = True,
        block_samples: int = 10,
        first_tick: int = 0,
        log: Path | None = None,
        before_block: Callable[[int], None] | None = None,
        spoil: Callable[[SampleBlock], SampleBlock | None] | None = None,
        pace: float = 0.0,
    ) -> None:
        self.rig = rig
        self.info = DeviceInfo.of(rig, "fake bench", block_samples, virtual_time=virtual)
        self.calls: list[str] = []
        self.tick = first_tick
        self.sequence = 0
        self.waves: dict[int, Array] = {}
        self.laws: list[OutputLaw] = [OFF] * len(rig.joints)
        self.dead = False
        self.latched: str | None = None
        self._start = 0
        self._log = log
        self._before = before_block or (lambda _: None)
        self._spoil = spoil or (lambda block: block)
        self._pace = pace

    def _note(self, what: str) -> None:
        self.calls.append(what)
        if self._log is not None:
            with self._log.open("a") as stream:
                stream.write(what + "\n")

    def _alive(self) -> None:
        if self.dead:
            raise DeviceLost("the fake bench does not answer")

    def connect(self) -> DeviceInfo:
        self._alive()
        self._note("connect")
        return self.info

    def close(self) -> None:
        self._note("close")

    def zero_outputs(self) -> None:
        self._alive()
        self.laws = [OFF] * len(self.rig.joints)
        self._note("zero")

    def upload(self, joint: int, wave: Array) -> None:
        self._alive()
        self.waves[joint] = wave

    def apply(self, laws: Sequence[OutputLaw], *, restart: bool = False) -> int:
        self._alive()
        self.laws = list(laws)
        if restart:
            self._start = self.tick
        self._note("apply")
        return self.tick

    def start(self) -> None:
        self._alive()
        self.sequence = 0
        self._note("start")

    def stop(self) -> None:
        self._alive()
        self._note("stop")

    def trip_cause(self) -> str | None:
        self._alive()
        return self.latched

    def reset(self) -> None:
        self._alive()
        self.latched = None
        self._note("reset")

    def _commands(self, ticks: NDArray[np.int64], data: Array) -> Array:
        columns = []
        for joint, law in enumerate(self.laws):
            wave = self.waves.get(joint, np.zeros(1))
            piston = data[:, self.rig.recorded.index(f"piston_{joint + 1}")]
            volts = law.gain * wave[(ticks - self._start) % len(wave)] + law.bias
            volts = volts + law.position_gain * (law.setpoint - piston)
            columns.append(np.clip(volts, -law.limit, law.limit))
        return np.column_stack(columns)

    def read_block(self) -> SampleBlock:
        while True:
            if self._pace:
                time.sleep(self._pace)
            self._before(self.sequence)
            self._alive()
            n = self.info.block_samples
            ticks = np.arange(self.tick, self.tick + n)
            data = samples(self.rig, ticks)
            data[:, len(self.rig.channels) :] = commands = self._commands(ticks, data)
            for j, joint in enumerate(self.rig.joints):  # a spool without inertia
                spool = self.rig.channels.index(f"spool_{j + 1}")
                data[:, spool] = joint.valve.spool_gain * commands[:, j]
            marks = np.zeros((n, len(self.rig.channels)), dtype=bool)
            block = SampleBlock(self.sequence, self.tick, data, marks, 0, False)
            self.tick += n
            self.sequence += 1
            spoiled = self._spoil(block)
            if spoiled is not None:
                return spoiled


def kill_self() -> None:
    """Die at once, as by kill -9."""
    os.kill(os.getpid(), 9)
