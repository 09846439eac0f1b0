"""One record reduced to what an identification needs of it: triangles, counts, noise.

A reduction is a few kilobytes whatever the record's length. It is made where the samples are (in
this process, in another, on a worker of a cluster) and only it travels;
`analysis.identify.identify` puts reductions together. Every record is kept in SEGMENTS parts of its
duration, because only when all records are known is it known whether a step has repeats to compare
or must compare its own parts.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.regression.chunks import STRETCH, InMemory, Source, divisible, source_rows
from analysis.regression.noise import record_moments
from analysis.regression.nonlinear import reduced
from analysis.regression.qr import Accumulator
from analysis.regression.rows import Filtering, Rows, parameters_of
from analysis.regression.solve import RowCluster, Solution, merge, solve
from analysis.signals.conditioning import Mask, lost_samples, moving_joints
from analysis.signals.locks import moving_of
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model import channels as ch
from rig.model.records import Record, RecordHead, Run, head_of
from rig.model.rig import Rig
from rig.runs.stream import open_record

Array = NDArray[np.float64]
Part = tuple[Array, int]  # triangle (k+1, k+1) of [X y] and its rows

SEGMENTS = 10  # parts of a record


@dataclass(frozen=True)
class RecordReduction:
    """What one record says: by family, one triangle per part; what was left out; its noise.

    `run` numbers the run; `noise` is the part of [X y]'[X y] that sensor noise makes, by family,
    None where another record of the step stands for it.
    """

    run: int
    head: RecordHead
    parts: Mapping[str, tuple[Part, ...]]
    masked: int
    lost: int
    clipped: Mapping[str, int]
    noise: Mapping[str, Array] | None = None


@dataclass(frozen=True)
class RecordTask:
    """One record to reduce, by where it is; picklable as long as terms and filtering are."""

    rig: Rig
    run: int
    path: str
    record: str
    terms: tuple[Used, ...]
    filtering: Callable[[Record], Filtering]
    with_noise: bool
    stretch: int = STRETCH
    moving: tuple[bool, ...] | None = None


def reduce_task(task: RecordTask) -> RecordReduction:
    """Reduce a record of a run folder; raises InputError naming record and channel."""
    with open_record(task.path, task.record) as reader:
        short = reader.head.samples <= task.stretch
        source: Source = InMemory(reader.read()) if short else reader
        return reduce_record(
            task.rig, task.run, source, task.terms, task.filtering, task.with_noise, task.stretch,
            None if task.moving is None else np.array(task.moving),
        )  # fmt: skip


@dataclass(frozen=True)
class StepTask:
    """The repeats of one step of a run folder, of which is asked which joints move."""

    rig: Rig
    path: str
    step: str
    records: tuple[str, ...]
    stretch: int = STRETCH


def steps_of(rig: Rig, path: str, heads: Sequence[RecordHead]) -> list[StepTask]:
    """Return the steps; repeats of one decide together whether its locks give."""
    names: dict[str, list[str]] = {}
    for head in heads:
        if head.locked:
            names.setdefault(head.step, []).append(head.name)
    return [StepTask(rig, path, step, tuple(n)) for step, n in names.items() if len(n) > 1]


def moving_task(task: StepTask) -> tuple[bool, ...]:
    """Return which joints (N,) move in a step; of a long record its first stretch tells."""
    thin = []
    for name in task.records:
        with open_record(task.path, name) as reader:
            thin.append(_positions(task.rig, reader.read(0, task.stretch)))
    return tuple(map(bool, moving_of(task.rig, thin)))


def _positions(rig: Rig, record: Record) -> Record:
    """Return the record with the positions of the locked joints alone."""
    names = [ch.channel(rig.position_kind, i) for i in record.locked]
    return replace(record, channels={n: x for n, x in record.channels.items() if n in names})


def _moving_here(rig: Rig, run: Run) -> dict[str, Mask]:
    """Return what `moving_task` does of all steps of a run at hand."""
    steps = steps_of(rig, "", [head_of(record) for record in run.records])
    return {
        one.step: moving_of(
            rig,
            [_positions(rig, InMemory(r).read(0, one.stretch)) for r in run.records
             if r.name in one.records],
        )
        for one in steps
    }  # fmt: skip


def path_of(task: RecordTask | StepTask) -> str:
    """Return the run folder that a task reads."""
    return task.path


def reduce_runs(
    rig: Rig,
    runs: Sequence[Run],
    terms: tuple[Used, ...],
    filtering: Callable[[Record], Filtering],
) -> list[RecordReduction]:
    """Reduce all records of runs at hand."""
    return [
        reduce_record(
            rig,
            number,
            InMemory(record),
            terms,
            filtering,
            record.name in first,
            moving=moving.get(record.step),
        )
        for number, run in enumerate(runs)
        for first, moving in ((first_of_steps(run.records), _moving_here(rig, run)),)
        for record in run.records
    ]


def first_of_steps(records: Sequence[Record | RecordHead]) -> set[str]:
    """Return the names of the records that stand for the noise of their step's repeats."""
    first: dict[str, str] = {}
    for record in records:
        first.setdefault(record.step, record.name)
    return set(first.values())


