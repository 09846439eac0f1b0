"""A line with a channel's name, value and bar between its limits."""

from __future__ import annotations

from itertools import groupby
from typing import Final

from rig.bench.screens.sockets import ChannelView
from rig.tui.drawing.bar import bar
from rig.tui.drawing.rows import Row, fit, width_of
from rig.tui.drawing.styles import DIM, STRONG, TRIP_LINE, WARN_LINE
from rig.tui.units import limit, shown
from rig.tui.words import Freshness, value

LABEL: Final = 8  # characters of a gauge's name
NUMBER: Final = 9  # of its value and unit
LIMIT: Final = 3  # of a limit
MARKS: Final = {"├": TRIP_LINE, "┤": TRIP_LINE, "╎": WARN_LINE, "─": DIM, "━": DIM}


def gauge(
    label: str,
    view: ChannelView,
    travel: tuple[float, float] | None,
    reach: tuple[float, float] | None,
    width: int,
    fresh: Freshness,
) -> Row:
    """Return a row of `width` characters: name, value, lower limit, bar, upper limit.

    The bar covers `reach`; without it the line ends in the travel as numbers.
    """
    how = shown(view.unit)
    limits = (limit(view.low), limit(view.high))
    number = value(view, fresh, sign=how.signed)
    space = (" " * max(NUMBER - width_of(number), 0), "")
    line: Row = ((f"{label:<{LABEL}}", DIM), space, *number)
    if reach is None:
        # The range of a bar is unknown: show the travel in numbers.
        numbers = [how.number(end, sign=how.signed) for end in travel or ()]
        return fit((*line, (f"  {' … '.join(numbers)}", DIM)), width)
    low, high = (f"{how.short(level):>{LIMIT}}" for level in limits)
    line = (*line, (f" {low} ", DIM))
    room = width - width_of(line) - max(LIMIT, len(high.strip())) - 1
    warnings = (limit(view.warn_low), limit(view.warn_high))
    drawn = bar(view.last, limits, travel, reach, room, warnings)
    live = fresh is Freshness.LIVE
    styled = groupby(drawn, lambda mark: MARKS.get(mark, STRONG) if live else DIM)
    marks = tuple(("".join(group), style) for style, group in styled)
    return fit((*line, *marks, (f" {high.strip():<{LIMIT}}", DIM)), width)
