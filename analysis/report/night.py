"""The report of a queue's run: items, trips, identified parameters and their drift.

Every number comes from the arguments; the page refers to nothing outside itself.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from analysis.report import format as fm
from analysis.report.page import page
from analysis.report.plots.style import BLUE, CARD, GREY, INK, PALE, figure, style, svg

TEMPLATE: Final = "night.html"
_COLUMNS = 4  # of the drift's small figures
_BAR_COLOURS: Final = {"done": BLUE, "tripped": "#d03030"}


@dataclass(frozen=True)
class NightEstimate:
    """An identified parameter, SI, and half of its 95 % interval, NaN where it is not known."""

    value: float
    half: float
    unit: str


@dataclass(frozen=True)
class NightItem:
    """One item as the page shows it; times have a zone, None where an item did not get so far.

    Counts and the `seconds` of all samples, by the device's clock, are -1 where unknown: the host's
    clock may be set during a night. `unidentified` states why nothing was identified.
    """

    number: int
    name: str
    state: str
    reason: str
    rig: str
    run: str
    started: datetime | None
    ended: datetime | None
    attempts: int = 0
    records: int = -1
    samples: int = -1
    lost_samples: int = -1
    seconds: float = -1.0
    parameters: Mapping[str, NightEstimate] = field(default_factory=dict)
    unidentified: str = ""


@dataclass(frozen=True)
class Night:
    """A whole run of a queue: items in the order they started, notes, folder and host."""

    queue: str
    host: str
    made: datetime
    items: tuple[NightItem, ...]
    notes: tuple[tuple[datetime, str], ...] = ()
    paused: str = ""


def render(night: Night) -> str:
    """Return the page as HTML text."""
    counts = Counter(item.state for item in night.items)
    ended = [item for item in night.items if item.ended is not None]
    context = {
        "title": f"The night of {_begin(night):%d %B %Y}",
        "queue": night.queue,
        "host": night.host,
        "made": _clock(night.made, date=True),
        "lead": _lead(night, counts),
        "tripped": [_row(item) for item in night.items if item.state == "tripped"],
        "tiles": _tiles(night, counts),
        "timeline": _timeline(ended),
        "rows": [_row(item) for item in night.items],
        "drifts": [
            _drift(rig, identifications)
            for rig, identifications in _identified(night.items).items()
        ],
        "unidentified": [
            (item.number, item.name, item.unidentified) for item in night.items if item.unidentified
        ],
        "notes": [(_clock(time, date=True), text) for time, text in night.notes],
    }
    return page(TEMPLATE, context)


def _begin(night: Night) -> datetime:
    return min((item.started for item in night.items if item.started), default=night.made)


def _clock(time: datetime | None, *, date: bool = False) -> str:
    if time is None:
        return fm.DASH
    return time.astimezone().strftime("%d %b %H:%M" if date else "%H:%M:%S")


def _lead(night: Night, counts: Mapping[str, int]) -> str:
    total = len(night.items)
    done = counts.get("done", 0)
    trips = counts.get("tripped", 0)
    completed = f"{done} of {fm.count(total, 'item')} completed"
    others = [f"{number} {state}" for state, number in counts.items() if state != "done"]
    text = f"{completed}; {', '.join(others)}." if others else f"{completed}."
    if trips:
        text += " The bench stays tripped until a person has examined it and cleared the trip."
    return text + (f" The queue is {night.paused}." if night.paused else "")


def _tiles(night: Night, counts: Mapping[str, int]) -> list[dict[str, Any]]:
    runs = [item for item in night.items if item.samples >= 0]
    lost = sum(item.lost_samples for item in runs)
    seconds = sum(max(0.0, item.seconds) for item in night.items)
    failed = sum(n for state, n in counts.items() if state not in ("done", "queued", "cancelled"))
    return [
        {"number": str(counts.get("done", 0)), "label": "items done", "warn": False,
         "detail": f"of {len(night.items)}"},
        {"number": str(failed), "label": "ended otherwise", "warn": failed > 0,
         "detail": "the table says why"},
        {"number": str(counts.get("queued", 0)), "label": "items still queued", "warn": False,
         "detail": ""},
        {"number": f"{sum(max(0, item.records) for item in runs)}", "label": "complete records",
         "detail": f"{sum(item.samples for item in runs)} samples", "warn": False},
        {"number": str(lost), "label": "samples lost", "warn": lost > 0, "detail": "on the wire"},
        {"number": f"{seconds / 3600.0:.1f} h", "label": "of the bench's time", "warn": False,
         "detail": ""},
    ]  # fmt: skip


def _row(item: NightItem) -> dict[str, Any]:
    return {
        "number": item.number, "name": item.name, "state": item.state, "reason": item.reason,
        "rig": item.rig, "run": item.run, "started": _clock(item.started, date=True),
        "minutes": f"{item.seconds / 60.0:.1f}" if item.seconds > 0.0 else fm.DASH,
        "records": str(item.records) if item.records >= 0 else fm.DASH,
        "samples": str(item.samples) if item.samples >= 0 else fm.DASH,
        "lost": str(item.lost_samples) if item.lost_samples >= 0 else fm.DASH,
        "good": item.state == "done", "waits": item.state == "queued",
        "attempts": item.attempts,
    }  # fmt: skip


def _timeline(items: Sequence[NightItem]) -> Markup | None:
    """Draw when each item ran: blue done, red tripped, grey otherwise; a tick at its end."""
    shown = [item for item in items if item.started is not None]
    if not shown:
        return None
    begin = min(item.started for item in shown if item.started)
    with style():
        canvas = figure(0.7 + 0.19 * len(shown), CARD * 2)
        axes = canvas.add_subplot(1, 1, 1)
        for k, item in enumerate(shown):
            assert item.started is not None
            start_minute = (item.started - begin).total_seconds() / 60.0
            width = max(item.seconds / 60.0, 1e-3)
            colour = _BAR_COLOURS.get(item.state, GREY)
            axes.barh(k, width, left=start_minute, height=0.62, color=colour)
            axes.plot([start_minute + width] * 2, [k - 0.31, k + 0.31], color=INK, lw=0.8)
        axes.set_yticks(range(len(shown)), [str(item.number) for item in shown])
        axes.set_ylim(len(shown) - 0.4, -0.6)
        axes.set_xlabel(f"minutes since {_clock(begin)}")
        axes.set_ylabel("item")
        axes.grid(visible=False, axis="y")
        canvas.tight_layout()
        return svg(canvas, "timeline", "When each item ran")


def _identified(items: Sequence[NightItem]) -> dict[str, list[NightItem]]:
    """Group items with parameters by rig, in the order of time."""
    by_rig: dict[str, list[NightItem]] = {}
    for item in items:
        if item.parameters and item.ended is not None:
            by_rig.setdefault(item.rig, []).append(item)
    for group in by_rig.values():
        group.sort(key=lambda item: item.ended or item.started or datetime.min)
    return by_rig


def _drift(rig: str, items: Sequence[NightItem]) -> dict[str, Any]:
    names = list(dict.fromkeys(name for item in items for name in item.parameters))
    return {
        "rig": rig,
        "count": fm.count(len(items), "run"),
        "plot": _drift_plot(rig, items, names),
        "rows": [_drift_row(name, items) for name in names],
    }


def change(values: Sequence[NightEstimate]) -> tuple[float, float]:
    """Return the last minus the first estimate, and its ratio to its 95 % error (0: unknown).

    The errors of two runs are independent: their squares add.
    """
    first, last = values[0], values[-1]
    difference = last.value - first.value
    error = math.hypot(first.half, last.half)
    return difference, difference / error if error > 0.0 and math.isfinite(error) else 0.0


def _drift_row(name: str, items: Sequence[NightItem]) -> dict[str, Any]:
    values = [item.parameters[name] for item in items if name in item.parameters]
    unit = fm.display_unit(values[0].unit)
    difference, share = change(values)
    percent = 100.0 * difference / abs(values[0].value) if values[0].value else math.nan
    several = len(values) > 1
    return {
        "name": name,
        "unit": unit.text,
        "first": fm.significant(values[0].value, 4, unit.scale),
        "last": fm.significant(values[-1].value, 4, unit.scale),
        "half": fm.significant(values[-1].half, 2, unit.scale),
        "change": f"{fm.percent(percent, signed=True)} %" if several else fm.DASH,
        "share": fm.significant(abs(share), 2) if several and share else fm.DASH,
        "warn": several and abs(share) > 1.0,
        "runs": len(values),
    }


def _drift_plot(rig: str, items: Sequence[NightItem], names: Sequence[str]) -> Markup:
    """Draw every parameter over the night with its 95 % interval, in percent of its first value."""
    begin = items[0].ended
    assert begin is not None
    rows = -(-len(names) // _COLUMNS)
    with style():
        canvas = figure(1.35 * rows + 0.35, CARD * 2)
        for k, name in enumerate(names, start=1):
            axes = canvas.add_subplot(rows, _COLUMNS, k)
            shown = [item for item in items if name in item.parameters]
            hours = [(item.ended - begin).total_seconds() / 3600.0 for item in shown if item.ended]
            values = np.array([item.parameters[name].value for item in shown])
            half = np.array([item.parameters[name].half for item in shown])
            scale = 100.0 / abs(values[0]) if values[0] else 1.0
            percent = scale * (values - values[0])
            axes.axhline(0.0, color=PALE, lw=0.8)
            error = np.where(np.isfinite(half), scale * half, 0.0)
            axes.errorbar(hours, percent, yerr=error, fmt="o-", color=BLUE, ms=2.6, lw=0.8,
                          ecolor=GREY, elinewidth=0.8, capsize=1.5)  # fmt: skip
            axes.set_title(name)
            if k > len(names) - _COLUMNS:
                axes.set_xlabel("time [h]")
            if (k - 1) % _COLUMNS == 0:
                axes.set_ylabel("change [%]")
        canvas.tight_layout()
        key = "drift" + "".join(c for c in rig if c.isalnum())
        return svg(canvas, key, "Every parameter over the night, in percent of its first value")
