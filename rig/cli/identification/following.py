"""Feeds a tracker with the samples of records, matched to a bench's blocks by tick."""

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
        self._next: int | None = None  # first tick of the current record not yet fed
        self._last: int | None = None  # end of the current record, exclusive, if known

    def block(self, tick: int, data: Array) -> bool:
        """Take a block (n, channels) from `tick` on; return whether the estimates have changed."""
        self._recent.append((tick, data))
        newest = tick + len(data)
        while self._recent[0][0] + len(self._recent[0][1]) < newest - self._kept:
            self._recent.popleft()
        return self._next is not None and self._feed(newest)

    def begins(self, head: RecordHead, start: int, ticks: int | None = None) -> None:
        """Begin a record at tick `start`; feed its samples that have arrived already.

        Give the length `ticks` if it is fixed in advance, because blocks may reach beyond the end.
        """
        self._tracker.begin(head)
        self._next, self._last = start, None if ticks is None else start + ticks
        if self._recent:
            tick, data = self._recent[-1]
            self._feed(tick + len(data))

    def ends(self, start: int, ticks: int, complete: bool) -> None:
        """End the current record after `ticks` samples; discard it if it is not complete."""
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
        """Feed the samples from the next tick up to `last`; NaN for missing samples."""
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
