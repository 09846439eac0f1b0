"""Curves as braille characters: two dot columns and four dot rows in every character cell.

A column of a curve is the range from its smallest to its largest sample, so that no spike is lost
at any number of samples per column. NaN is a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Dots = NDArray[np.bool_]

# Bit of each dot in U+2800 + bits, row by row (Unicode, "Braille Patterns").
_BITS: Final = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
_BLANK: Final = 0x2800
DASH: Final = 4  # a limit line has one dot column in four, unlike any curve


@dataclass(frozen=True)
class Scale:
    """The values of the lowest and of the highest dot row; low < high."""

    low: float
    high: float

    def row(self, value: Array | float, rows: int) -> NDArray[np.int64]:
        """Return the dot row (0 is the top) of values, those outside put on the edge."""
        share = (self.high - np.asarray(value, dtype=np.float64)) / (self.high - self.low)
        return np.rint(np.clip(share, 0.0, 1.0) * (rows - 1)).astype(np.int64)


def scale_around(values: Sequence[float | None]) -> Scale:
    """Return a scale that holds every finite value with a margin; never an empty one."""
    finite = [v for v in values if v is not None and np.isfinite(v)]
    if not finite:
        return Scale(0.0, 1.0)
    low, high = min(finite), max(finite)
    # A constant has a scale wide enough for float64 to separate its ends.
    pad = 0.05 * (high - low) or 0.05 * max(abs(low), abs(high)) or 1.0
    return Scale(low - pad, high + pad)


def decimate(
    time: Array, low: Array, high: Array, start: float, stop: float, columns: int
) -> tuple[Array, Array]:
    """Return (low, high), shape (columns,), of buckets over the time from `start` to `stop`.

    Bucket k spans time[k-1] to time[k] (rising) and has low[k] <= high[k] or NaN; a column without
    an end of a bucket takes the one that spans its centre, or NaN without samples.
    """
    out_low, out_high = np.full(columns, np.nan), np.full(columns, np.nan)
    if columns == 0 or len(time) == 0 or not stop > start:
        return out_low, out_high
    width = (stop - start) / columns
    first, last = np.searchsorted(time, [start, stop], side="right")
    if last > first:
        column = np.minimum(((time[first:last] - start) / width).astype(np.int64), columns - 1)
        edges = np.flatnonzero(np.diff(column, prepend=-1))
        out_low[column[edges]] = np.fmin.reduceat(low[first:last], edges)
        out_high[column[edges]] = np.fmax.reduceat(high[first:last], edges)
    empty = np.flatnonzero(np.isnan(out_low))
    span = np.searchsorted(time, start + (empty + 0.5) * width)
    inside = (span > 0) & (span < len(time))
    out_low[empty[inside]] = low[span[inside]]
    out_high[empty[inside]] = high[span[inside]]
    return out_low, out_high


def curve_dots(low: Array, high: Array, rows: int, scale: Scale) -> Dots:
    """Return the dots, shape (rows, columns), of a curve given by its range in every column.

    Neighbouring columns are joined where their ranges do not meet, a NaN column stays empty.
    """
    gap = np.isnan(low) | np.isnan(high)
    top = scale.row(np.where(gap, scale.high, high), rows)
    bottom = scale.row(np.where(gap, scale.high, low), rows)
    joined = ~(gap[1:] | gap[:-1])
    rising = joined & (bottom[1:] < top[:-1])
    falling = joined & (top[1:] > bottom[:-1])
    reach_down = np.where(rising, top[:-1] - 1, bottom[1:])
    reach_up = np.where(falling, bottom[:-1] + 1, top[1:])
    bottom, top = bottom.copy(), top.copy()
    bottom[1:], top[1:] = reach_down, reach_up
    row = np.arange(rows)[:, None]
    return np.asarray((row >= top) & (row <= bottom) & ~gap, dtype=np.bool_)


def level_dots(level: float, columns: int, rows: int, scale: Scale) -> Dots:
    """Return the dots, shape (rows, columns), of a dashed line; none when it is off the scale."""
    dots = np.zeros((rows, columns), dtype=np.bool_)
    if scale.low <= level <= scale.high:
        dots[int(scale.row(level, rows)), ::DASH] = True
    return dots


def to_text(dots: Dots) -> list[str]:
    """Return one string per four dot rows, one character per two dot columns.

    Raises ValueError when the dots do not fill whole characters.
    """
    rows, columns = dots.shape
    if rows % 4 or columns % 2:
        raise ValueError(f"{rows} x {columns} dots do not fill cells of 4 x 2")
    cells = dots.reshape(rows // 4, 4, columns // 2, 2).transpose(0, 2, 1, 3)
    codes = _BLANK + (cells * _BITS).sum(axis=(2, 3))
    return ["".join(map(chr, line)) for line in codes]


def to_cells(dots: Dots) -> Dots:
    """Return, shape (rows / 4, columns / 2), which characters hold a dot."""
    rows, columns = dots.shape
    cells = dots.reshape(rows // 4, 4, columns // 2, 2)
    return np.asarray(cells.any(axis=(1, 3)), dtype=np.bool_)
