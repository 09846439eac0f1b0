"""Overview: the state of the bench, legible from two metres."""

from __future__ import annotations

from functools import partial

from rig.bench.screens.sockets import Snapshot
from rig.model.alarms.states import Alarm, folded
from rig.tui.drawing.large import ROWS, large, large_width
from rig.tui.drawing.rows import Row, block, fit, grid, hstack, row
from rig.tui.drawing.styles import ALARM, ALARM_TEXT, DIM, LEVELS, STRONG, WARN, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.pages.parts import WIDTH, bench_bars, joint_box, joints_in
from rig.tui.units import shown
from rig.tui.words import Headline, Margin, headline, nearest_margin, time_left

NEAR = 0.10  # a margin below this share of its band is yellow
BIG = (150, 45)  # terminal of this size: letters twice as large
GLANCE = 3  # alarms listed
JOINT_ROWS = 9  # least height of a joint


def overview(view: PlotView, width: int, height: int) -> list[Row]:
    """Return state, margin and time left in large letters, then alarms, then the joints."""
    snapshot = view.frame.snapshot
    assert snapshot is not None
    margin = nearest_margin(view.newest)
    scale = 2 if width >= BIG[0] and height >= BIG[1] else 1
    rows = _band(headline(view.newest, view.now), margin, view, width, scale)
    rows += [_step_line(view, snapshot, width), _margin_line(margin, width)]
    rows += alarm_lines(view, width, GLANCE if height < 30 else 2 * GLANCE)
    bars = bench_bars(view, width)
    joints = joints_in(snapshot.channels)
    return [*rows, *_joints(view, joints, width, height - len(rows) - len(bars)), *bars]


def _band(
    headline: Headline, margin: Margin | None, view: PlotView, width: int, scale: int
) -> list[Row]:
    """Return the large letters; an abnormal state fills the band with its colour."""
    snapshot = view.newest.snapshot
    assert snapshot is not None
    ground = LEVELS[headline.level] if headline.level not in ("normal", "ended") else ""
    tiles = []
    if margin is not None and not view.newest.over:
        near = ALARM_TEXT if margin.share < 0 else WARN_TEXT if margin.share < NEAR else STRONG
        tiles.append((f"{max(margin.share, 0.0):.0%}", "to nearest limit", near))
    if snapshot.total_s > 0 and not view.newest.over:
        tiles.append((time_left(snapshot), "left", STRONG))
    sizes = [max(large_width(text, scale), len(caption)) + 2 for text, caption, _ in tiles]
    room = width - sum(sizes) - len(tiles)
    if room < min(large_width(headline.word), width) and headline.level == "alarm":
        tiles, sizes, room = [], [], width  # the word matters most
    letter_scale = next((s for s in (scale, 1) if large_width(headline.word, s) + 4 <= room), 0)
    letter_rows = ROWS * scale
    style = ground or STRONG
    if letter_scale:
        letters: list[Row] = large(headline.word, style, letter_scale)
    else:
        spaced = " ".join(headline.word)
        letters = [row(), row((spaced if len(spaced) + 1 < room else headline.word, style))]
    word = [fit((("  ", style), *line), room, ground) for line in letters]
    caption = row((f" {headline.symbol} {headline.word} ", ground or DIM))
    word = [*block(word, room, letter_rows, ground), fit(caption, room, ground)]
    blocks: list[tuple[list[Row], int]] = [(word, room)]
    for (text, below, tile_style), size in zip(tiles, sizes, strict=True):
        blocks.append(([*large(text, tile_style, scale), row((below, DIM))], size))
    return hstack(blocks, letter_rows + 1)


def _step_line(view: PlotView, snapshot: Snapshot, width: int) -> Row:
    part = f"{snapshot.part} of {snapshot.parts}: " if snapshot.parts else ""
    now = row((" now   ", DIM), (f"{part}{snapshot.step or '–'} {snapshot.phase}", STRONG))
    plan = view.newest.plan
    after = plan[snapshot.part].title if snapshot.part < len(plan) else "the run is over"
    return fit((*now, ("   next  ", DIM), (after, "")) if plan else now, width)


def _margin_line(margin: Margin | None, width: int) -> Row:
    if margin is None:
        return fit(row((" limit ", DIM), ("no channel has limits", DIM)), width)
    form = shown(margin.unit)
    near = margin.share < NEAR
    symbol = "■ " if margin.share < 0 else "▲ " if near else ""
    style = ALARM_TEXT if margin.share < 0 else WARN_TEXT if near else ""
    text = (
        f"{symbol}{margin.channel} {form.number(margin.value)} {form.unit}, "
        f"{form.number(margin.distance)} {form.unit} from its limit {form.short(margin.limit)}"
    )
    return fit(row((" limit ", DIM), (text, style)), width)


def alarm_lines(view: PlotView, width: int, most: int) -> list[Row]:
    """Return the most urgent alarms, one line each; unacknowledged ones blink."""
    groups = folded(view.alarms)
    if not groups:
        return [fit(row((" alarms none", DIM)), width)]
    rows = []
    for first, rest in groups[:most]:
        more = f" (+{len(rest)} consequences)" if rest else ""
        rows.append(
            fit(row((" ", ""), *alarm_mark(view, first), f" {first.sentence}{more}"), width)
        )
    hidden = len(groups) - most
    if hidden > 0:
        rows.append(fit(row((f" … and {hidden} more: 5 shows them", DIM)), width))
    return rows


def alarm_mark(view: PlotView, alarm: Alarm) -> Row:
    """Return an alarm's shape and state; its colour blinks until it is acknowledged."""
    shape, style, text = ("■", ALARM, ALARM_TEXT) if alarm.trips else ("▲", WARN, WARN_TEXT)
    bright = alarm.acknowledged or view.look.blink
    word = f"{shape} {alarm.state.upper()}"
    word += "" if alarm.acknowledged else " UNACK"
    return row((f" {word} ", text if alarm.acknowledged else style if bright else text))


def _joints(view: PlotView, joints: list[int], width: int, height: int) -> list[Row]:
    """Return the joints side by side; others are reached by scrolling, locked ones last."""
    if not joints or height < 3:
        return block([], width, max(height, 0))
    across = max(min(width // WIDTH, len(joints)), 1)
    if len(joints) > across * max(height // JOINT_ROWS, 1):
        snapshot = view.frame.snapshot
        roles = snapshot.roles if snapshot is not None else []
        locked = {joint for joint, role in enumerate(roles, 1) if role == "locked"}
        joints = sorted(joints, key=lambda joint: joint in locked)
    first = min(view.look.offset, max(len(joints) - across, 0))
    boxes = [partial(joint_box, view, joint) for joint in joints[first:]]
    rows, below = grid(boxes, across, JOINT_ROWS, width, height)
    hidden = first + below
    if hidden > 0:
        rows[-1] = fit(row((f" {hidden} more joints: ↑ ↓ ", DIM)), width)
    return block(rows, width, height)
