"""Runs, protocols and the queue: what can be started, and results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from rig.runs.listing.summary import RunSummary
from rig.tui.browse import TABS
from rig.tui.drawing.rows import Part, Row, block, box, columns, fit, row, window, wrapped
from rig.tui.drawing.styles import ALARM_TEXT, DIM, NORMAL, STRONG, WARN_TEXT
from rig.tui.following.link import ENDED_STATES
from rig.tui.look import PlotView
from rig.tui.pages.parts import list_with_detail

STATES = {"tripped": "■", "unreadable": "✕", "interrupted": "▲", "aborted": "▲", "running": "●"}


def runs_page(view: PlotView, width: int, height: int) -> list[Row]:
    """Return the open tab with the marked line, and the newest verb's output."""
    browsed = view.browsed
    tabs: Row = ((" ", ""),)
    for k, name in enumerate(TABS):
        tabs = (*tabs, (f" {name} ", NORMAL if k == browsed.tab else DIM), (" ", ""))
    reading = " reading ..." if browsed.reading else ""
    location = f" in {browsed.folder.absolute()}   rig {browsed.rig or '–'}{reading}"
    head = [fit((*tabs, (location, DIM)), width)]
    if browsed.trouble:
        head += wrapped(f" {browsed.trouble}", width, WARN_TEXT)
    lines = _lines(view)
    at = min(view.look.marked, max(len(lines) - 1, 0))
    listed = [
        row(("▸" if k == at else " ", STRONG), *line) for k, line in enumerate(lines)
    ] or [row((" nothing here", DIM))]  # fmt: skip
    room = height - len(head)
    if browsed.job is None:
        return block([*head, *window(listed, at, room)], width, height)
    above = max(room // 3, 3)
    return [*head, *list_with_detail(listed, at, partial(_job, view), width, room, above)]


def _lines(view: PlotView) -> list[Row]:
    browsed = view.browsed
    if browsed.name == "protocols":
        return [row(f" {name}") for name in browsed.protocols]
    if browsed.name == "runs":
        return columns([_run(_as_reported(view, run)) for run in browsed.runs])
    queued = browsed.queue
    return columns([[f" {i.id}", (i.state, STRONG), i.job.name, i.reason] for i in queued])


def _as_reported(view: PlotView, run: RunSummary) -> RunSummary:
    """Return a run with the final state that it reported; its folder has it once all is written."""
    newest = view.newest.snapshot
    if newest is None or newest.state not in ENDED_STATES or newest.run != str(run.path.absolute()):
        return run
    return replace(run, state=newest.state, message=newest.message)


def _run(run: RunSummary) -> list[str | Part]:
    style = ALARM_TEXT if run.state in ("tripped", "unreadable") else ""
    count = f"{run.records} records" if run.records >= 0 else ""
    message = run.message if run.state != "done" else ""
    state = (f"{STATES.get(run.state, '□')} {run.state}", style)
    return [f" {run.path.name}", state, run.protocol, count, (run.created[:16], DIM), message]


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
    for name, estimate in parameters.items():
        value, (low, high) = estimate["value"], estimate["ci95"]
        if value is None or low is None or high is None:
            cells.append([name, ("not identified", WARN_TEXT)])
            continue
        half = 0.5 * (high - low)
        share = abs(half / value) if value else float("inf")
        wide: Part = ("▲ wide", WARN_TEXT) if share > 0.5 else ("", "")
        text = f"{low:.4g} … {high:.4g}"
        cells.append(
            [name, (f"{value:.4g}", STRONG), estimate["unit"], text, f"±{share:.1%}", wide]
        )
    return columns(cells)
