"""A value on a bar between its limits, with its recent travel drawn thick."""

from __future__ import annotations

import math

from rig.tui.drawing.braille import scale_around


def bar(
    at: float,
    limits: tuple[float | None, float | None],
    travel: tuple[float, float] | None,
    reach: tuple[float, float],
    width: int,
    warnings: tuple[float | None, float | None] = (None, None),
) -> str:
    """Return a bar of `width` characters: ├ ┤ limits, ╎ warnings, ━ the travel, ● the value.

    The scale is slightly wider than `reach`. A value off the scale is drawn as ◀ or ▶ at its end;
    NaN is not drawn.
    """
    if width < 3:
        return " " * max(width, 0)
    scale = scale_around(reach)

    def cell(x: float) -> int:
        return width - 1 - int(scale.row(x, width))  # rows count from the top, cells from the left

    cells = ["─"] * width
    if travel is not None:
        for i in range(cell(travel[0]), cell(travel[1]) + 1):
            cells[i] = "━"
    for level in warnings:
        if level is not None and scale.low <= level <= scale.high:
            cells[cell(level)] = "╎"
    for level, mark in zip(limits, "├┤", strict=True):
        if level is not None:
            cells[cell(level)] = mark
    if not math.isnan(at):
        cells[cell(at)] = "◀" if at < scale.low else "▶" if at > scale.high else "●"
    return "".join(cells)
