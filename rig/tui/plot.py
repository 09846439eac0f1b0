"""A live plot in braille: one channel over the newest stretch of device time, with its limits."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip
from textual.widget import Widget

from rig.tui import braille
from rig.tui.units import Shown

Array = NDArray[np.float64]

GUTTER: Final = 6  # characters left of the curve: a limit's number and the axis
LEAST_ZOOM: Final = 0.04  # of the range between the limits
AXIS: Final = Style(color="grey50")
LIMIT: Final = Style(color="red", bold=True)
LIMIT_LINE: Final = Style(color="red")
BEYOND: Final = Style(color="bright_white", bgcolor="red", bold=True)
OLD: Final = Style(color="grey42")


@dataclass(frozen=True)
class PlotTrace:
    """What a plot draws: buckets in SI (see `braille.decimate`), limits [SI], how to show it."""

    time: Array
    low: Array
    high: Array
    start: float
    stop: float
    limits: tuple[float | None, float | None]
    shown: Shown
    colour: str
    live: bool = True
    zoomed: bool = False

    def scale(self) -> braille.Scale:
        """Return the vertical scale: the limits (wider if passed), or the data when zoomed."""
        recent = (self.time > self.start) & ~np.isnan(self.low)
        if not recent.any():
            return braille.scale_around(self.limits)
        low, high = float(self.low[recent].min()), float(self.high[recent].max())
        return (
            self._zoomed(low, high)
            if self.zoomed
            else braille.scale_around([*self.limits, low, high])
        )

    def _zoomed(self, low: float, high: float) -> braille.Scale:
        # Noise alone must not fill the plot and look like a motion.
        bottom, top = self.limits
        least = 0.0 if bottom is None or top is None else LEAST_ZOOM * (top - bottom)
        spare = max(least - (high - low), 0.0) / 2
        return braille.scale_around([low - spare, high + spare])


def draw(trace: PlotTrace, width: int, height: int) -> list[Strip]:
    """Return `height` strips of `width` characters: axis with the limits' numbers, then curve."""
    columns = max(width - GUTTER, 0)
    scale = trace.scale()
    low, high = braille.decimate(
        trace.time, trace.low, trace.high, trace.start, trace.stop, 2 * columns
    )
    curve = braille.curve_dots(low, high, 4 * height, scale)
    dots = curve.copy()
    for level in trace.limits:
        if level is not None:
            dots |= braille.level_dots(level, 2 * columns, 4 * height, scale)
    beyond = _beyond(low, high, trace.limits)
    # 0 limit line or blank, 1 curve, 2 curve beyond a limit
    kinds = braille.to_cells(curve).astype(np.int64) * (1 + beyond)
    styles = (
        LIMIT_LINE,
        Style(color=trace.colour) if trace.live else OLD,
        BEYOND,  # also when old: it is what a tripped run is looked at for
    )
    axis = _axis(trace, scale, height)
    return [
        Strip([*axis[i], *_runs(text, kinds[i], styles)], width)
        for i, text in enumerate(braille.to_text(dots))
    ]


def _beyond(low: Array, high: Array, limits: tuple[float | None, float | None]) -> NDArray[np.int_]:
    """Return, per character, 1 where the curve passes a limit (NaN never does)."""
    bottom = -np.inf if limits[0] is None else limits[0]
    top = np.inf if limits[1] is None else limits[1]
    columns = (low < bottom) | (high > top)
    return np.asarray(columns.reshape(-1, 2).any(axis=1), dtype=np.int_)


def _axis(trace: PlotTrace, scale: braille.Scale, height: int) -> list[list[Segment]]:
    """Return the gutter, line by line: numbers of limits on the scale, else of the scale's ends."""
    labels: dict[int, tuple[str, Style]] = {}
    if trace.zoomed:
        labels[height - 1] = (trace.shown.short(scale.low), AXIS)
        labels[0] = (trace.shown.short(scale.high), AXIS)
    for level in trace.limits:
        if level is not None and scale.low <= level <= scale.high:
            labels[int(scale.row(level, 4 * height)) // 4] = (trace.shown.short(level), LIMIT)
    lines = []
    for row in range(height):
        text, style = labels.get(row, ("", AXIS))
        tick = "┤" if text else "│"
        lines.append([Segment(f"{text:>{GUTTER - 1}}"[: GUTTER - 1], style), Segment(tick, AXIS)])
    return lines


def _runs(text: str, kinds: NDArray[np.int64], styles: tuple[Style, ...]) -> list[Segment]:
    """Cut a line into segments of one style each."""
    cuts = [0, *(np.flatnonzero(np.diff(kinds)) + 1).tolist(), len(text)]
    return [Segment(text[a:b], styles[kinds[a]]) for a, b in pairwise(cuts) if b > a]


class LivePlot(Widget):
    """The widget around `draw`; it draws a trace once per change of the trace or its size."""

    DEFAULT_CSS = "LivePlot { height: 1fr; min-height: 2; }"

    def __init__(self, id: str | None = None) -> None:
        super().__init__(id=id)
        self._trace: PlotTrace | None = None
        self._strips: list[Strip] = []
        self._drawn: tuple[int, int] | None = None

    def show(self, trace: PlotTrace) -> None:
        """Draw this trace from now on."""
        self._trace, self._drawn = trace, None
        self.refresh()

    def render_line(self, y: int) -> Strip:
        """Return one line of the plot."""
        size = (self.size.width, self.size.height)
        if self._drawn != size and self._trace is not None:
            ground = self.rich_style
            self._strips = [strip.apply_style(ground) for strip in draw(self._trace, *size)]
            self._drawn = size
        return self._strips[y] if y < len(self._strips) else Strip.blank(size[0], self.rich_style)
