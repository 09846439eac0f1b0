"""A value on a bar between its limits, with the travel of the newest stretch drawn thick."""

from __future__ import annotations

import math
from typing import Final

from rich.text import Text

from rig.bench.screens.sockets import ChannelView
from rig.tui.braille import scale_around
from rig.tui.units import limit, shown
from rig.tui.words import OLD, value

LABEL: Final = 8  # characters of a gauge's name
NUMBER: Final = 9  # of its value and unit
LIMIT: Final = 3  # of a limit
LIMIT_STYLE: Final = "red"
MARKS: Final = {"├": "red", "┤": "red", "─": "grey30", "━": "grey58"}


def bar(
    at: float,
    limits: tuple[float | None, float | None],
    travel: tuple[float, float] | None,
    reach: tuple[float, float],
    width: int,
) -> str:
    """Return a bar of `width` characters: ├ ┤ the limits, ━ the travel, ● the value.

    The scale is `reach` and a little beyond. A value off the scale is drawn as ◀ or ▶ at its end;
    NaN is not drawn.
    """
    if width < 3:
        return " " * width
    scale = scale_around(reach)

    def cell(x: float) -> int:
        return width - 1 - int(scale.row(x, width))  # rows count from the top, cells from the left

    cells = ["─"] * width
    if travel is not None:
        for i in range(cell(travel[0]), cell(travel[1]) + 1):
            cells[i] = "━"
    for level, mark in zip(limits, "├┤", strict=True):
        if level is not None:
            cells[cell(level)] = mark
    if not math.isnan(at):
        cells[cell(at)] = "◀" if at < scale.low else "▶" if at > scale.high else "●"
    return "".join(cells)


def gauge(
    label: str,
    view: ChannelView,
    travel: tuple[float, float] | None,
    reach: tuple[float, float] | None,
    width: int,
    *,
    live: bool,
) -> Text:
    """Return a line of `width` characters: name, value, lower limit, bar, upper limit.

    The bar reaches over `reach`; without it the line ends in the travel as numbers.
    """
    how = shown(view.unit)
    limits = (limit(view.low), limit(view.high))
    line = Text(f"{label:<{LABEL}}", OLD)
    number = value(view, live=live, sign=True)
    line.append(" " * max(NUMBER - number.cell_len, 0)).append_text(number)
    if reach is None:
        # Nothing says how wide a bar ought to be: the travel in numbers is all there is to show.
        numbers = [how.number(end, sign=True) for end in travel or ()]
        return line.append(f"  {' … '.join(numbers)}", OLD)
    low, high = (f"{how.short(level):>{LIMIT}}" for level in limits)
    line.append(f" {low} ", LIMIT_STYLE)
    for mark in bar(view.last, limits, travel, reach, width - line.cell_len - len(high) - 1):
        line.append(mark, MARKS.get(mark, "bold cyan") if live else OLD)
    return line.append(f" {high.strip():<{LIMIT}}", LIMIT_STYLE)
