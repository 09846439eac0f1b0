"""The levels below the overview: one joint, moved by hand or not, one channel, diagnostics."""

from __future__ import annotations

from rig.model import channels as ch
from rig.tui.drawing.rows import Part, Row, block, box, columns, fit, hstack, row, wrapped
from rig.tui.drawing.styles import ALARM_TEXT, ASK, DIM, STRONG, WARN_TEXT
from rig.tui.look import PlotView
from rig.tui.pages.parts import (
    WIDE,
    bench_bars,
    curve,
    curves,
    freshness_label,
    joint_box,
    joint_channels,
    joint_title,
    joints_in,
)
from rig.tui.units import age_text, clock_text, limit, shown
from rig.tui.words import NEARNESS, band_of, run_time, value

LIST = 26  # width of the list of channels
MANUAL = "manual"  # the kind of session that accepts jogs


def joint_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return one joint: every channel as a curve if there is room, and as a bar."""
    snapshot = view.frame.snapshot
    assert snapshot is not None
    joints = joints_in(snapshot.channels)
    if not joints:
        return block([row((" this run has no joints", DIM))], width, height)
    joint = joints[min(max(view.look.joint, 1), len(joints)) - 1]
    inner = width - 4
    bars, names = joint_channels(view, joint, inner)
    room = height - 2 - len(bars)
    if width >= WIDE:
        pressures = {n: k for n, k in names.items() if ch.kind_of(n)[0] in (ch.CAP, ch.ROD)}
        motion = {n: k for n, k in names.items() if n not in pressures}
        half = (inner - 2) // 2
        sides = [(curves(view, side, half, room), half) for side in (pressures, motion) if side]
        above = hstack(sides, room, gap=2)
    else:
        above = curves(view, names, inner, room)
    title = joint_title(view, joint, f" of {len(joints)}  ← →")
    note = f"last {view.look.seconds:g} s  + − ="
    return box(title, [*above, *bars], width, height, DIM, note)


def manual_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the manual actions possible now, and the joints."""
    snapshot = view.newest.snapshot
    if snapshot is None or view.newest.over:
        lines = [
            row((" Nothing is held by hand.", STRONG)),
            row((" Enter starts a manual session: it takes the device; no protocol may run.", "")),
            row((" d lets the pressure out, where the rig can.", "")),
        ]
        return block(lines, width, height)
    if snapshot.kind != MANUAL:
        text = (
            f" Refused while a protocol runs ({snapshot.run or snapshot.step}): wait for its end."
        )
        return block(wrapped(text, width, WARN_TEXT), width, height)
    joints = joints_in(snapshot.channels)
    joint = joints[min(max(view.look.joint, 1), len(joints)) - 1] if joints else 1
    keys = f"hold ↑ to extend joint {joint}, ↓ to retract: it stops when you let go"
    head = [
        *wrapped(snapshot.message, width, STRONG),
        *([] if view.in_command else wrapped("t takes the controls first", width, WARN_TEXT)),
        *wrapped(keys, width, ASK),
        *wrapped("← → joint   l lock   u unlock   x end the session", width, DIM),
    ]
    bars = bench_bars(view, width)
    room = max(height - len(head) - len(bars), 0)
    numbers = [joint, *(other for other in joints if other != joint)][: max(width // 38, 1)]
    share = (width - len(numbers) + 1) // len(numbers)
    boxes = [(joint_box(view, number, share, room), share) for number in sorted(numbers)]
    return [*head, *hstack(boxes, room), *bars]


def channel_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return a list of all channels, the marked one as a plot with its bands in words."""
    snapshot = view.frame.snapshot
    assert snapshot is not None
    names = list(snapshot.channels)
    if not names:
        return block([row((" this run measures nothing", DIM))], width, height)
    at = min(max(view.look.channel, 0), len(names) - 1)
    first = min(max(at - height // 2, 0), max(len(names) - height, 0))
    listed = []
    for k, name in list(enumerate(names))[first : first + height]:
        mark_of_band = NEARNESS[band_of(snapshot.channels[name])] or " "
        mark = "▸" if k == at else " "
        listed.append(row((f"{mark}{mark_of_band} {name}", STRONG if k == at else "")))
    name, room = names[at], width - LIST - 1
    channel = snapshot.channels[name]
    form = shown(channel.unit)
    words = [
        ("trips beyond", form.short(limit(channel.low)), form.short(limit(channel.high))),
        ("warns beyond", form.short(limit(channel.warn_low)), form.short(limit(channel.warn_high))),
    ]
    text = [
        fit(row((f"{what}  ", DIM), _band(low, high, form.unit)), room) for what, low, high in words
    ]
    plot = curve(view, name, name, room, height - len(text), axis=True)
    return hstack([(listed, LIST), ([*plot, *text], room)], height)


def _band(low: str, high: str, unit: str) -> str:
    return f"{low or '–'} … {high or '–'} {unit}" if low or high else "no limit"


def diagnostics_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the health of sampling and of the link, with the device's own time."""
    frame = view.newest
    snapshot = frame.snapshot
    assert snapshot is not None
    lost = (str(snapshot.lost_samples), ALARM_TEXT if snapshot.lost_samples else "")
    age = frame.age(view.now)
    cells: list[tuple[str, str | Part]] = [
        ("time since the run began", f"{run_time(frame):.3f} s  ({clock_text(run_time(frame))})"),
        ("time of the device", f"{snapshot.device_time:.3f} s, tick {snapshot.tick}"),
        ("device against wall clock", f"{frame.speed:.2f} times"),
        ("age of the newest sample", "–" if frame.over else age_text(age)),
        ("worst age of a block", age_text(frame.worst_age)),
        ("samples lost", lost),
        ("samples a second", f"{snapshot.sample_rate:g}" if snapshot.sample_rate else "–"),
        ("channels", str(len(snapshot.channels))),
        ("pictures a second", f"{1 / frame.interval:.1f}" if frame.interval > 0 else "–"),
        (
            "what the numbers are",
            (view.fresh.value, "" if not freshness_label(view) else WARN_TEXT),
        ),
        ("state of the run / engine", f"{snapshot.state} / {snapshot.engine or '–'}"),
        ("in command", snapshot.holder or "nobody"),
        ("wire", snapshot.wire or "–"),
        ("process of the run", str(snapshot.pid)),
        ("run folder", snapshot.run or "none"),
        ("sockets", str(frame.endpoint.pub) if frame.endpoint else "–"),
    ]
    table = columns([[(f" {name}", DIM), *row(what)] for name, what in cells])
    names = [
        [
            (f" {name}", ""),
            ("".join(text for text, _ in value(channel, view.fresh)), ""),
            (_state_of(view, channel.last), DIM),
        ]
        for name, channel in snapshot.channels.items()
    ]
    listed = columns(names)
    if width >= WIDE:
        table_width = max(width // 2, 60)
        return hstack([(table, table_width), (listed, width - table_width - 1)], height)
    return block([*table, row(), *listed], width, height)


def _state_of(view: PlotView, last: float) -> str:
    return "INVALID" if last != last else freshness_label(view) or "live"  # noqa: PLR0124 - NaN
