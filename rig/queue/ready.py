"""Decides whether an item can start now, must wait, or never can. No I/O."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

from rig.queue.items import (
    DONE,
    ENDED,
    EXPIRED,
    OVER,
    QUEUED,
    SKIPPED,
    Item,
    QueueJob,
    channel_condition,
    result_condition,
    result_value,
)


@dataclass(frozen=True)
class Readiness:
    """Whether an item can start; `state` is '' while it can start later, else its final state."""

    start: bool
    reason: str = ""
    state: str = ""


# Channel means in SI, or the reason why they cannot be read.
Reading = Callable[[QueueJob], Mapping[str, float] | str]
InUse = Callable[[QueueJob], str]  # who has the bench, '' where it may be free


def _shown(moment: datetime) -> str:
    return moment.astimezone().strftime("%Y-%m-%d %H:%M")


def _wait(reason: str) -> Readiness:
    return Readiness(False, reason)


def dependence(item: Item, items: Mapping[int, Item]) -> Readiness:
    """Evaluate an item's condition on an earlier item."""
    wanted = item.job.wanted
    if item.job.after is None:
        return Readiness(True)
    prior = items[item.job.after]
    if not prior.over:
        return _wait(f"item {prior.id} is {prior.state}")
    if wanted in (ENDED, prior.state):
        return Readiness(True)
    if wanted in OVER or prior.state != DONE:
        expected = wanted if wanted in OVER else DONE
        return Readiness(False, f"item {prior.id} is {prior.state}; wanted: {expected}", SKIPPED)
    return _compared(wanted, prior)


def _compared(wanted: str, prior: Item) -> Readiness:
    condition = result_condition(wanted)
    value = result_value(prior.results, condition)
    if value is None:
        why = prior.results.get("error", f"{condition.name} was not identified")
        return Readiness(False, f"{wanted!r} of item {prior.id} cannot be judged: {why}", SKIPPED)
    if condition.holds(value):
        return Readiness(True)
    part = f"{condition.name}.{condition.part}"
    return Readiness(False, f"{part} of item {prior.id} is {value:.4g}; wanted: {wanted}", SKIPPED)


def judge(
    item: Item, others: Mapping[int, Item], moment: datetime, read: Reading, in_use: InUse
) -> Readiness:
    """Evaluate one queued item; `read` is called last, and only for a condition on a channel."""
    job = item.job
    if job.not_after and moment >= datetime.fromisoformat(job.not_after):
        late = _shown(datetime.fromisoformat(job.not_after))
        wait = dependence(item, others).reason or (job.when and f"waited for {job.when}")
        return Readiness(False, f"could not start before {late}" + (wait and f": {wait}"), EXPIRED)
    depends = dependence(item, others)
    if not depends.start:
        return depends
    if job.not_before and moment < datetime.fromisoformat(job.not_before):
        return _wait(f"not before {_shown(datetime.fromisoformat(job.not_before))}")
    if holder := in_use(job):
        return _wait(f"waits for the bench: {holder}")
    return _channel(job, read) if job.when else Readiness(True)


def _channel(job: QueueJob, read: Reading) -> Readiness:
    condition = channel_condition(job.when)
    reading = read(job)
    if isinstance(reading, str):
        return _wait(f"waits for {job.when}; the bench cannot be read: {reading}")
    value = reading.get(condition.name)
    if value is None:
        return _wait(f"waits for {job.when}; the bench does not measure {condition.name}")
    if condition.holds(value):
        return Readiness(True)
    return _wait(f"waits for {job.when}; it is {value:.4g}")


def choose(
    items: Sequence[Item], moment: datetime, read: Reading, in_use: InUse
) -> tuple[Item | None, list[tuple[Item, Readiness]]]:
    """Return the first item that can start now, and the results for those before it."""
    others = {item.id: item for item in items}
    passed: list[tuple[Item, Readiness]] = []
    for item in items:
        if item.state != QUEUED:
            continue
        verdict = judge(item, others, moment, read, in_use)
        if verdict.start:
            return item, passed
        passed.append((item, verdict))
    return None, passed
