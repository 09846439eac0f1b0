"""Parts of several pages: a joint, a channel's curve, the bars of the bench."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Final

from rig.bench.screens.sockets import ChannelView, Snapshot
from rig.model import channels as ch
from rig.tui.drawing.braille import scale_around
from rig.tui.drawing.plot import PlotTrace, draw, time_axis
from rig.tui.drawing.rows import Row, block, box, fit, hstack, row, width_of, window
from rig.tui.drawing.styles import DIM, STRONG, TRIP_LINE, WARN_LINE, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.units import limit, shown
from rig.tui.words import Freshness, role_of, value

_JOINT_CHANNEL = re.compile(r"^.+_(?P<joint>[1-9]\d*)$")
NAMES: Final = {ch.CAP: "cap", ch.ROD: "rod", ch.SUPPLY: "supply", ch.TEMPERATURE: "oil"}
# Drawn as curves in this order, as many as fit; all are gauges as well.
CURVES: Final = (ch.CAP, ch.ROD, ch.PISTON, ch.COMMAND, ch.SPOOL, ch.POSITION, ch.DRIVE)
GAUGES: Final = (ch.CAP, ch.ROD, ch.PISTON, ch.SPOOL, ch.COMMAND, ch.POSITION, ch.DRIVE)
CURVE_HEIGHT: Final = 4  # least rows of a curve with its words
WIDTH: Final = 38  # least columns of a joint
WIDE: Final = 110  # from this width on, details and curves are beside each other
ROLES: Final = {"locked": "▣ locked", "excited": "≈ excited", "free": "○ free"}

LABEL: Final = 8  # characters of a gauge's name
NUMBER: Final = 9  # of its value and unit
LIMIT: Final = 3  # of a limit
MARKS: Final = {"├": TRIP_LINE, "┤": TRIP_LINE, "╎": WARN_LINE, "─": DIM, "━": DIM}


def list_with_detail(
    rows: list[Row], at: int, detail: Callable[[int, int], list[Row]], width: int, height: int,
    above: int,
) -> list[Row]:  # fmt: skip
    """Return a list with row `at` marked and `detail(width, height)` beside or below it.

    It is below the list's `above` rows on a screen that is not `WIDE`.
    """
    if width >= WIDE:
        left = width * 2 // 5
        right = width - left - 1
        return hstack([(window(rows, at, height), left), (detail(right, height), right)], height)
    shown = block(window(rows, at, above), width, above)
    return block([*shown, *detail(width, height - above)], width, height)


def joints_in(channels: Iterable[str]) -> list[int]:
    """Return the numbers of the joints with a channel, in order."""
    matches = map(_JOINT_CHANNEL.match, channels)
    return sorted({int(match["joint"]) for match in matches if match is not None})


def short_name(kind: str) -> str:
    """Return the name of a kind of channel, short enough for a gauge."""
    return NAMES.get(kind, kind)


def freshness_label(view: PlotView) -> str:
    """Return the label of a picture that is not live, '' for a live one."""
    return {
        Freshness.LIVE: "",
        Freshness.ENDED: "last picture",
        Freshness.HELD: "held",
        Freshness.STALE: "STALE",
        Freshness.DISCONNECTED: "DISCONNECTED",
    }[view.fresh]


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
    form = shown(view.unit)
    limits = (limit(view.low), limit(view.high))
    number = value(view, fresh, sign=form.signed)
    space = (" " * max(NUMBER - width_of(number), 0), "")
    line: Row = ((f"{label:<{LABEL}}", DIM), space, *number)
    if reach is None:
        # The range of a bar is unknown: show the travel in numbers.
        numbers = [form.number(end, sign=form.signed) for end in travel or ()]
        return fit((*line, (f"  {' … '.join(numbers)}", DIM)), width)
    low, high = (f"{form.short(level):>{LIMIT}}" for level in limits)
    line = (*line, (f" {low} ", DIM))
    room = width - width_of(line) - max(LIMIT, len(high.strip())) - 1
    warnings = (limit(view.warn_low), limit(view.warn_high))
    drawn = bar(view.last, limits, travel, reach, room, warnings)
    live = fresh is Freshness.LIVE
    styled = groupby(drawn, lambda mark: MARKS.get(mark, STRONG) if live else DIM)
    marks = tuple(("".join(group), style) for style, group in styled)
    return fit((*line, *marks, (f" {high.strip():<{LIMIT}}", DIM)), width)


def bar_of(view: PlotView, name: str, label: str, width: int) -> Row:
    """Return a channel as a bar between its limits."""
    snapshot, window = view.frame.snapshot, view.frame.window
    assert snapshot is not None
    since = view.frame.device_time - view.look.seconds
    channel = snapshot.channels[name]
    reach = window.reach.get(name) or _warned(snapshot, name)
    return gauge(label, channel, window.span(name, since), reach, width, view.fresh)


def _warned(snapshot: Snapshot, name: str) -> tuple[float, float] | None:
    """Return the range of a bar whose channel has warnings but no limits."""
    view = snapshot.channels[name]
    low, high = limit(view.warn_low), limit(view.warn_high)
    if low is None or high is None or not high > low:
        return None
    margin = 0.5 * (high - low)
    return low - margin, high + margin


def curve(
    view: PlotView, name: str, label: str, width: int, height: int, *, axis: bool
) -> list[Row]:
    """Return a channel in words and as a plot of `height` rows in all."""
    snapshot, window = view.frame.snapshot, view.frame.window
    assert snapshot is not None
    channel = snapshot.channels[name]
    form = shown(channel.unit)
    stop = view.frame.device_time
    start = stop - view.look.seconds
    line: Row = ((f"{label:<9}", STRONG), *value(channel, view.fresh, sign=form.signed))
    span = window.span(name, start)
    if span is not None:
        numbers = " … ".join(form.number(end, sign=form.signed) for end in span)
        line = (*line, (f"   {numbers}", DIM))
    low, high = window.of(name)
    trace = PlotTrace(
        window.time,
        low,
        high,
        start,
        stop,
        (limit(channel.low), limit(channel.high)),
        form,
        view.fresh is Freshness.LIVE,
        view.look.zoomed,
        (limit(channel.warn_low), limit(channel.warn_high)),
    )
    rows = [fit(line, width), *draw(trace, width, height - 1 - axis)]
    return [*rows, time_axis(start, stop, width)] if axis else rows


def curves(view: PlotView, names: dict[str, str], width: int, height: int) -> list[Row]:
    """Return as many of the channels ({name: label}) as curves as fit."""
    count = min(len(names), height // CURVE_HEIGHT)
    axis = height > CURVE_HEIGHT * count
    rows: list[Row] = []
    for k, (name, label) in enumerate(list(names.items())[:count]):
        remaining = height - len(rows)
        rows_each = remaining // (count - k) if k < count - 1 else remaining
        rows += curve(view, name, label, width, rows_each, axis=axis and k == count - 1)
    return rows


def joint_title(view: PlotView, joint: int, note: str = "") -> str:
    """Return a joint's name with its present activity, a note, and the label of its picture."""
    snapshot = view.frame.snapshot
    role = ROLES.get(role_of(snapshot, joint), "") if snapshot is not None else ""
    title = f"joint {joint} {role}".rstrip() + note
    label = freshness_label(view)
    return f"{title} · {label}" if label else title


