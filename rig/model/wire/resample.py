"""Linear interpolation of unevenly timed samples onto the grid of ticks.

Times are in sample periods since tick 0: tick k is at k. The value at tick k between two samples
(t0, x0) and (t1, x1), t0 < k <= t1, is x(k) = x0 + (k - t0) / (t1 - t0) (x1 - x0), as long as t1 -
t0 <= LONGEST. Ticks between samples that are further apart are missing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Marks = NDArray[np.bool_]

LONGEST: Final = 1.5  # [periods] between two samples that may still be interpolated
_SNAP: Final = 1e-6  # [periods] within which a sample counts as taken at its tick


@dataclass(frozen=True)
class Row:
    """One tick of the grid: values in SI, and flags of saturated samples used for it."""

    tick: int
    values: Array
    saturated: Marks


class Resampler:
    """Interpolates samples in the order of their time; `missing` counts ticks left out."""

    def __init__(self) -> None:
        self.missing = 0
        self._at: float | None = None
        self._values: Array = np.empty(0)
        self._saturated: Marks = np.empty(0, dtype=np.bool_)

    def restart(self) -> None:
        """Drop the last sample: the next one does not continue it, and no tick is missing."""
        self._at = None

    def add(self, at: float, values: Array, saturated: Marks) -> list[Row]:
        """Return the ticks that a sample taken at time `at` [periods] completes, in order.

        Raises ValueError for a sample that is not later than the one before.
        """
        nearest = round(at)
        if abs(at - nearest) <= _SNAP:
            at = float(nearest)
        before, first, marks = self._at, self._values, self._saturated
        if before is not None and not at > before:
            raise ValueError(f"a sample at {at} periods follows one at {before}")
        self._at, self._values, self._saturated = at, values, saturated
        if before is None or at - before > LONGEST:
            exact = at == nearest
            if before is not None:
                self.missing += math.floor(at) - math.floor(before) - exact
            return [Row(nearest, values, saturated)] if exact else []
        rows = []
        with np.errstate(invalid="ignore"):  # NaN remains NaN
            for tick in range(math.floor(before) + 1, math.floor(at) + 1):
                part = (tick - before) / (at - before)
                between = values if part == 1.0 else first + part * (values - first)
                rows.append(Row(tick, between, saturated if part == 1.0 else marks | saturated))
        return rows
