"""The latest samples of a bench in one piece of memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_ROOM = 4  # times the rows to keep, so that they are rarely moved


class Recent:
    """At least the latest `keep` rows of (n, columns), and those added last."""

    def __init__(self, columns: int, keep: int) -> None:
        self._keep = keep
        self._rows: Array = np.empty((_ROOM * keep, columns))
        self._end = 0

    def forget(self) -> None:
        """Drop all rows."""
        self._end = 0

    def add(self, rows: Array) -> None:
        """Append rows (n, columns); views that `last` returned before are then invalid."""
        end = self._end + len(rows)
        if end > len(self._rows):
            retained = self.last(self._keep).copy()
            end = len(retained) + len(rows)
            if end > len(self._rows):
                self._rows = np.empty((_ROOM * end, self._rows.shape[1]))
            self._rows[: len(retained)] = retained
        self._rows[end - len(rows) : end] = rows
        self._end = end

    def last(self, count: int) -> Array:
        """Return a view of the last `count` rows, of fewer if there are no more."""
        return self._rows[max(0, self._end - count) : self._end]