def reduce_record(
    rig: Rig,
    run: int,
    source: Source,
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    with_noise: bool,
    stretch: int = STRETCH,
    moving: Mask | None = None,
) -> RecordReduction:
    """Reduce one record, a long one in stretches; raises InputError for one that cannot be used.

    `moving` (N,) as for `source_rows`.
    """
    head = source.head
    filters = filtering(source.read(0, min(head.samples, stretch)))
    lost, clipped = _inspect(rig, source, stretch)
    sums = {
        family: [Accumulator(len(parameters_of(rig, terms, family))) for _ in range(SEGMENTS)]
        for family in FAMILIES
    }
    masked = 0
    for found in source_rows(rig, terms, source, filters, stretch, moving=moving):
        for name, rows in found.items():
            masked += rows.masked
            for part, inside in enumerate(parts_of(rows, head.samples / head.sample_rate)):
                sums[family_of(name)][part].fold(rows.matrix[inside], rows.rhs[inside])
    parts = {f: tuple((one.triangle, one.rows) for one in every) for f, every in sums.items()}
    noise = None
    if with_noise:
        # Of a long record a stretch stands for the whole.
        count = min(head.samples, stretch) if divisible(filters) else head.samples
        noise = _noise(rig, source, count, terms, filtering, moving)
    return RecordReduction(run, head, parts, masked, lost, clipped, noise)


def parts_of(rows: Rows, duration: float) -> list[slice]:
    """Cut rows, which are in the order of time, into SEGMENTS equal parts of a duration [s]."""
    edges = np.searchsorted(rows.time, np.linspace(0.0, duration, SEGMENTS + 1)[1:-1])
    ends = [0, *map(int, edges), len(rows.time)]
    return [slice(a, b) for a, b in pairwise(ends)]


def _inspect(rig: Rig, source: Source, stretch: int) -> tuple[int, dict[str, int]]:
    """Count lost and clipped samples; refuses a channel or joint that stood still."""
    head = source.head
    lost, clipped = 0, dict[str, int]()
    spans: dict[str, tuple[float, float]] = {}
    for first in range(0, head.samples, stretch):
        part = source.read(first, min(first + stretch, head.samples))
        lost += int(lost_samples(rig, part).any(axis=1).sum())
        for name, count in ck.clipped_counts(rig, part).items():
            clipped[name] = clipped.get(name, 0) + count
        for name, (low, high) in ck.spans_of(part).items():
            before = spans.get(name, (np.inf, -np.inf))
            spans[name] = (min(low, before[0]), max(high, before[1]))
    ck.refuse_dead_channels(rig, head, spans)
    return lost, clipped


def _noise(
    rig: Rig,
    source: Source,
    count: int,
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering],
    moving: Mask | None,
) -> dict[str, Array]:
    """Return the noise moments of a record, from its first `count` samples."""
    head = source.head
    # A stream of its own for every step: the prediction is the same in any order of records.
    rng = np.random.default_rng([0, zlib.crc32(head.step.encode())])
    part = source.read(0, count)
    moves = moving_joints(rig, part) if moving is None else moving
    found = record_moments(rig, part, terms, filtering, moves, rng)
    return {family: moment * (head.samples / count) for family, moment in found.items()}


def repeats_of(reductions: Sequence[RecordReduction]) -> dict[tuple[int, str], int]:
    """Count the repeats of every (run, step)."""
    seen: dict[tuple[int, str], set[int]] = {}
    for one in reductions:
        seen.setdefault((one.run, one.head.step), set()).add(one.head.repeat)
    return {key: len(values) for key, values in seen.items()}


def clusters_of(reductions: Sequence[RecordReduction], family: str) -> list[RowCluster]:
    """Return one cluster per record, or one per part where its step has this record only."""
    repeats = repeats_of(reductions)
    out: list[RowCluster] = []
    for one in reductions:
        stratum = (one.run, one.head.step)
        filled = [(n, R, rows) for n, (R, rows) in enumerate(one.parts[family]) if rows]
        if repeats[stratum] > 1:
            if filled:
                whole = merge(R for _, R, _ in filled)
                rows = sum(rows for *_, rows in filled)
                out.append(RowCluster(stratum, one.head.repeat, whole, rows))
            continue
        for n, R, rows in filled:
            key: Hashable = (one.head.repeat, n)
            out.append(RowCluster(stratum, key, R, rows))
    return out


def noise_of(reductions: Sequence[RecordReduction], family: str) -> Array | None:
    """Return the noise moments of all records, each step's by the record that stands for it."""
    counts: dict[tuple[int, str], int] = {}
    for one in reductions:
        key = (one.run, one.head.step)
        counts[key] = counts.get(key, 0) + 1
    found = [
        counts[one.run, one.head.step] * one.noise[family]
        for one in reductions
        if one.noise is not None and family in one.noise
    ]
    return np.sum(found, axis=0) if found else None


def solve_reductions(
    rig: Rig,
    terms: Sequence[Used],
    reductions: Sequence[RecordReduction],
    reject_noise: bool = True,
) -> dict[str, Solution]:
    """Solve each family once from the triangles of all records."""
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, terms, family)
        if names:
            clusters, noise = clusters_of(reductions, family), noise_of(reductions, family)
            linear = solve(names, clusters, noise, reject_noise)
            out[family] = reduced(rig, terms, linear, clusters, noise, reject_noise)
    return out
