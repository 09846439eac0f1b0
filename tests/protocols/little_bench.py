"""A bench in the test's own process: the same calls as the real one, a plant of a few lines.

The plant is what a protocol has to cope with, not hydraulics: each piston integrates its spool
with different gains for the two directions, drifts, lags, stops at its ends. It shares nothing
with the analysis model or the simulated bench.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.base import DeviceInfo, DeviceLost, OutputLaw, SampleBlock
from rig.bench.guard import JointRole
from rig.bench.screens.commands import Judge
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.runs.recorder import RecordMeta

Array = NDArray[np.float64]
BLOCK = 10


@dataclass
class Cylinder:
    """A joint of the little plant; mutable so that a test can break it in the middle of a run."""

    piston: float = 0.0
    extend: float = 0.17  # m/s per command volt
    retract: float = 0.15
    offset: float = 0.0  # V, spool off its null
    load: float = 0.0  # m/s, creeps under load whatever the command
    lag: float = 0.01  # s
    stop: float = 0.0375
    give: float = 0.0  # m, moves by this times the other joint's speed / 0.1 m/s
    speed: float = 0.0


class Clipped(Exception):
    """The plant passed a piston limit of an excited joint: the real bench would have tripped."""


@dataclass
class Handle:
    """What the bench gives for a record."""

    meta: RecordMeta
    start: int
    ticks: int
    state: str = "open"
    attributes: dict[str, Any] = field(default_factory=dict)

    def __enter__(self) -> Handle:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        if self.state == "open":
            self.state = "complete" if error is None else "partial"

    def note(self, **attributes: Any) -> None:
        self.attributes.update(attributes)

    def discard(self, reason: str) -> None:
        self.state = "discarded"


class LittleBench:
    """Runs as fast as it is read; keeps everything, so that tests can look at it afterwards."""

    def __init__(
        self, rig: Rig, cylinders: Sequence[Cylinder], seed: int = 0, lose: Sequence[int] = ()
    ) -> None:
        self.rig = rig
        self.cylinders = list(cylinders)
        self.names = rig.recorded
        self.width = len(self.names)
        self.step = 1.0 / rig.sample_rate
        self.places = [
            [self.names.index(ch.channel(kind, j)) for kind in (ch.PISTON, ch.SPOOL, ch.COMMAND)]
            for j in range(1, len(self.cylinders) + 1)
        ]
        self.info = DeviceInfo(
            "little", len(cylinders), len(rig.channels), rig.sample_rate, BLOCK, True
        )
        self.rng = np.random.default_rng(seed)
        self.laws = [OutputLaw()] * len(cylinders)
        self.waves = [np.zeros(1) for _ in cylinders]
        self.roles: list[JointRole] = []
        self.records: list[Handle] = []
        self.tick = 0
        self.start = 0
        self.rows: list[Array] = []
        self.lose = set(lose)  # numbers of blocks that never arrive
        self.blocks = 0
        self.applied: list[tuple[int, tuple[OutputLaw, ...]]] = []
        self.events: list[dict[str, Any]] = []
        self.shown: dict[str, Any] = {}
        self.reconnected = 0
        self.unreachable = 0  # attempts to reconnect that fail
        self.judge: Judge | None = None
        self.happenings: dict[int, Callable[[], None]] = {}  # what befalls the bench, by tick

    def zero_outputs(self) -> bool:
        self.laws = [OutputLaw()] * len(self.laws)
        return True

    def reconnect(self, wait: float) -> None:
        self.zero_outputs()
        self.reconnected += 1
        if self.reconnected <= self.unreachable:
            raise DeviceLost("connection refused")

    def listen(self, judge: Judge) -> None:
        self.judge = judge

    def status(self, **changes: Any) -> None:
        self.shown.update(changes)

    def event(self, event: str, tick: int | None = None, **fields: Any) -> None:
        self.events.append({"event": event, "tick": tick, **fields})

    def upload(self, joint: int, wave: Array) -> None:
        self.waves[joint] = np.array(wave)

    def apply(self, laws: Sequence[OutputLaw], restart: bool = False) -> int:
        for law, joint in zip(laws, self.rig.joints, strict=True):
            assert law.limit <= joint.limits.command
        self.laws = list(laws)
        if restart:
            self.start = self.tick
        self.applied.append((self.tick, tuple(laws)))
        return self.tick

    def guard(self, roles: Sequence[JointRole]) -> None:
        self.roles = list(roles)

    def record(
        self,
        meta: RecordMeta | None = None,
        *,
        start_tick: int | None = None,
        ticks: int | None = None,
    ) -> Handle:
        assert meta is not None
        assert start_tick is not None
        assert ticks is not None
        self.records.append(Handle(meta, start_tick, ticks, attributes=dict(meta.attributes)))
        return self.records[-1]

    def exchange(self, more: bool = False) -> SampleBlock:
        while True:
            first = self.tick
            noise = 1e-5 * self.rng.standard_normal((BLOCK, len(self.cylinders)))
            data = np.array([self._sample(row) for row in noise.tolist()])
            self.rows.append(data)
            self.blocks += 1
            self._check(data)
            if self.blocks in self.lose:
                continue
            saturated = np.zeros((BLOCK, self.info.channels), dtype=bool)
            return SampleBlock(self.blocks, first, data, saturated, 0, False)

    def _sample(self, noise: list[float]) -> list[float]:
        if self.tick in self.happenings:
            self.happenings.pop(self.tick)()
        row = [3e6 + 500.0 * (self.tick % 7)] * self.width  # a live sensor
        since = self.tick - self.start
        speeds = [c.speed for c in self.cylinders]
        both = sum(speeds)
        for j, c in enumerate(self.cylinders):
            law, wave = self.laws[j], self.waves[j]
            s = c.piston + c.give * (both - speeds[j]) / 0.1 + noise[j]
            v = law.gain * wave.item(since % len(wave)) if law.gain else 0.0
            v = v + law.bias + law.position_gain * (law.setpoint - s)
            v = min(max(v, -law.limit), law.limit)
            u = v + c.offset
            wish = (c.extend if u > 0 else c.retract) * u + c.load
            c.speed += self.step / c.lag * (wish - c.speed)
            c.piston += self.step * c.speed
            if abs(c.piston) > c.stop:
                c.piston, c.speed = max(-c.stop, min(c.piston, c.stop)), 0.0
            piston, spool, command = self.places[j]
            row[piston], row[spool], row[command] = s, 0.1 * u, v
        self.tick += 1
        return row

    def _check(self, data: Array) -> None:
        for j, role in enumerate(self.roles):
            if not role.excited:
                continue
            piston = data[:, self.places[j][0]]
            low, high = self.rig.joints[j].limits.piston
            if piston.min() < low or piston.max() > high:
                self.laws = [OutputLaw()] * len(self.laws)
                raise Clipped(
                    f"joint {j + 1} at {1e3 * piston.min():.1f}..{1e3 * piston.max():.1f}"
                )

    def channel(self, name: str, start: int = 0, ticks: int | None = None) -> Array:
        """Everything that was ever measured of a channel, from the first tick on."""
        data = np.concatenate(self.rows)[:, self.names.index(name)]
        return data[start : None if ticks is None else start + ticks]

    @property
    def complete(self) -> list[Handle]:
        return [r for r in self.records if r.state == "complete"]


def default_cylinders() -> list[Cylinder]:
    """Two joints that drift about as the seed bench does."""
    return [Cylinder(extend=0.17, retract=0.16), Cylinder(extend=0.155, retract=0.175)]
