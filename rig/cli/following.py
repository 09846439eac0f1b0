"""From a bench's blocks and record marks to a tracker: samples and records meet by tick."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from analysis.identify.streams.online import Tracker
from rig.model.records import RecordHead
from rig.model.rig import Rig

Array = NDArray[np.float64]

KEPT = 5.0  # [s] of samples kept from before a record is announced


class Follower:
    """Feeds a tracker with the samples of every record; gaps between blocks become NaN."""

    def __init__(self, rig: Rig, tracker: Tracker) -> None:
        self._tracker = tracker
        self._names = rig.recorded
        self._kept = round(KEPT * rig.sample_rate)
        self._recent: deque[tuple[int, Array]] = deque()
        self._next: int | None = None  # the tick due in the record that runs
        self._last: int | None = None  # the tick after its last, where known

    def block(self, tick: int, data: Array) -> bool:
        """Take a block (n, channels) from `tick`; says whether the estimates are new."""
        self._recent.append((tick, data))
        newest = tick + len(data)
        while self._recent[0][0] + len(self._recent[0][1]) < newest - self._kept:
            self._recent.popleft()
        return self._next is not None and self._feed(newest)

    def begins(self, head: RecordHead, start: int, ticks: int | None = None) -> None:
        """Begin a record at a tick; what is here of it already is fed.

        Blocks may reach beyond its end, so `ticks` must be given where it is fixed in advance.
        """
        self._tracker.begin(head)
        self._next, self._last = start, None if ticks is None else start + ticks
        if self._recent:
            tick, data = self._recent[-1]
            self._feed(tick + len(data))

    def ends(self, start: int, ticks: int, complete: bool) -> None:
        """End the record that runs after `ticks` samples; only a complete one counts."""
        if self._next is None:
            return
        self._last = start + ticks
        if complete and self._next <= self._last:
            self._feed(self._last)
            self._tracker.end()
        else:
            self._tracker.discard()
        self._next = None

    def _feed(self, last: int) -> bool:
        """Feed the ticks from the one due up to `last`, NaN where no block has them."""
        first = self._next
        last = last if self._last is None else min(last, self._last)
        if first is None or last <= first:
            return False
        part = np.full((last - first, len(self._names)), np.nan)
        for tick, data in self._recent:
            low, high = max(first, tick), min(last, tick + len(data))
            if low < high:
                part[low - first : high - first] = data[low - tick : high - tick]
        self._next = last
        return self._tracker.feed({name: part[:, k] for k, name in enumerate(self._names)})
