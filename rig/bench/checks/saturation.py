"""Sensors at an end of their converter's range: out of range, or broken."""

from __future__ import annotations

import numpy as np

from drivers.base import SampleBlock
from rig.bench.checks.bands import Counts, first_of, run_lengths
from rig.bench.checks.settings import GuardSettings
from rig.model import channels as ch
from rig.model.rig import Rig
from rig.model.trips import SATURATED, Violation

_VACUUM = -90e3  # no gauge pressure is far below this, so such a range cannot be exceeded


class Saturation:
    """Finds channels whose samples stay at an end of their range, across blocks."""

    def __init__(self, rig: Rig, settings: GuardSettings) -> None:
        self._rig = rig
        counts, middles = [], []
        for name in rig.channels:
            kind, _ = ch.kind_of(name)
            low, high = rig.sensors.of(kind).range
            vacuum = kind in (ch.CAP, ch.ROD) and low <= _VACUUM
            usual = settings.saturated_samples
            counts.append((usual, settings.saturated_samples_vacuum if vacuum else usual))
            middles.append((low + high) / 2)
        self._at_high, self._at_low = np.array(counts).T
        self._middles = np.array(middles)
        self.forget()

    def forget(self) -> None:
        """Reset: the next samples do not continue the previous ones."""
        self._runs: Counts = np.zeros(len(self._middles), dtype=np.int64)
        self._any = False  # a channel was at an end in the latest block

    def find(self, block: SampleBlock) -> list[Violation]:
        """Return the violation of the first channel too long at an end; empty if there is none."""
        if not np.count_nonzero(block.saturated):
            if self._any:
                self.forget()
            return []
        runs = run_lengths(block.saturated, self._runs)
        self._runs, self._any = runs[-1], True
        measured = block.data[:, : runs.shape[1]]
        over = runs >= np.where(measured > self._middles, self._at_high, self._at_low)
        if not over.any():
            return []
        row, column = first_of(over)
        name = self._rig.channels[column]
        kind, joint = ch.kind_of(name)
        ends = self._rig.sensors.of(kind).range
        value = float(measured[row, column])
        tick = block.tick + row
        return [Violation(SATURATED, value, ends, ch.unit_of(name), joint, name, tick)]
