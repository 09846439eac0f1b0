"""A plant with faults of its scenario that begin and end at their times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from hil_sim.faults.base import Fault, Restore
from hil_sim.plant.interface import Law
from hil_sim.plant.plant import Plant
from hil_sim.scenario.file import Scenario
from rig.model.rig import Rig
from rig.model.wire.codes import Codes

STREAM: Final = 3  # of a bench's seed; 0 and 1 are the plant's, 2 is that of drawn scenarios


@dataclass
class _TimedFault:
    """A fault that acts from tick `first` to before `end`; `restore` undoes its changes."""

    fault: Fault
    first: int
    end: float
    restore: Restore | None = None
    codes_before: Codes = field(default_factory=lambda: np.zeros(0, dtype=np.int64))


class FaultyPlant:
    """A `Plant` with the faults of a scenario, equal to `Plant` without any."""

    def __init__(self, rig: Rig, scenario: Scenario, seed: int) -> None:
        self.plant = Plant(rig, scenario, seed)
        self._rig = rig
        self._rng = np.random.default_rng([seed, STREAM])
        self._last = np.zeros(len(rig.channels), dtype=np.int64)
        self._faults = [
            _TimedFault(
                fault,
                round(fault.at * rig.sample_rate),
                math.inf if fault.until is None else round(fault.until * rig.sample_rate),
            )
            for fault in scenario.faults
        ]

    @property
    def tick(self) -> int:
        """Samples measured so far."""
        return self.plant.tick

    def advance(self, ticks: int, laws: Sequence[Law]) -> tuple[Codes, Codes]:
        """Run `ticks` ticks as `Plant.advance` does, faults beginning and ending in between."""
        if not self._faults:
            return self.plant.advance(ticks, laws)
        parts = [self.plant.advance(0, laws)]
        while ticks > 0:
            self._switch()
            count = min(ticks, self._until_next())
            parts.append(self._distorted(*self.plant.advance(count, laws)))
            ticks -= count
        measured, outputs = zip(*parts, strict=True)
        return np.concatenate(measured), np.concatenate(outputs)

    def mark(self) -> object | None:
        """Return the state for `rewind`; None with faults, which cannot be undone."""
        return None if self._faults else self.plant.mark()

    def rewind(self, mark: object) -> None:
        """Restore the state of a mark."""
        self.plant.rewind(mark)

    def _until_next(self) -> int:
        edges = [
            edge for fault in self._faults for edge in (fault.first, fault.end) if edge > self.tick
        ]
        return int(min(edges) - self.tick) if edges and min(edges) < math.inf else 1 << 62

    def _switch(self) -> None:
        for fault in self._faults:
            if fault.first == self.tick:
                fault.codes_before = self._last.copy()
                fault.restore = fault.fault.begin(self.plant.tables)
            elif fault.end == self.tick and fault.restore is not None:
                fault.restore()

    def _distorted(self, codes: Codes, outputs: Codes) -> tuple[Codes, Codes]:
        first = self.tick - len(codes)
        for fault in self._faults:
            if fault.first <= first < fault.end:
                seconds = (first - fault.first + np.arange(len(codes))) / self._rig.sample_rate
                fault.fault.distort(codes, fault.codes_before, seconds, self._rig, self._rng)
        if len(codes):
            self._last = codes[-1].copy()
        return codes, outputs
