"""Runs, protocols and the queue: what can be started and what was found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from rig.queue.items import Item
from rig.runs.listing.summary import RunSummary
from rig.tui.browse import TABS
from rig.tui.drawing.rows import Part, Row, beside, block, box, columns, fit, row, wrapped
from rig.tui.drawing.styles import ALARM_TEXT, DIM, NORMAL, STRONG, WARN_TEXT
from rig.tui.look import PlotView

WIDE = 110  # from this width on, the verb's output stands beside the list
STATES = {"tripped": "■", "unreadable": "✕", "interrupted": "▲", "aborted": "▲", "running": "●"}


def runs_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the open tab with the marked line, and the newest verb's output."""
    found = view.browsed
    tabs: Row = ((" ", ""),)
    for k, name in enumerate(TABS):
        tabs = (*tabs, (f" {name} ", NORMAL if k == found.tab else DIM), (" ", ""))
    reading = " reading ..." if found.reading else ""
    about = f" in {found.folder.absolute()}   rig {found.rig or '–'}{reading}"
    head = [fit((*tabs, (about, DIM)), width)]
    if found.trouble:
        head += wrapped(f" {found.trouble}", width, WARN_TEXT)
    lines = _lines(view)
    at = min(view.look.marked, max(len(lines) - 1, 0))
    listed = [
        row(("▸" if k == at else " ", STRONG), *line) for k, line in enumerate(lines)
    ] or [row((" nothing here", DIM))]  # fmt: skip
    room = height - len(head)
    if found.job is None:
        return block([*head, *_around(listed, at, room)], width, height)
    if width >= WIDE:
        left = width * 2 // 5
        right = width - left - 1
        pair = [(_around(listed, at, room), left), (_job(view, right, room), right)]
        return [*head, *beside(pair, room)]
    above = max(room // 3, 3)
    return block(
        [*head, *block(_around(listed, at, above), width, above),
         *_job(view, width, room - above)], width, height)  # fmt: skip


def _around(rows: list[Row], at: int, height: int) -> list[Row]:
    first = min(max(at - height // 2, 0), max(len(rows) - height, 0))
    return rows[first : first + height]


def _lines(view: PlotView) -> list[Row]:
    found = view.browsed
    if found.name == "protocols":
        return [row(f" {name}") for name in found.protocols]
    if found.name == "runs":
        return columns([_run(one) for one in found.runs])
    return columns([_item(item) for item in found.queue])


def _run(one: RunSummary) -> list[str | Part]:
    style = ALARM_TEXT if one.state in ("tripped", "unreadable") else ""
    count = f"{one.records} records" if one.records >= 0 else ""
    said = one.message if one.state != "done" else ""
    state = (f"{STATES.get(one.state, '□')} {one.state}", style)
    return [f" {one.path.name}", state, one.protocol, count, (one.created[:16], DIM), said]


def _item(item: Item) -> list[str | Part]:
    return [f" {item.id}", (item.state, STRONG), item.job.name, item.reason]


def _job(view: PlotView, width: int, height: int) -> list[Row]:
    """Return a verb with its output: a check's envelopes, parameters with intervals, progress."""
    job = view.browsed.job
    assert job is not None
    inner = width - 4
    style = ALARM_TEXT if job.code else STRONG
    head = wrapped(job.ended or f"running (process {job.pid})", inner, style)
    result = job.result() if job.code == 0 else None
    if isinstance(result, Mapping) and isinstance(result.get("parameters"), Mapping):
        body = parameter_rows(result["parameters"])
    else:
        text = job.output.splitlines() if job.code is not None else []
        body = [row(line) for line in (text or list(job.lines)[-(height - 2 - len(head)) :])]
    offset = min(view.look.offset, max(len(body) - 1, 0))
    note = "PgUp PgDn" if len(body) + len(head) > height - 2 else ""
    return box(job.title, [*head, *body[offset:]], width, height, DIM, note)


def parameter_rows(parameters: Mapping[str, Any]) -> list[Row]:
    """Return identified parameters with their 95 % intervals, one line each."""
    cells: list[list[str | Part]] = []
    for name, found in parameters.items():
        value, (low, high) = found["value"], found["ci95"]
        if value is None or low is None or high is None:
            cells.append([name, ("not identified", WARN_TEXT)])
            continue
        half = 0.5 * (high - low)
        share = abs(half / value) if value else float("inf")
        wide: Part = ("▲ wide", WARN_TEXT) if share > 0.5 else ("", "")
        text = f"{low:.4g} … {high:.4g}"
        cells.append([name, (f"{value:.4g}", STRONG), found["unit"], text, f"±{share:.1%}", wide])
    return columns(cells)
