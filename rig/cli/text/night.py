"""Make the page of the night: results of a queue's items and their run folders."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from analysis.report.night import Night, NightEstimate, NightItem, render
from analysis.report.page import write
from rig.queue.items import Item
from rig.queue.store import QueueStore
from rig.runs.listing.summary import summarise
from rig.runs.runstate import computer_name
from rig.runs.store import is_run


def night_of(store: QueueStore, since: datetime | None) -> Night:
    """Return the page's data: items ended or started since a time, and waiting ones."""
    items = [item for item in store.items() if since is None or _recent(item, since)]
    order = sorted(items, key=lambda item: (item.started or "9", item.id))
    notes = [
        (datetime.fromisoformat(line.time), f"{line.event}: {line.reason}".removesuffix(": "))
        for line in store.history()
        if line.item is None
    ]
    return Night(
        queue=str(store.path),
        host=computer_name(),
        made=datetime.now(UTC),
        items=tuple(map(_night_item, order)),
        notes=tuple(note for note in notes if since is None or note[0] >= since),
        paused=store.paused,
    )


def _recent(item: Item, since: datetime) -> bool:
    times = (item.ended, item.started)
    return not item.over or any(time and datetime.fromisoformat(time) >= since for time in times)


def _time(text: str) -> datetime | None:
    return datetime.fromisoformat(text) if text else None


def _night_item(item: Item) -> NightItem:
    folder = Path(item.run) if item.run else None
    summary = summarise(folder) if folder is not None and is_run(folder) else None
    parameters = item.results.get("parameters") or {}
    return NightItem(
        number=item.id,
        name=item.job.name,
        state=item.state,
        reason=item.reason,
        rig=summary.rig if summary is not None and summary.rig else item.job.rig,
        run=item.run,
        started=_time(item.started),
        ended=_time(item.ended),
        attempts=item.attempt,
        records=-1 if summary is None else summary.records,
        samples=-1 if summary is None else summary.samples,
        lost_samples=-1 if summary is None else summary.lost_samples,
        seconds=-1.0 if summary is None else summary.seconds,
        parameters={
            name: NightEstimate(float(p["value"]), _half(p.get("ci95")), str(p.get("unit", "")))
            for name, p in parameters.items()
            if p.get("value") is not None
        },
        unidentified=str(item.results.get("error", "")),
    )


def _half(interval: Sequence[float | None] | None) -> float:
    """Return half of a 95 % interval (low, high), NaN without one."""
    low, high = interval or (None, None)
    return math.nan if low is None or high is None else 0.5 * (high - low)


def write_page(path: Path, store: QueueStore, since: datetime | None = None) -> None:
    """Write the page of the night; raises InputError if the file cannot be written."""
    write(path, render(night_of(store, since)))
