"""Long records in stretches: each filtered with enough overlap that its rows are the record's own.

A row at sample c needs the samples within the channels' filter, the row filter and the alignment
of it. A stretch owns the rows of the samples [first, last) and reads that much more either side,
starting at a multiple of the decimation so that all stretches share one grid of rows. The record's
own ends stay its ends. What belongs to the whole record (does a lock give, where does it hold) is
found beforehand, and given to every stretch.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from analysis.regression.rows import Filtering, Rows, record_rows
from analysis.signals.conditioning import (
    GIVE_BAND,
    GIVE_THRESHOLD,
    Mask,
    align_reach,
    bridged,
    condition,
    held_pistons,
    moving_joints,
)
from analysis.signals.filters import FirSmoother, row_filter
from analysis.terms.base import FAMILIES, Term, Used
from rig.model import channels as ch
from rig.model.records import Record, RecordHead, head_of
from rig.model.rig import Rig

Array = NDArray[np.float64]

STRETCH = 120_000  # samples read at a time; two joints then need about 150 MB


class Source(Protocol):
    """A record whose samples are read when asked for."""

    @property
    def head(self) -> RecordHead:
        """What is known without samples."""

    def read(self, first: int = 0, last: int | None = None) -> Record:
        """Return the samples [first, last) as a record of their own."""


class InMemory:
    """A record at hand as a source."""

    def __init__(self, record: Record) -> None:
        self.head = head_of(record)
        self._record = record

    def read(self, first: int = 0, last: int | None = None) -> Record:
        """Return the samples [first, last), without copying."""
        if first == 0 and last is None:
            return self._record
        part = slice(first, last)
        return self.head.record({n: x[part] for n, x in self._record.channels.items()})


@dataclass(frozen=True)
class Locks:
    """Which joints (N,) move, and where (N,) [m] the others stand: facts of a whole record."""

    moving: Mask
    held: Array


def overlap(rig: Rig, rate: float, filtering: Filtering) -> int:
    """Return how many samples either side of a row's own decide it, and one grid step more."""
    rows = 0 if filtering.rows is None else filtering.rows.reach
    return filtering.channels.reach + rows + align_reach(rig, rate) + filtering.step


def divisible(filtering: Filtering) -> bool:
    """Tell whether the filters are finite, so that a record may be taken in stretches."""
    return isinstance(filtering.channels, FirSmoother)


def stretch_rows(
    rig: Rig,
    terms: Sequence[Used],
    part: Record,
    offset: int,
    own: tuple[int, int],
    filtering: Filtering,
    locks: Locks | None = None,
    families: Collection[str] = tuple(FAMILIES),
) -> dict[str, Rows]:
    """Return the rows of the samples own[0] .. own[1] - 1 of a record from a part of it.

    `part` starts at the record's sample `offset`, a multiple of the filtering's step; times of the
    rows count from the record's start. `locks` is needed unless `part` is the whole record.
    """
    rate = part.sample_rate
    within = ((own[0] - offset - 0.5) / rate, (own[1] - offset - 0.5) / rate)
    moving, held = (None, None) if locks is None else (locks.moving, locks.held)
    signals = condition(rig, part, filtering.channels, moving, held)
    found = record_rows(rig, terms, signals, filtering, families, within)
    if offset == 0:
        return found
    return {name: replace(rows, time=rows.time + offset / rate) for name, rows in found.items()}


def source_rows(
    rig: Rig,
    terms: Sequence[Used],
    source: Source,
    filtering: Filtering,
    stretch: int = STRETCH,
    families: Collection[str] = tuple(FAMILIES),
    moving: Mask | None = None,
) -> Iterator[dict[str, Rows]]:
    """Yield the rows of a record, stretch by stretch; together they are the whole record's.

    `moving` (N,) tells which joints move where more than this record decides it
    (`analysis.signals.locks`). A term that prepares signals may look back any time: it gets all at
    once.
    """
    n = source.head.samples
    prepares = any(type(used.term).prepare is not Term.prepare for used in terms)
    if n <= stretch or prepares or not divisible(filtering):
        whole = source.read()
        given = None if moving is None else Locks(moving, held_pistons(rig, whole))
        yield stretch_rows(rig, terms, whole, 0, (0, n), filtering, given, families)
        return
    locks = locks_of(rig, source, stretch)
    if moving is not None:
        locks = replace(locks, moving=moving)
    spare = overlap(rig, source.head.sample_rate, filtering)
    for first in range(0, n, stretch):
        last = min(first + stretch, n)
        offset = max(0, first - spare) // filtering.step * filtering.step
        part = source.read(offset, min(last + spare, n))
        yield stretch_rows(rig, terms, part, offset, (first, last), filtering, locks, families)


def locks_of(rig: Rig, source: Source, stretch: int = STRETCH) -> Locks:
    """Find, stretch by stretch, what `moving_joints` and `held_pistons` find in a whole record."""
    head, N = source.head, len(rig.joints)
    if head.samples <= stretch:
        record = source.read()
        return Locks(moving_joints(rig, record), held_pistons(rig, record))
    band = row_filter(head.sample_rate, GIVE_BAND)
    total, count = np.zeros(N), np.zeros(N)
    moments = np.zeros((3, N))  # samples, sum, sum of squares of the acceleration
    for first in range(0, head.samples, stretch):
        last = min(first + stretch, head.samples)
        low, high = max(0, first - band.reach), min(last + band.reach, head.samples)
        part = source.read(low, high)
        for i in range(N):
            piston = np.asarray(part.channels[ch.channel(rig.position_kind, i + 1)])
            own = piston[first - low : last - low]
            here = own[~np.isnan(own)]
            total[i] += here.sum()
            count[i] += len(here)
            if high - low > 2 * band.reach:
                inner = band.apply(bridged(piston), 2)[band.reach : -band.reach]
                moments[:, i] += np.array([len(inner), inner.sum(), inner @ inner])
    size = np.maximum(moments[0], 1.0)
    spread = np.sqrt(np.maximum(moments[2] / size - (moments[1] / size) ** 2, 0.0))
    floor = rig.sensors.of(rig.position_kind).noise * float(np.linalg.norm(band.taps[2]))
    excited = np.array([i not in head.locked for i in range(1, N + 1)])
    moving = excited | (spread > GIVE_THRESHOLD * floor)
    return Locks(moving, total / np.maximum(count, 1.0))
