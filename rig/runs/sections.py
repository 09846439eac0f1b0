"""Sections of a journal: the marked records, and the samples between them.

A record keeps a continuous time base: row k is tick start + k, and a sample that never arrived is
NaN in every channel, counted in `lost_samples`. (Splitting a record at a gap would make repeats
incomparable, which need the same excitation from the same sample on.) A record that was not
finished when the run ended is kept up to its last sample, with `complete` 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rig.runs.journal import Block, Journal, Mark, Spans
from rig.runs.runstate import BETWEEN

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Section:
    """A tick range of one stream and its group in the archive."""

    group: str
    stream: int
    start: int
    ticks: int
    complete: bool
    meta: dict[str, Any] = field(default_factory=dict)

    @property
    def end(self) -> int:
        """The first tick after the section."""
        return self.start + self.ticks


@dataclass(frozen=True)
class Assembled:
    """A section's samples (ticks, columns), NaN if lost, and its counts."""

    data: Array
    lost: int
    damaged_blocks: int
    late_blocks: int
    jitter_max: float
    saturated: NDArray[np.int64]


@dataclass(frozen=True)
class Written:
    """Contents of an archive: records (complete or not), samples in them, and lost samples.

    `outside` counts the samples between records.
    """

    records: int
    partial: int
    samples: int
    lost_samples: int
    damaged_blocks: int
    outside: int = 0


@dataclass(frozen=True)
class _Run:
    """Ticks [start, end) of a stream that arrived without a gap."""

    stream: int
    start: int
    end: int


def _runs(spans: Spans) -> list[_Run]:
    if len(spans.id) == 0:
        return []
    end = spans.tick + spans.samples
    is_start = (spans.stream[1:] != spans.stream[:-1]) | (spans.tick[1:] != end[:-1])
    starts = np.concatenate(([0], np.flatnonzero(is_start) + 1))
    stops = np.concatenate((np.flatnonzero(is_start), [len(end) - 1]))
    return [
        _Run(int(spans.stream[a]), int(spans.tick[a]), int(end[b]))
        for a, b in zip(starts, stops, strict=True)
    ]


def _extent(runs: Sequence[_Run]) -> dict[int, tuple[int, int]]:
    """Return the first and one past the last tick of every stream."""
    extents: dict[int, tuple[int, int]] = {}
    for run in runs:
        low, high = extents.get(run.stream, (run.start, run.end))
        extents[run.stream] = (min(low, run.start), max(high, run.end))
    return extents


def _record(mark: Mark, extent: dict[int, tuple[int, int]]) -> Section | None:
    if mark.state == "discarded" or mark.stream not in extent:
        return None
    low, high = extent[mark.stream]
    wanted_end = high if mark.ticks is None else mark.start + mark.ticks
    # Missing leading samples are lost samples of the record and do not change its start.
    ticks = min(wanted_end, high) - mark.start
    if ticks <= 0 or wanted_end <= low:
        return None
    complete = mark.state == "complete" and high >= wanted_end
    name = str(mark.meta["name"])
    return Section(name, mark.stream, mark.start, ticks, complete, mark.meta)


def _unmarked(runs: Sequence[_Run], records: Sequence[Section]) -> list[Section]:
    """Return sections of the samples outside all records; a gap begins another section."""
    unmarked: list[Section] = []
    for run in runs:
        pieces = [(run.start, run.end)]
        for record in (r for r in records if r.stream == run.stream):
            pieces = [
                piece
                for a, b in pieces
                for piece in ((a, min(b, record.start)), (max(a, record.end), b))
                if piece[0] < piece[1]
            ]
        for a, b in pieces:
            group = f"{BETWEEN}/{len(unmarked) + 1:04d}"
            unmarked.append(Section(group, run.stream, a, b - a, True))
    return unmarked


def plan(journal: Journal, spans: Spans) -> list[Section]:
    """Return the records, then the sections between them; together they hold every sample once."""
    runs = _runs(spans)
    extent = _extent(runs)
    records = [r for mark in journal.marks() if (r := _record(mark, extent)) is not None]
    return [*records, *_unmarked(runs, records)]


def blocks_of(
    journal: Journal, spans: Spans, section: Section
) -> Iterator[tuple[Block | None, slice, slice]]:
    """Yield (block, rows of the section, rows of the block); a damaged block is (None, ...)."""
    inside = spans.id[
        (spans.stream == section.stream)
        & (spans.tick < section.end)
        & (spans.tick + spans.samples > section.start)
    ]
    if len(inside) == 0:
        return
    numbers = set(inside.tolist())
    for number, block in journal.blocks(int(inside[0]), int(inside[-1])):
        if number not in numbers:
            continue
        yield (block, *(overlap(section, block) if block else (slice(0, 0), slice(0, 0))))


def assemble(journal: Journal, spans: Spans, section: Section) -> Assembled:
    """Put a section's samples in place by their tick."""
    columns, measured = len(journal.meta("columns")), int(journal.meta("measured"))
    tick = 1.0 / float(journal.meta("sample_rate"))
    data = np.full((section.ticks, columns), np.nan)
    arrived = np.zeros(section.ticks, dtype=bool)
    saturated = np.zeros(measured, dtype=np.int64)
    damaged = late = 0
    jitter = 0.0
    for block, rows, block_rows in blocks_of(journal, spans, section):
        if block is None:
            damaged += 1
            continue
        data[rows], arrived[rows] = block.data[block_rows], True
        saturated += block.saturated[block_rows].sum(axis=0)
        if block.late is not None:
            jitter = max(jitter, block.late)
            late += block.late > len(block.data) * tick
    return Assembled(data, int((~arrived).sum()), damaged, int(late), jitter, saturated)


def overlap(section: Section, block: Block) -> tuple[slice, slice]:
    """Return (rows of the section, rows of the block) that are the same ticks."""
    first = max(section.start, block.tick)
    last = max(first, min(section.end, block.tick + len(block.data)))
    return (
        slice(first - section.start, last - section.start),
        slice(first - block.tick, last - block.tick),
    )