def joint_channels(view: PlotView, joint: int, width: int) -> tuple[list[Row], dict[str, str]]:
    """Return a bar for each channel of a joint, and {channel: short name} of its curves."""
    snapshot = view.frame.snapshot
    assert snapshot is not None
    names = {kind: ch.channel(kind, joint) for kind in GAUGES}
    names = {kind: name for kind, name in names.items() if name in snapshot.channels}
    bars = [bar_of(view, name, short_name(kind), width) for kind, name in names.items()]
    return bars, {names[kind]: short_name(kind) for kind in CURVES if kind in names}


def joint_box(view: PlotView, joint: int, width: int, height: int) -> list[Row]:
    """Return one joint in a frame: curves if there is room, bars always."""
    style = WARN_TEXT if view.fresh in (Freshness.STALE, Freshness.DISCONNECTED) else DIM
    inner = width - 4
    bars, names = joint_channels(view, joint, inner)
    above = curves(view, names, inner, height - 2 - len(bars))
    title, note = joint_title(view, joint), f"last {view.look.seconds:g} s"
    return box(title, [*above, *bars], width, height, style, note)


def bench_bars(view: PlotView, width: int) -> list[Row]:
    """Return supply pressure and oil temperature as bars, side by side if there is room."""
    snapshot = view.frame.snapshot
    assert snapshot is not None
    names = [name for name in (ch.SUPPLY, ch.TEMPERATURE) if name in snapshot.channels]
    if not names:
        return []
    each = (width - 2 * (len(names) - 1)) // len(names)
    line: Row = row()
    for k, name in enumerate(names):
        space: Row = (("  ", ""),) if k else ()
        line = (*line, *space, *bar_of(view, name, short_name(name), each))
    return [fit(line, width)]
