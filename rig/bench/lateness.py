"""How late blocks come: their arrival on the host's clock against their own device time."""

from __future__ import annotations

from drivers.base import SampleBlock

# A crystal's error either way, doubled: the earliest arrival so far may age by as much.
_DRIFT = 200e-6


class ArrivalClock:
    """Lateness against the earliest arrival seen: late = arrival - device time - best offset."""

    def __init__(self, sample_rate: float) -> None:
        self._sample_rate = sample_rate
        self._best: float | None = None
        self._last = 0.0

    def late(self, block: SampleBlock, now: float) -> float:
        """Return how late [s] a block came at host time `now` [s]; the first one defines zero."""
        offset = now - (block.tick + len(block.data)) / self._sample_rate
        if self._best is None:
            self._best, self._last = offset, now
        self._best = min(offset, self._best + _DRIFT * (now - self._last))
        self._last = now
        return offset - self._best
