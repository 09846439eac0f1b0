"""Identify from run folders that need not fit into memory, in this process or where they are.

Every record is reduced where its samples are (in this process, in another, on a worker of a
cluster), a long one chunk by chunk, and only the reductions (`analysis.identify.reduction`) are
sent on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.effects.base import open_shapes
from analysis.identify import checks as ck
from analysis.identify.coupled import conclude
from analysis.identify.geometry import shifts_of_reductions
from analysis.identify.reduction import RecordReduction, folded
from analysis.identify.result import Identification
from analysis.identify.settings import IDENTIFY
from analysis.regression.chunks import InMemory, Source, divisible, source_rows
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.noise import record_moments
from analysis.regression.rows import Filtering, default_filtering, record_rows
from analysis.regression.settings import REGRESSION
from analysis.signals.conditioning import condition, lost_samples
from analysis.signals.locks import motion_bands
from analysis.signals.settings import SIGNALS
from analysis.simulation.model import Model, refuse_other_rig
from analysis.terms import with_effects
from analysis.terms.base import Used
from analysis.workers.pool import Pool, Serial
from rig.model import channels as ch
from rig.model.parse import InputError
from rig.model.records import Record
from rig.model.rig import Rig
from rig.runs.stream import RunHead, open_record, read_run_head

RECORDS_TOGETHER = 6  # most records given to a worker at once: progress is reported between them


@dataclass(frozen=True)
class StepTask:
    """The records of one step of run number `run`, to find which joints move in it."""

    rig: Rig
    run: int
    path: str
    step: str
    records: tuple[str, ...]


@dataclass(frozen=True)
class RecordTask:
    """A record of run number `run` to reduce; picklable as long as terms and filtering are.

    `bands` (N,) [Hz] is the decision for all repeats of its step (`analysis.signals.locks`), by
    default of this record alone. A record is read in stretches of `stretch` samples.
    """

    rig: Rig
    run: int
    path: str
    record: str
    terms: Sequence[Used]
    filtering: Callable[[Record], Filtering]
    with_noise: bool
    bands: tuple[float, ...] | None = None
    stretch: int = REGRESSION.chunk_samples


def identify_folders(
    folders: Sequence[str],
    filtering: Callable[[Record], Filtering] = default_filtering,
    pool: Pool | None = None,
    effects: Sequence[str] = (),
    like: Model | None = None,
    progress: Callable[[float], None] | None = None,
) -> Identification:
    """Identify from run folders, of which one record at a time is in memory.

    This is `identify` by the coupled method with the estimator "plain", because the other methods
    and estimators need all rows repeatedly. The terms are those of the model `like`, or the rig's
    baseline with `effects` (`analysis.terms.with_effects`). The records are read once more for
    every number of the rig with a tolerance (`analysis.identify.geometry`). With a `pool` each
    record is reduced in one of its processes, where the folders are read; only triangles come back.
    `progress` receives the share of the records reduced, 0 to 1. Raises InputError as
    `identify` and `load_run` do, for a model of another rig, and for an effect whose shape is open.
    """
    workers = pool or Serial()
    heads = list(workers.map(read_run_head, folders, reads=str))
    rig = ck.common_rig(heads)
    used = tuple(map(Used, with_effects(rig, effects)))
    if like is not None:
        for head in heads:
            refuse_other_rig(like, head.rig, head.source)
        used = tuple(like.terms)
    _refuse_open_shapes(rig, used)
    steps = [
        step
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True))
        for step in _locked_steps(rig, number, folder, head)
    ]
    decisions = workers.map(step_bands, steps, reads=lambda step: step.path)
    bands = {(s.run, s.step): band for s, band in zip(steps, decisions, strict=True)}
    rigs = [rig, *map(rig.with_moved, rig.uncertain_numbers)]
    tasks = []
    for variant in rigs:
        for number, (folder, head) in enumerate(zip(folders, heads, strict=True)):
            steps_seen: set[str] = set()
            for record in head.records:
                # The noise of one record represents all repeats of its step.
                with_noise = variant is rig and record.step not in steps_seen
                steps_seen.add(record.step)
                band = bands.get((number, record.step))
                tasks.append(
                    RecordTask(
                        variant, number, folder, record.name, used, filtering, with_noise, band
                    )
                )
    reductions: list[RecordReduction] = []
    groups = _groups(tasks, workers.workers)
    for group in workers.map(reduce_records, groups, reads=lambda part: part[0].path):
        reductions += group
        if progress is not None:
            progress(len(reductions) / len(tasks))
    count = len(tasks) // len(rigs)
    unchanged, *moved = (reductions[k : k + count] for k in range(0, len(tasks), count))
    geometry = shifts_of_reductions(rig, used, unchanged, moved)
    return conclude(rig, [head.source for head in heads], used, unchanged, geometry=geometry)


def _groups(tasks: Sequence[RecordTask], workers: int) -> list[list[RecordTask]]:
    """Return the tasks in groups of one folder, at least four groups for each worker.

    A cluster needs some milliseconds to send an item, as much as the reduction of a short record.
    """
    size = max(1, min(RECORDS_TOGETHER, len(tasks) // (4 * workers)))
    groups: list[list[RecordTask]] = []
    for task in tasks:
        if not groups or len(groups[-1]) == size or groups[-1][0].path != task.path:
            groups.append([])
        groups[-1].append(task)
    return groups


def _refuse_open_shapes(rig: Rig, terms: Sequence[Used]) -> None:
    """Raise InputError for an effect whose shape must be searched with all rows in memory."""
    for used in terms:
        if open_shapes(rig, used):
            raise InputError(
                f"--with {used.term.name} has a shape to be found in rows that are all in memory: "
                "identify a part of the records without --stream or --cluster, write its --model, "
                "and take the shape from there with --like"
            )


def _locked_steps(rig: Rig, run: int, path: str, head: RunHead) -> list[StepTask]:
    """Return the steps with a locked joint, whose repeats decide together which joints move."""
    names: dict[str, list[str]] = {}
    for record in head.records:
        names.setdefault(record.step, []).append(record.name)
    locked = {record.step for record in head.records if record.locked}
    return [StepTask(rig, run, path, s, tuple(n)) for s, n in names.items() if s in locked]


def step_bands(task: StepTask) -> tuple[float, ...]:
    """Return the band (N,) [Hz] in which each joint moves in a step, from all its repeats."""
    repeats = []
    for name in task.records:
        with open_record(task.path, name) as reader:
            record = reader.read(0, min(reader.head.samples, SIGNALS.deciding_samples))
            places = [ch.channel(task.rig.position_kind, i) for i in record.locked]
            channels = {n: x for n, x in record.channels.items() if n in places}
            repeats.append(replace(record, channels=channels))
    return tuple(map(float, motion_bands(task.rig, repeats)))


def reduce_records(tasks: Sequence[RecordTask]) -> list[RecordReduction]:
    """Reduce records of run folders one after the other; raises InputError for an unusable one."""
    out = []
    for task in tasks:
        with open_record(task.path, task.record) as reader:
            short = reader.head.samples <= task.stretch
            out.append(reduce_record(task, InMemory(reader.read()) if short else reader))
    return out


def reduce_record(task: RecordTask, source: Source) -> RecordReduction:
    """Reduce one record, a long one chunk by chunk; raises InputError naming record and channel."""
    rig, terms, stretch, head = task.rig, task.terms, task.stretch, source.head
    filtering = task.filtering(source.read(0, min(head.samples, stretch)))
    lost, clipped = _inspect(rig, source, stretch)
    if task.bands is None:
        bands = motion_bands(rig, [source.read(0, min(head.samples, SIGNALS.deciding_samples))])
    else:
        bands = np.array(task.bands)
    chunks = source_rows(rig, terms, source, filtering, bands, stretch)
    duration = head.samples / head.sample_rate
    parts, masked = folded(rig, terms, chunks, duration, IDENTIFY.record_segments)
    noise = None
    if task.with_noise:
        # The first chunk represents a long record.
        count = min(head.samples, stretch) if divisible(filtering) else head.samples
        part = source.read(0, count)
        signals = condition(rig, part, filtering.channels, bands)
        rows = record_rows(rig, terms, signals, filtering)
        conditioned = ConditionedRecord(task.run, part, signals, filtering)
        moments = record_moments(rig, terms, conditioned, rows)
        noise = {family: moment * (head.samples / count) for family, moment in moments.items()}
    return RecordReduction(task.run, head, parts, masked, lost, clipped, noise)


def _inspect(rig: Rig, source: Source, stretch: int) -> tuple[int, dict[str, int]]:
    """Count lost and clipped samples; raises InputError for a constant channel or joint."""
    head = source.head
    lost, clipped = 0, dict[str, int]()
    spans: dict[str, tuple[float, float]] = {}
    for first in range(0, head.samples, stretch):
        part = source.read(first, min(first + stretch, head.samples))
        lost += int(lost_samples(rig, part).any(axis=1).sum())
        for name, count in ck.clipped_counts(rig, part).items():
            clipped[name] = clipped.get(name, 0) + count
        for name, (low, high) in ck.spans_of(part).items():
            span = spans.get(name, (np.inf, -np.inf))
            spans[name] = (min(low, span[0]), max(high, span[1]))
    ck.refuse_constant_channels(rig, head, spans)
    return lost, clipped
