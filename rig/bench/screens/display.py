"""The bench's connection to screens: publishes snapshots, receives commands."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.base import SampleBlock
from rig.bench.checks import bands
from rig.bench.guard import GuardSettings, JointRole, piston_bounds
from rig.bench.screens.commands import Command, Judge
from rig.bench.screens.snapshot import (
    Band,
    BenchView,
    PastKeeper,
    PlanLine,
    Progress,
    take_snapshot,
)
from rig.bench.screens.sockets import Publisher
from rig.model import channels as ch
from rig.model.alarms.states import AlarmTable
from rig.model.rig import Rig
from rig.runs import runstate

Array = NDArray[np.float64]
Limits = dict[str, Band]

LOST: Final = "lost"  # `device` in a snapshot if the device does not answer
_INTERVAL = 0.05  # [s] of wall time between snapshots


class Display:
    """Publishes at most twenty snapshots per second of wall time; none without a publisher."""

    def __init__(
        self, rig: Rig, publisher: Publisher | None, run: str, clock: Callable[[], float]
    ) -> None:
        self.progress = Progress()
        self.trip: str | None = None
        self.alarms = AlarmTable()
        self._rig = rig
        self._publisher = publisher
        self._run = run
        self._clock = clock
        self._units = {name: ch.unit_of(name) for name in rig.recorded}
        self._waiting: list[Array] = []
        self._next = -np.inf
        self._tick = 0
        self._first: int | None = None
        self._lost = 0
        self._end = ""
        self._roles: Sequence[JointRole] = ()
        self._bands: tuple[Sequence[JointRole], Limits, Limits] | None = None
        self._past = PastKeeper(rig.recorded)
        if publisher is not None:
            publisher.past = self._past.answer

    def describe(self, plan: Sequence[PlanLine]) -> None:
        """Set the steps of the plan, which a screen lists."""
        self._past.plan = tuple(plan)
        self.progress = replace(self.progress, parts=len(self._past.plan))

    def repeat(self) -> None:
        """Publish, if due, a snapshot without new samples while the device is lost."""
        if self._publisher is not None and self._clock() >= self._next:
            self._publish(runstate.RUNNING, 0.0)
            self._next = self._clock() + _INTERVAL

    def commands(self, judge: Judge | None = None) -> list[Command]:
        """Return the screens' commands that `judge` did not refuse."""
        return [] if self._publisher is None else self._publisher.commands(judge) or []

    def show(self, block: SampleBlock, age: float, lost: int, roles: Sequence[JointRole]) -> None:
        """Take a block; publish a snapshot if one is due."""
        if self._publisher is None:
            return
        self._waiting.append(block.data)
        if self._first is None:
            self._first = block.tick
        self._tick = block.tick + len(block.data)
        self._lost, self._roles = lost, roles
        if self.trip is not None or self._clock() >= self._next:
            self._next = self._clock() + _INTERVAL
            state = runstate.RUNNING if self.trip is None else runstate.TRIPPED
            self._publish(self._end or state, age)

    def _publish(self, state: str, age: float) -> None:
        if self._publisher is None:
            return
        columns = len(self._units)
        samples = np.concatenate(self._waiting) if self._waiting else np.empty((0, columns))
        self._waiting = []
        device_time = self._tick / self._rig.sample_rate
        self._past.add(device_time, samples)
        if state == runstate.RUNNING and not self._publisher.watched:
            return  # no screen attached; a later one gets the last minute and new samples
        if self._first is not None:
            elapsed = (self._tick - self._first) / self._rig.sample_rate
            self.progress = replace(self.progress, done_s=elapsed)
        limits, warnings = self._both_bands()
        view = BenchView(
            run=self._run,
            rig=self._rig.name,
            state=state,
            tick=self._tick,
            device_time=device_time,
            wall_time=time.time(),
            block_age=age,
            lost_samples=self._lost,
            trip=self.trip,
            alarms=self.alarms.alarms,
            holder=getattr(self._publisher, "holder", ""),
            roles=[_role(role) for role in self._roles],
            wire=self._rig.wire.endpoint,
            sample_rate=self._rig.sample_rate,
        )
        snapshot = take_snapshot(view, self.progress, samples, self._units, limits, warnings)
        self._publisher.publish(snapshot)

    def _both_bands(self) -> tuple[Limits, Limits]:
        """Return the trip and warning bands of every channel, which change with the roles only."""
        if self._bands is None or self._bands[0] is not self._roles:
            warn: Limits = {}
            if self._roles:
                near = bands.warning_bounds(self._rig, tuple(self._roles), GuardSettings())
                warn = {name: near.of(k) for k, name in enumerate(self._rig.recorded)}
            self._bands = (self._roles, self._limits(), warn)
        return self._bands[1], self._bands[2]

    def _limits(self) -> Limits:
        limits_by_channel: Limits = {}
        for name in self._units:
            kind, joint = ch.kind_of(name)
            low, high = self._rig.limits_of(name)
            if kind == ch.PISTON and joint is not None:
                low = math.inf  # unknown without a role
                if self._roles:
                    _, low, high = piston_bounds(self._roles[joint - 1], self._rig, joint - 1)
            limits_by_channel[name] = (low, high) if math.isfinite(low) else (None, None)
        return limits_by_channel

    def ended(self, state: str, message: str, *, lost: bool = False) -> None:
        """Publish how the run ended, with the outputs at zero; `lost`: the device was lost."""
        if lost:
            self.progress = replace(self.progress, device=LOST)
        if message:
            self.progress = replace(self.progress, message=message)
        self._end = state
        self._publish(state, 0.0)

    def last(self) -> None:
        """Publish the samples not yet published of a run that has ended."""
        if self._waiting:
            self._publish(self._end, 0.0)

    def close(self) -> None:
        """Close the sockets; never raises."""
        if self._publisher is not None:
            self._publisher.close()
            self._publisher = None


def _role(role: JointRole) -> str:
    return "excited" if role.excited else "locked" if role.locked else "free"
