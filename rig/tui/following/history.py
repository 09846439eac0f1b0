"""History of the screen: one numpy ring of buckets for all channels of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.bench.screens.snapshot import PastMinute
from rig.bench.screens.sockets import ChannelView, Snapshot
from rig.tui.units import limit

Array = NDArray[np.float64]

BUCKETS: Final = 8  # kept of one snapshot: at 20 a second finer than the screen's resolution
CAPACITY: Final = 16384  # buckets: 100 s at 20 snapshots a second


@dataclass(frozen=True)
class HistoryWindow:
    """The newest part of a run, read-only: bucket ends `time` (n,) [s] of device time.

    `low` and `high`, shape (n, channels), are the buckets' smallest and largest samples in SI;
    `reach` is the widest range of each channel's limits in this run.
    """

    time: Array
    low: Array
    high: Array
    columns: Mapping[str, int]
    reach: Mapping[str, tuple[float, float]]

    def of(self, channel: str) -> tuple[Array, Array]:
        """Return (low, high), each (n,), of a channel; NaN throughout for an unknown one."""
        at = self.columns.get(channel)
        if at is None:
            no_values = np.full(len(self.time), np.nan)
            return no_values, no_values
        return self.low[:, at], self.high[:, at]

    def span(self, channel: str, since: float) -> tuple[float, float] | None:
        """Return the channel's (smallest, largest) from device time `since`; None if none."""
        at = self.columns.get(channel)
        first = int(np.searchsorted(self.time, since, side="right"))
        if at is None or first == len(self.time):
            return None
        smallest = float(np.fmin.reduce(self.low[first:, at]))
        largest = float(np.fmax.reduce(self.high[first:, at]))
        return None if np.isnan(smallest) else (smallest, largest)


EMPTY: Final = HistoryWindow(np.empty(0), np.empty((0, 0)), np.empty((0, 0)), {}, {})


def regroup(minimum: Array, maximum: Array, count: int) -> tuple[Array, Array]:
    """Return (low, high), shape (count,), of buckets min/max-decimated (or repeated) to `count`.

    No buckets at all give NaN.
    """
    n = len(minimum)
    if n == 0:
        return np.full(count, np.nan), np.full(count, np.nan)
    # Of equal edges, `reduceat` takes the bucket at the edge.
    edges = np.arange(count) * n // count
    return np.fmin.reduceat(minimum, edges), np.fmax.reduceat(maximum, edges)


class History:
    """A ring of buckets filled from snapshots; cleared at a new run or set of channels."""

    def __init__(self, capacity: int = CAPACITY) -> None:
        self._capacity = capacity
        self._key: tuple[object, ...] = ()
        self._clear(())

    def _clear(self, names: tuple[str, ...]) -> None:
        self._columns = {name: i for i, name in enumerate(names)}
        self._reach: dict[str, tuple[float, float]] = {}
        self._time = np.empty(self._capacity)
        self._values = np.empty((2, self._capacity, len(names)))
        self._count = 0  # buckets written in all; the ring holds the newest `capacity` of them
        self._last = -np.inf  # device time of the newest bucket [s]

    def add(self, snapshot: Snapshot, *, after_gap: bool = False) -> None:
        """Add a snapshot's buckets; `after_gap` states that earlier ones did not arrive.

        The first snapshot of a run, or one after a gap, does not state the time span of its
        buckets: they become one bucket at the snapshot's time.
        """
        names = tuple(snapshot.channels)
        key = (snapshot.run, snapshot.pid, names)
        if key != self._key or snapshot.device_time < self._last:
            self._key = key
            self._clear(names)
        if snapshot.device_time <= self._last or not names:
            return
        self._reach = _widened(self._reach, snapshot)
        without_start = self._count == 0 or after_gap
        buckets = 1 if without_start else BUCKETS
        if after_gap and self._count:
            no_values = np.full((2, 1, len(names)), np.nan)
            self._write(np.array([np.nextafter(snapshot.device_time, -np.inf)]), no_values)
        start = snapshot.device_time if without_start else self._last
        ends = start + (snapshot.device_time - start) * np.arange(1, buckets + 1) / buckets
        self._write(ends, _stack([snapshot.channels[name] for name in names], buckets))
        self._last = snapshot.device_time

    def begin_with(self, past: PastMinute) -> bool:
        """Fill the ring with the run's own history; False if that has other channels."""
        if set(past.names) != set(self._columns) or not len(past.time):
            return False
        reach = self._reach
        self._clear(tuple(past.names))
        self._reach, self._key = reach, (*self._key[:2], tuple(past.names))
        self._write(past.time, np.array((past.low, past.high)))
        self._last = float(past.time[-1])
        return True

    def _write(self, ends: Array, values: Array) -> None:
        at = (self._count + np.arange(len(ends))) % self._capacity
        self._time[at] = ends
        self._values[:, at] = values
        self._count += len(ends)

    def window(self, seconds: float) -> HistoryWindow:
        """Return a copy of the newest `seconds` of device time (and the bucket before them)."""
        count = min(self._count, self._capacity)
        order = (self._count - count + np.arange(count)) % self._capacity
        time = self._time[order]
        first = max(int(np.searchsorted(time, self._last - seconds)) - 1, 0)
        order = order[first:]
        low, high = self._values[0, order], self._values[1, order]
        for array in (time, low, high):
            array.flags.writeable = False
        return HistoryWindow(time[first:], low, high, self._columns, self._reach)


def _stack(views: list[ChannelView], count: int) -> Array:
    """Return, shape (2, count, channels), the lows and highs of a snapshot's channels."""
    pairs = [
        regroup(
            np.asarray(view.minimum, dtype=np.float64),
            np.asarray(view.maximum, dtype=np.float64),
            count,
        )
        for view in views
    ]
    return np.array(pairs).transpose(1, 2, 0)


def _widened(
    reach: Mapping[str, tuple[float, float]], snapshot: Snapshot
) -> dict[str, tuple[float, float]]:
    """Return a new `reach` that includes the limits of this snapshot.

    A piston's limits narrow while its joint is locked; its stroke is then that of before.
    """
    wider = dict(reach)
    for name, view in snapshot.channels.items():
        low, high = limit(view.low), limit(view.high)
        if low is not None and high is not None:
            widest = wider.get(name, (low, high))
            wider[name] = (min(low, widest[0]), max(high, widest[1]))
    return wider
