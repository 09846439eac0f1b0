"""The whole screen: header, notices, the page, the keys, a question above all."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping
from typing import Final

from rig.tui.browse import SHIPPED_JOINTS
from rig.tui.drawing.rows import Row, block, box, ends, fit, hstack, row, wrapped
from rig.tui.drawing.styles import ASK, DIM, LEVELS, NORMAL, STRONG, SYMBOLS, WARN_TEXT
from rig.tui.following.link import LinkStage
from rig.tui.look import OF_A_RECORDED_RUN, PAGES, PlotView
from rig.tui.pages import estimates, levels, operation, overview, runs, trace
from rig.tui.units import age_text, clock_text
from rig.tui.words import VERY_OLD, Freshness, headline, notices, run_time, time_left

REMARK_ROWS: Final = 3  # at most, of the result of an action
LEAST: Final = (60, 16)  # a smaller terminal shows only the state and the stop key
NOTICES: Final = 6  # rows they may take
Page = Callable[[PlotView, int, int], list[Row]]
OF_A_RUN: Final[Mapping[str, Page]] = {
    "overview": overview.overview,
    "joint": levels.joint_page,
    "channel": levels.channel_page,
    "diagnostics": levels.diagnostics_page,
    "alarms": operation.alarms_page,
    "protocol": operation.protocol_page,
    "log": operation.log_page,
    "estimates": estimates.estimates_page,
}
OF_THE_DISK: Final[Mapping[str, Page]] = {  # and pages that need no run
    "runs": runs.runs_page,
    "run log": operation.run_log_page,
    "run trace": trace.run_trace_page,
    "manual": levels.manual_page,
}
KEYS: Final = {
    "overview": "t command  p pause/resume  a answer  k acknowledge  h hold",
    "joint": "←→ joint  + − = span  z zoom  h hold",
    "channel": "↑↓ channel  + − = span  z zoom  h hold",
    "alarms": "↑↓ mark  k acknowledge  r reset",
    "protocol": "t command  p pause/resume  n skip  x abort  a answer",
    "log": "↑↓ scroll  / search  f filter  e end",
    "run log": "↑↓ scroll  / search  f filter  e end  0 runs",
    "run trace": "↑↓ scroll  ←→ channel  0 runs",
    "manual": "hold ↑ ↓ jog  ←→ joint  l lock  u unlock  x end",
    "runs": "← → tabs  ↑ ↓ mark  Enter what can be done",
}


def compose(view: PlotView, width: int, height: int) -> list[Row]:
    """Return `height` rows of `width` cells: the whole picture."""
    if width <= 0 or height <= 0:
        return []
    if width < LEAST[0] or height < LEAST[1]:
        return too_small(view, width, height)
    head = [*header(view, width), *notice_rows(view, width)]
    foot = [_keys(view, width)]
    if view.remark:  # what to do after a failed action stands at its end
        lines = wrapped(view.remark, width - 1, STRONG)[:REMARK_ROWS]
        foot = [*(fit(((" ", ""), *line), width) for line in lines), *foot]
    room = max(height - len(head) - len(foot), 0)
    rows = block([*head, *block(_page(view, width, room), width, room), *foot], width, height)
    return _above(rows, view, width) if view.dialog is not None else rows


def _page(view: PlotView, width: int, height: int) -> list[Row]:
    page = OF_THE_DISK.get(view.look.page)
    if page is None:
        page = OF_A_RUN[view.look.page]
        if view.newest.stage is LinkStage.CHOOSING:
            page = chooser
        elif view.frame.snapshot is None:
            page = waiting
    return page(view, width, height)


def too_small(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the content of a terminal without room for a page: the state and the stop keys."""
    head = headline(view.newest, view.now)
    style = LEVELS[head.level]
    lines = [
        row((f"{head.symbol} {head.word}", style)),
        row(("SPACE STOPS", STRONG)),
        row((f"{width}x{height}: too small, needs {LEAST[0]}x{LEAST[1]}", "")),
    ]
    return block(lines, width, height)


def header(view: PlotView, width: int) -> list[Row]:
    """Return the lines on top: state, run, age and clock; the step; the pages."""
    return [_who(view, width), _where(view, width), _tabs(view, width)]


def _who(view: PlotView, width: int) -> Row:
    head = headline(view.newest, view.now)
    badge = (f" {head.symbol} {head.word} ", LEVELS[head.level])
    snapshot = view.newest.snapshot
    if snapshot is None:
        endpoint = view.newest.endpoint
        text = f"{endpoint.rig} (process {endpoint.pid})" if endpoint else "no run attached"
        return fit(row(badge, f" {text}"), width)
    fresh = view.fresh
    age = view.newest.age(view.now)
    style = "" if fresh is Freshness.LIVE else WARN_TEXT if age <= VERY_OLD else LEVELS["alarm"]
    word = "ended" if view.newest.over else f"age {age_text(age)}"
    speed = f" ({view.newest.speed:.0f}×)" if view.newest.speed > 1.5 else ""
    clock = f"  t {clock_text(run_time(view.newest))}{speed} "
    command = "in command" if view.in_command else "held by another" if snapshot.holder else ""
    command = f" {command or 'read-only'}  "
    right = row((command, DIM), (word, style if not view.newest.over else DIM), (clock, STRONG))
    name = snapshot.run.rstrip("/").rpartition("/")[2]
    return ends(row(badge, (f" {snapshot.rig}", STRONG), (f"  {name}", DIM)), right, width)


