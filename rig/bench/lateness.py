"""Lateness of blocks, and of the samples of a host-timed device."""

from __future__ import annotations

import numpy as np

from drivers.base import SampleBlock
from rig.bench.settings import BENCH


class ArrivalClock:
    """Lateness relative to the earliest arrival: late = arrival - device time - least offset."""

    def __init__(self, sample_rate: float) -> None:
        self._sample_rate = sample_rate
        self._best: float | None = None
        self._last = 0.0

    def late(self, block: SampleBlock, now: float) -> float:
        """Return the lateness [s] of a block that arrived at host time `now` [s]; first one: 0."""
        offset = now - (block.tick + len(block.data)) / self._sample_rate
        if self._best is None:
            self._best, self._last = offset, now
        self._best = min(offset, self._best + BENCH.clock_drift * (now - self._last))
        self._last = now
        return offset - self._best


class HostTiming:
    """Counts late and missing samples of a host-timed device, by `SampleBlock.read_at`."""

    def __init__(self, sample_rate: float) -> None:
        self._sample_rate = sample_rate
        self._samples = self._late = self._interpolated = 0
        self._worst = 0.0

    def add(self, block: SampleBlock) -> None:
        """Add a block; blocks of a device with its own clock are ignored."""
        if block.read_at is None:
            return
        nominal = (block.tick + np.arange(len(block.data))) / self._sample_rate
        late = block.read_at - nominal
        measured = np.isfinite(late)
        self._samples += len(late)
        self._interpolated += int(np.count_nonzero(~measured))
        self._late += int(np.count_nonzero(late[measured] > BENCH.late_share / self._sample_rate))
        self._worst = max(self._worst, float(late[measured].max(initial=0.0)))

    def summary(self) -> dict[str, float] | None:
        """Return the counts and the largest lateness [s]; None for a device with its own clock."""
        if not self._samples:
            return None
        return {
            "samples": self._samples,
            "late": self._late,
            "interpolated": self._interpolated,
            "worst_late_s": self._worst,
        }
