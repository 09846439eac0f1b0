"""The pages of the run: alarms, protocol, log; the log of a run on the disk."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

from rig.model.alarms.states import Alarm, folded
from rig.tui.drawing.plot import PlotTrace, draw
from rig.tui.drawing.rows import Row, block, box, columns, fit, marked, row, window, wrapped
from rig.tui.drawing.styles import ASK, ASK_TEXT, DIM, NORMAL, STRONG, WARN_TEXT
from rig.tui.following.event_lines import EventLine
from rig.tui.look import PlotView
from rig.tui.pages.overview import alarm_mark
from rig.tui.pages.parts import list_with_detail
from rig.tui.units import clock_text, limit, shown
from rig.tui.words import run_time, time_left

BEFORE = 2.0  # of an alarm's channel shown before its first offending sample [s]
AFTER = 0.5  # and after it [s]


def in_order(view: PlotView) -> list[tuple[Alarm, bool]]:
    """Return the alarms as listed, each with whether it is a consequence of one above."""
    ordered = []
    for first, rest in folded(view.alarms):
        ordered.append((first, False))
        ordered += [(alarm, True) for alarm in rest]
    return ordered


def alarms_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the alarms, first causes first, and the details of the marked one."""
    listed = in_order(view)
    if not listed:
        text = row(
            (" No alarms. ", STRONG), ("Trips latch until they are reset with a reason.", DIM)
        )
        return block([text], width, height)
    at = min(max(view.look.marked, 0), len(listed) - 1)
    rows = []
    for k, (alarm, is_consequence) in enumerate(listed):
        mark = ("▸", STRONG) if k == at else (" ", "")
        indent = "   └ " if is_consequence else " "
        moment = f"{run_time(view.frame, alarm.time):9.2f} s  "
        rows.append(row(mark, (moment, DIM), indent, *alarm_mark(view, alarm), f" {alarm.key}"))
    above = min(len(rows), max(height // 3, 1))
    detail = partial(_detail, view, listed[at][0])
    return list_with_detail(rows, at, detail, width, height, above)


def _detail(view: PlotView, alarm: Alarm, width: int, height: int) -> list[Row]:
    form = shown(alarm.unit)
    low, high = (limit(end) if math.isfinite(end) else None for end in alarm.limit)
    allowed = " … ".join(form.short(end) or "any" for end in (low, high))
    unlimited = low is None and high is None  # a sensor that keeps one value
    allowed = "" if unlimited else f", allowed {allowed} {form.unit}"
    if alarm.state == "latched":
        acts = "k acknowledges"
        acts += ", r resets with a reason" if alarm.acknowledged else "; only then r resets it"
    else:
        acts = "acknowledged" if alarm.acknowledged else "k acknowledges"
    where = f"joint {alarm.joint}" if alarm.joint else "the bench"
    fields = [
        ("cause", alarm.check),
        ("where", f"{alarm.channel or '–'} of {where}"),
        ("value", f"{form.number(alarm.value)} {form.unit}{allowed}"),
        ("when", f"{run_time(view.frame, alarm.time):.3f} s since the run began"),
        ("state", f"{alarm.state}, {'acknowledged' if alarm.acknowledged else 'UNACKNOWLEDGED'}"
                  + (f", came {alarm.count} times" if alarm.count > 1 else "")),
        ("acts", acts),
    ]  # fmt: skip
    inner = width - 4
    body = wrapped(alarm.sentence, inner, STRONG)
    body += columns([[(name, DIM), text] for name, text in fields])
    body += [row(("do    ", ASK_TEXT), *line) for line in wrapped(alarm.remedy, inner - 6)]
    plot = _curve_before(view, alarm, inner, height - 2 - len(body))
    return box(alarm.key, [*body, *plot], width, height)


def _curve_before(view: PlotView, alarm: Alarm, width: int, height: int) -> list[Row]:
    """Return the 2 s before an alarm as a plot; nothing if they are unknown."""
    window = view.frame.window
    if height < 4 or alarm.channel not in window.columns:
        return []
    start, stop = alarm.time - BEFORE, alarm.time + AFTER
    inside = (window.time > start) & (window.time <= stop)
    if not inside.any():
        return [row((" the samples around it are no longer held", DIM))]
    low, high = window.of(alarm.channel)
    ends = (limit(alarm.limit[0]), limit(alarm.limit[1]))
    trace = PlotTrace(window.time, low, high, start, stop, ends, shown(alarm.unit))
    text = f"{BEFORE:g} s before it and {AFTER:g} s after"
    return [row((text, DIM)), *draw(trace, width, height - 1)]


def protocol_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the steps with the present one, the open question, and who is in command."""
    snapshot = view.newest.snapshot
    assert snapshot is not None
    if view.in_command:
        holder = "this screen is in command; t releases the controls"
    elif snapshot.holder:
        holder = f"read-only: {snapshot.holder} is in command; t takes the controls"
    else:
        holder = "nobody is in command; t takes the controls"
    left = f"{time_left(snapshot)} left"
    head = [
        row((" command ", DIM), (holder, STRONG if view.in_command else "")),
        row((" engine  ", DIM), (snapshot.engine or snapshot.state, STRONG),
            (f"   {clock_text(snapshot.done_s)} of {clock_text(snapshot.total_s)}", ""),
            ("   ended" if view.newest.over else f"   {left}", STRONG)),
    ]  # fmt: skip
    if snapshot.prompt and not view.newest.over:
        answers = " / ".join(snapshot.answers)
        head += wrapped(f" ? {snapshot.prompt}   [{answers}]   a answers", width, ASK)
    at = snapshot.part
    steps: list[Row] = []
    for k, line in enumerate(view.newest.plan, 1):
        mark, style = ("✓", DIM) if k < at else ("▸", STRONG) if k == at else (" ", "")
        state = "  now" if k == at and not view.newest.over else ""
        steps.append(
            row((f" {mark}{k:3d} {line.name:<14} ", style),
                (f"{clock_text(line.seconds):>7}  ", DIM), (line.title, style), (state, NORMAL))
        )  # fmt: skip
    if not steps:
        steps = [row((" the run has not said which steps it has", DIM))]
    return block([*head, row(), *window(steps, at - 1, height - len(head) - 1)], width, height)


def filtered(lines: Sequence[EventLine], view: PlotView) -> list[EventLine]:
    """Return the lines of a log that match the operator's filter and search."""
    search = view.look.search.lower()
    return [
        line
        for line in lines
        if view.look.only in ("all", line.kind) and search in line.text.lower()
    ]


def log_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the log of the run on the screen."""
    return log_rows(view.newest.event_lines, view, width, height)


def run_log_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the log of a run on the disk, with damaged lines reported."""
    log = view.browsed.log
    if log is None:
        return block([row((" no run was opened", DIM))], width, height)
    opened = [run for run in view.browsed.runs if run.path == log.folder]
    state = f"  {opened[0].state}  {opened[0].message}" if opened else ""
    head = [fit(row((f" log of {log.folder}", STRONG), (state, DIM)), width)]
    if log.reading:
        return block([*head, row((" reading ...", DIM))], width, height)
    if log.trouble:
        head += marked((" ▲ ", WARN_TEXT), log.trouble, width, WARN_TEXT)
    return [*head, *log_rows(log.lines, view, width, max(height - len(head), 1))]


def log_rows(
    event_lines: Sequence[EventLine], view: PlotView, width: int, height: int
) -> list[Row]:
    """Return lines of a log, wrapped, the newest last; scrolled by rows."""
    lines = filtered(event_lines, view)
    room = height - 1
    scrolled = view.look.offset
    # A line has at least one row: lines above the window need not be wrapped.
    rows = [
        line
        for entry in lines[-(room + scrolled) :]
        for line in marked((f"{entry.time:10.2f} s  ", DIM), entry.text, width, entry.style)
    ]
    offset = min(scrolled, max(len(rows) - room, 0))
    search = f"  search: {view.look.search}" if view.look.search else ""
    where = f"  {offset} rows back" if offset else ""
    count = f"  {len(lines)} of {len(event_lines)}{where}"
    head = row((f" {view.look.only}{search}", STRONG), (count, DIM))
    shown_rows = rows[max(len(rows) - room - offset, 0) : len(rows) - offset]
    return block([head, *shown_rows], width, height)