def _where(view: PlotView, width: int) -> Row:
    snapshot = view.newest.snapshot
    if snapshot is None:
        return fit(row(), width)
    line = row(" ", (snapshot.step or "–", STRONG), f"  {snapshot.phase}")
    if snapshot.repeats > 0:
        line = (*line, (f"  repeat {snapshot.repeat} of {snapshot.repeats}", ""))
    lost = (f"  {snapshot.lost_samples} lost", WARN_TEXT if snapshot.lost_samples else DIM)
    if not snapshot.total_s > 0:
        return ends(line, (lost,), width)
    share = min(max(snapshot.done_s / snapshot.total_s, 0.0), 1.0)
    room = max(min(width - 70, 40), 0)
    full = round(share * room)
    left = f"left {time_left(snapshot)}"
    left = "ended" if view.newest.over else left
    progress = row(("━" * full, ""), ("─" * (room - full), DIM), f" {share:.0%}  {left}", lost)
    return ends(line, (*progress, (" ", "")), width)


def _tabs(view: PlotView, width: int) -> Row:
    count = len(view.alarms.alarms)
    unacknowledged = len(view.alarms.unacknowledged)
    line: Row = ()
    open_page = "runs" if view.look.page in OF_A_RECORDED_RUN else view.look.page
    for key, name, short in PAGES:
        text = name if width >= 116 else short
        if name == "alarms" and count:
            text += f" {count}{'▲' if unacknowledged else ''}"
        style = NORMAL if name == open_page else WARN_TEXT if text[-1] == "▲" else DIM
        line = (*line, (f" {key} {text}{' ' * (width >= 116)}", style))
    return fit(line, width)


def notice_rows(view: PlotView, width: int) -> list[Row]:
    """Return the notices, each on its own colour over the whole width."""
    rows: list[Row] = []
    shown = notices(view.newest, view.stop, view.now, paused=view.held)
    if view.look.page == "overview":  # it lists the alarms itself
        shown = [notice for notice in shown if not notice.text.startswith("WARNING")]
    for notice in shown:
        style = LEVELS[notice.level]
        lines = wrapped(notice.text, width - 4)
        for k, line in enumerate(lines):
            symbol = SYMBOLS[notice.level] if k == 0 else " "
            text = "".join(part for part, _ in line)
            rows.append(row((f" {symbol} {text:<{width - 3}}"[:width], style)))
    return block(rows, width, min(len(rows), NOTICES))


def _keys(view: PlotView, width: int) -> Row:
    stop = row((" SPACE STOP ", LEVELS["normal"]))
    if width >= 116:
        stop = (*stop, (" Esc-Esc too ", DIM))
    keys = KEYS.get(view.look.page, "")
    return ends((*stop, (f" {keys}", "")), row((" ? help  q quit ", DIM)), width)


def waiting(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the page without a run: how to start one."""
    browsed = view.browsed
    rig = shlex.quote(browsed.rig or view.rig or "shinshu-2dof")
    commands = [f"bramah run lock-and-excite --rig {rig} --out RUN"]
    if browsed.joints != SHIPPED_JOINTS:  # its steps name each joint
        commands = [
            f"bramah plan --rig {rig} --out steps.yaml",
            f"bramah run steps.yaml --rig {rig} --out RUN",
        ]
    which = f" on rig {view.rig}" if view.rig else ""
    lines = [
        row((f" No protocol is running{which}.", STRONG)),
        row(),
        row(" Start one here: 0 lists protocols and runs; or in another terminal:"),
        *(row((f"   {command}", "")) for command in commands),
        row(),
        row((" This screen attaches as soon as it runs.  q quits.", DIM)),
    ]
    if view.newest.endpoint is not None:
        lines = [row((" Attached; nothing received yet.", STRONG))]
    return block(lines, width, height)


def chooser(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the runs to choose from."""
    lines = [
        row((" Several runs. Which one?  Enter attaches; SPACE stops the marked one.", STRONG))
    ]
    for endpoint in view.newest.sessions:
        mark = "▸" if endpoint == view.marked_session else " "
        style = STRONG if endpoint == view.marked_session else ""
        lines.append(row((f" {mark} {endpoint.rig}   process {endpoint.pid}", style)))
    return block(lines, width, height)


def _above(rows: list[Row], view: PlotView, width: int) -> list[Row]:
    """Return the rows with the open question over them."""
    dialog = view.dialog
    assert dialog is not None
    wide = min(76, width)
    inner = wide - 4
    body = [line for text in dialog.body for line in (wrapped(text, inner) or [row()])]
    for k, choice in enumerate(dialog.choices):
        marked = k == dialog.marked
        body.append(row((f" {'▸' if marked else ' '} {choice} ", ASK if marked else "")))
    if dialog.text is not None:
        body.append(fit(row(("> ", STRONG), dialog.text, ("█", "")), inner))
    body += [row(), row((dialog.keys, DIM))]
    rows_high = min(len(body) + 2, len(rows))
    drawn = box(dialog.title, body, wide, rows_high, STRONG)
    top, left = max((len(rows) - rows_high) // 2, 0), (width - wide) // 2
    # On these rows only the question is shown.
    blank = [row()] * rows_high
    middle = hstack([(blank, left), (drawn, wide), (blank, width - wide - left)], rows_high, gap=0)
    return [*rows[:top], *middle, *rows[top + rows_high :]]
