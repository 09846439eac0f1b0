"""A live plot in braille: one channel over recent device time, with its bands."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rig.tui.drawing import braille
from rig.tui.drawing.braille import Array
from rig.tui.drawing.rows import Part, Row, fitted, row
from rig.tui.drawing.styles import ALARM, DIM, PLAIN, TRIP_LINE, WARN_LINE
from rig.tui.units import Format

Band = tuple[float | None, float | None]

GUTTER: Final = 7  # characters left of the curve: a limit's number and the axis
LEAST_ZOOM: Final = 0.04  # of the range between the limits
TICK: Final = 20  # least characters between two numbers of the time axis
_STEPS: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 30.0, 60.0, 120.0, 300.0)
_BEYOND: Final = 4  # the kind of a cell whose curve is beyond a limit
_WIDE: Final = 5  # a warning's line is on for one dot column in so many characters


@dataclass(frozen=True)
class PlotTrace:
    """Data of a plot: buckets in SI (see `braille.decimate`), bands [SI], display.

    `time`, `start` and `stop` are device times [s]; values beyond `limits` trip, beyond `warnings`
    warn.
    """

    time: Array
    low: Array
    high: Array
    start: float
    stop: float
    limits: Band
    shown: Format
    live: bool = True
    zoomed: bool = False
    warnings: Band = (None, None)

    def scale(self) -> braille.Scale:
        """Return the vertical scale: the limits (wider if passed), or the data when zoomed."""
        recent = (self.time > self.start) & ~np.isnan(self.low)
        if not recent.any():
            return braille.scale_around(self.limits)
        low, high = float(self.low[recent].min()), float(self.high[recent].max())
        if self.zoomed or all(end is None for end in self.limits):
            return self._zoomed(low, high)
        return braille.scale_around([*self.limits, low, high])

    def _zoomed(self, low: float, high: float) -> braille.Scale:
        # Noise alone must not fill the plot and look like a motion.
        bottom, top = self.limits
        least = self.shown.least if bottom is None or top is None else LEAST_ZOOM * (top - bottom)
        padding = max(least - (high - low), 0.0) / 2
        return braille.scale_around([low - padding, high + padding])


def draw(trace: PlotTrace, width: int, height: int) -> list[Row]:
    """Return `height` rows of `width` characters: axis with the limits' numbers, then curve."""
    columns = max(width - GUTTER, 0)
    if height <= 0:
        return []
    scale = trace.scale()
    low, high = braille.decimate(
        trace.time, trace.low, trace.high, trace.start, trace.stop, 2 * columns
    )
    curve = braille.curve_dots(low, high, 4 * height, scale)
    lines, kinds = _lines(trace.limits, trace.warnings, columns, height, scale)
    cells = braille.to_cells(curve)
    kinds = kinds.copy()
    kinds[cells] = (3 + np.broadcast_to(_beyond(low, high, trace.limits), cells.shape))[cells]
    if columns:  # a blank takes the preceding style, so that fewer parts are sent to the terminal
        last_drawn = np.maximum.accumulate(np.where(kinds > 0, np.arange(columns), 0), axis=1)
        spread = np.take_along_axis(kinds, last_drawn, axis=1)
        kinds = np.where((kinds == 0) & (spread < _BEYOND), spread, kinds)
    # Values beyond a limit are marked even when old: they explain a trip.
    styles = (DIM, WARN_LINE, TRIP_LINE, PLAIN if trace.live else DIM, ALARM)
    axis = _axis(trace.limits, trace.warnings, trace.zoomed, trace.shown, scale, height)
    return [
        fitted((*axis[i], *_runs(text, kinds[i], styles)), GUTTER + columns)
        for i, text in enumerate(braille.to_text(curve | lines))
    ]


def time_axis(start: float, stop: float, width: int) -> Row:
    """Return the row below a plot of `width` characters: times [s] counted back from its end."""
    columns = width - GUTTER
    span = stop - start
    if columns < TICK or span <= 0:
        return row((" " * max(width, 0), DIM))
    step = next((s for s in _STEPS if s / span * columns >= TICK), _STEPS[-1])
    cells = [" "] * width
    count = int(span / step + 1e-9)
    for k in range(count + 1):
        at = GUTTER + round(columns * (1.0 - k * step / span))
        text = "now" if k == 0 else f"−{k * step:g} s"
        first = min(max(at - len(text) // 2, GUTTER), width - len(text))
        cells[first : first + len(text)] = text
    return row(("".join(cells), DIM))


@lru_cache(maxsize=64)
def _lines(
    limits: Band, warnings: Band, columns: int, height: int, scale: braille.Scale
) -> tuple[braille.Dots, NDArray[np.int64]]:
    """Return the dots of all lines, and of each character which kind of line it has.

    0 nothing, 1 line of a warning, 2 of a trip; a curve is 3, and 4 beyond a limit.
    """
    dots = [np.zeros((4 * height, 2 * columns), dtype=np.bool_) for _ in range(2)]
    for k, level in [*((0, w) for w in warnings), *((1, t) for t in limits)]:
        if level is not None:
            dots[k] |= braille.level_dots(level, 2 * columns, 4 * height, scale)
    warn, trip = dots
    warn[:, np.arange(2 * columns) % (2 * _WIDE) != 0] = False
    kinds = braille.to_cells(warn).astype(np.int64)
    kinds[braille.to_cells(trip)] = 2
    all_dots = warn | trip
    all_dots.flags.writeable = kinds.flags.writeable = False  # cached for the next pictures
    return all_dots, kinds


def _beyond(low: Array, high: Array, limits: Band) -> NDArray[np.int_]:
    """Return, per character, 1 where the curve passes a limit (NaN never does)."""
    bottom = -np.inf if limits[0] is None else limits[0]
    top = np.inf if limits[1] is None else limits[1]
    columns = (low < bottom) | (high > top)
    return np.asarray(columns.reshape(-1, 2).any(axis=1), dtype=np.int_)


@lru_cache(maxsize=64)
def _axis(
    limits: Band, warnings: Band, zoomed: bool, display: Format, scale: braille.Scale, height: int
) -> tuple[tuple[Part, ...], ...]:
    """Return the axis labels, line by line: limits on the scale, else the scale's ends."""
    labels: dict[int, Part] = {}
    marks = (*limits, *warnings)
    if zoomed or not any(m is not None and scale.low <= m <= scale.high for m in marks):
        labels[height - 1] = (display.short(scale.low, GUTTER - 1), DIM)
        labels[0] = (display.short(scale.high, GUTTER - 1), DIM)
    for levels, style in ((warnings, WARN_LINE), (limits, TRIP_LINE)):
        for level in levels:
            if level is not None and scale.low <= level <= scale.high:
                at = int(scale.row(level, 4 * height)) // 4
                labels[at] = (display.short(level, GUTTER - 1), style)
    lines: list[tuple[Part, ...]] = []
    for k in range(height):
        text, style = labels.get(k, ("", DIM))
        tick = "┤" if text else "│"
        lines.append(((f"{text:>{GUTTER - 1}}", style), (tick, DIM)))
    return tuple(lines)


def _runs(text: str, kinds: NDArray[np.int64], styles: tuple[str, ...]) -> tuple[Part, ...]:
    """Cut a line into parts of one style each."""
    cuts = [0, *(np.flatnonzero(np.diff(kinds)) + 1).tolist(), len(text)]
    return tuple((text[a:b], styles[kinds[a]]) for a, b in pairwise(cuts) if b > a)
