"""Parts of several pages: a joint, a channel's curve, the bars of the bench."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

from rig.bench.screens.sockets import Snapshot
from rig.model import channels as ch
from rig.tui.drawing.plot import PlotTrace, draw, time_axis
from rig.tui.drawing.rows import Row, box, fit, row
from rig.tui.drawing.styles import DIM, STRONG, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.pages.gauge import gauge
from rig.tui.units import limit, shown
from rig.tui.words import Freshness, value

_JOINT_CHANNEL = re.compile(r"^(?P<kind>.+)_(?P<joint>[1-9]\d*)$")
NAMES: Final = {ch.CAP: "cap", ch.ROD: "rod", ch.SUPPLY: "supply", ch.TEMPERATURE: "oil"}
# Drawn as curves in this order, as many as fit; all are gauges as well.
CURVES: Final = (ch.CAP, ch.ROD, ch.PISTON, ch.COMMAND, ch.SPOOL, ch.POSITION, ch.DRIVE)
GAUGES: Final = (ch.CAP, ch.ROD, ch.PISTON, ch.SPOOL, ch.COMMAND, ch.POSITION, ch.DRIVE)
CURVE_HEIGHT: Final = 4  # least rows of a curve with its words
WIDTH: Final = 38  # least columns of a joint
ROLES: Final = {"locked": "▣ locked", "excited": "≈ excited", "free": "○ free"}


def joints_in(channels: Iterable[str]) -> dict[int, list[str]]:
    """Return the channels of every joint, joints in order: {1: ["spool_1", ...], ...}."""
    by_joint: dict[int, list[str]] = {}
    for name in channels:
        match = _JOINT_CHANNEL.match(name)
        if match is not None:
            by_joint.setdefault(int(match["joint"]), []).append(name)
    return dict(sorted(by_joint.items()))


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
    spare = 0.5 * (high - low)
    return low - spare, high + spare


def curve(
    view: PlotView, name: str, label: str, width: int, height: int, *, axis: bool
) -> list[Row]:
    """Return a channel in words and as a plot of `height` rows in all."""
    snapshot, window = view.frame.snapshot, view.frame.window
    assert snapshot is not None
    channel = snapshot.channels[name]
    how = shown(channel.unit)
    stop = view.frame.device_time
    start = stop - view.look.seconds
    line: Row = ((f"{label:<9}", STRONG), *value(channel, view.fresh, sign=how.signed))
    span = window.span(name, start)
    if span is not None:
        numbers = " … ".join(how.number(end, sign=how.signed) for end in span)
        line = (*line, (f"   {numbers}", DIM))
    low, high = window.of(name)
    trace = PlotTrace(
        window.time,
        low,
        high,
        start,
        stop,
        (limit(channel.low), limit(channel.high)),
        how,
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
        left = height - len(rows)
        share = left // (count - k) if k < count - 1 else left
        rows += curve(view, name, label, width, share, axis=axis and k == count - 1)
    return rows


def joint_title(view: PlotView, joint: int) -> str:
    """Return a joint's name with its present activity."""
    snapshot = view.frame.snapshot
    roles = snapshot.roles if snapshot is not None else []
    role = ROLES.get(roles[joint - 1], "") if joint <= len(roles) else ""
    return f"joint {joint} {role}".rstrip()


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
    title = joint_title(view, joint)
    remark = freshness_label(view)
    style = DIM if not remark or remark in ("last picture", "held") else WARN_TEXT
    title = f"{title} · {remark}" if remark else title
    inner = width - 4
    bars, names = joint_channels(view, joint, inner)
    above = curves(view, names, inner, height - 2 - len(bars))
    return box(title, [*above, *bars], width, height, style, f"last {view.look.seconds:g} s")


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
