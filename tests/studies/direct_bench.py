"""A simulated bench inside this process, for studies that need hundreds of experiments.

The protocol engine drives the plant itself: same plant, same protocol, same converters, but no
wire, no safety guard and no run folder. What leaves it are records as `load_run` would give them.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

from drivers.base import DeviceInfo, OutputLaw, SampleBlock
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from protocols.engine import engine
from protocols.files import library
from protocols.files.plan import Overrides, resolve
from protocols.files.schema import Protocol
from rig.bench.guard import JointRole
from rig.bench.screens.commands import Judge
from rig.bench.session import Bench
from rig.model import channels as ch
from rig.model.records import Record, Run
from rig.model.rig import Rig
from rig.model.wire.codes import decode_input, decode_output
from rig.runs.recorder import RecordMeta

Array = NDArray[np.float64]
# [samples] between two looks of the engine. A wire's block is shorter; here a call costs as much as
# a hundred samples do, and nothing that the engine decides changes within a tenth of a second.
BLOCK = 100
Attribute = str | float | int


class _Handle:
    """A record being taken; the bench keeps it when its `with` block ends well."""

    def __init__(self, bench: DirectBench, meta: RecordMeta, start: int, ticks: int) -> None:
        self._bench, self._meta, self._start, self._ticks = bench, meta, start, ticks
        self._more: dict[str, Attribute] = {}
        self._wanted = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None and self._wanted:
            self._bench.keep(self._meta, self._start, self._ticks, self._more)

    def note(self, **attributes: Attribute) -> None:
        self._more.update(attributes)

    def discard(self, reason: str) -> None:
        self._wanted = False


class DirectBench:
    """A `rig.bench.session.Bench`, as far as the engine uses it, on a plant of this process."""

    def __init__(self, rig: Rig, scenario: Scenario, seed: int) -> None:
        self.rig = rig
        self.plant = Plant(rig, scenario, seed)
        self.info = DeviceInfo.of(rig, "in process", BLOCK, virtual_time=True)
        self.records: list[Record] = []
        self._waves: list[Array] = [np.zeros(0) for _ in rig.joints]
        self._start = 0
        self._laws = tuple(Law() for _ in rig.joints)
        self._blocks: list[Array] = []
        self._sequence = 0
        self._sensors = [rig.sensors.of(ch.kind_of(name)[0]) for name in rig.channels]

    @property
    def tick(self) -> int:
        """The plant's next sample."""
        return self.plant.tick

    def zero_outputs(self) -> bool:
        """Put the outputs to zero."""
        self._laws = tuple(Law() for _ in self.rig.joints)
        return True

    def reconnect(self, wait: float) -> None:
        """Nothing here can be lost."""

    def listen(self, judge: Judge) -> None:
        """Nobody commands this bench."""

    def status(self, **changes: Any) -> None:
        """Nobody watches this bench."""

    def event(self, event: str, tick: int | None = None, **fields: Any) -> None:
        """No log is kept."""

    def upload(self, joint: int, wave: Array) -> None:
        """Store one period of a joint's (0-based) waveform [V]."""
        self._waves[joint] = np.asarray(wave, dtype=np.float64)

    def apply(self, laws: Sequence[OutputLaw], restart: bool = False) -> int:
        """Set all laws; returns the tick from which they hold."""
        if restart:
            self._start = self.plant.tick
        self._laws = tuple(
            Law(
                wave, self._start, law.gain, law.bias, law.position_gain, law.setpoint,
                min(law.limit, joint.limits.command),
            )
            for law, wave, joint in zip(laws, self._waves, self.rig.joints, strict=True)
        )  # fmt: skip
        return self.plant.tick

    def exchange(self, more: bool = False) -> SampleBlock:
        """Let the plant run for one block and return it, decoded."""
        first = self.plant.tick
        inputs, outputs = self.plant.advance(BLOCK, self._laws)
        data = np.empty((BLOCK, len(self._sensors) + len(self.rig.joints)))
        for k, sensor in enumerate(self._sensors):
            data[:, k] = decode_input(inputs[:, k], *sensor.range, sensor.bits)
        for i, joint in enumerate(self.rig.joints):
            data[:, len(self._sensors) + i] = decode_output(
                outputs[:, i], joint.valve.command_range, joint.valve.command_bits
            )
        self._blocks.append(data)
        self._sequence += 1
        saturated = np.zeros(inputs.shape, dtype=np.bool_)
        return SampleBlock(self._sequence, first, data, saturated, 0, False)

    def guard(self, roles: Sequence[JointRole]) -> None:
        """Nothing here can be hurt."""

    def record(
        self, meta: RecordMeta | None = None, *, start_tick: int | None = None,
        ticks: int | None = None,
    ) -> _Handle:  # fmt: skip
        """Make a record of `ticks` samples from `start_tick`."""
        assert meta is not None
        assert start_tick is not None
        assert ticks is not None
        return _Handle(self, meta, start_tick, ticks)

    def keep(self, meta: RecordMeta, start: int, ticks: int, more: dict[str, Attribute]) -> None:
        """Cut a record out of what was measured; every tick since the plant began is there."""
        rate = self.rig.sample_rate
        data = np.concatenate(self._blocks)[start : start + ticks]
        channels = {name: data[:, k].copy() for k, name in enumerate(self.rig.recorded)}
        self.records.append(
            Record(
                meta.name, meta.step, meta.locked, meta.repeat, rate, channels, start / rate,
                meta.period, meta.lines, {**meta.attributes, **more},
            )
        )  # fmt: skip


def simulated_run(
    rig: Rig,
    protocol: str | Protocol,
    seed: int,
    scenario: Scenario | None = None,
    overrides: Overrides | None = None,
) -> tuple[Run, dict[str, float]]:
    """Run a protocol (or the one so called) on a plant of this process; returns records and truth.

    Raises ProtocolAborted where the plant does not do what the protocol needs.
    """
    one = library.load(protocol) if isinstance(protocol, str) else protocol
    plan = resolve(one, rig, overrides or Overrides())
    bench = DirectBench(rig, scenario or Scenario(), seed)
    engine.run(plan, rig, cast("Bench", bench))
    return Run(rig, tuple(bench.records), f"{one.name}, seed {seed}"), bench.plant.truth()
