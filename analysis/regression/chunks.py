"""Rows of a long record, chunk by chunk, equal to those of the record as a whole.

A row at sample c needs the samples within reach of the channel filter, the row filter and the
alignment. A chunk contains the rows of the samples [start, stop) and reads that many more on either
side, starting at a multiple of the decimation so that all chunks share one grid of rows. Which
locked joints move and where the others stand is decided beforehand, for all chunks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from analysis.regression.rows import Array, Filtering, Rows, record_rows
from analysis.regression.settings import REGRESSION
from analysis.signals.conditioning import align_reach, condition
from analysis.signals.filters import FirSmoother
from analysis.signals.locks import band_reach, held_positions
from analysis.terms.base import FAMILIES, Term, Used
from rig.model.records import Record, RecordHead, head_of
from rig.model.rig import Rig


class Source(Protocol):
    """A record whose samples are read on demand."""

    @property
    def head(self) -> RecordHead:
        """The record's description without samples."""

    def read(self, start: int = 0, stop: int | None = None) -> Record:
        """Return the samples [start, stop) as a record of their own."""


class InMemory:
    """A record in memory as a source."""

    def __init__(self, record: Record) -> None:
        self.head = head_of(record)
        self._record = record

    def read(self, start: int = 0, stop: int | None = None) -> Record:
        """Return the samples [start, stop), without copying."""
        if start == 0 and stop is None:
            return self._record
        part = slice(start, stop)
        return self.head.record({n: x[part] for n, x in self._record.channels.items()})


@dataclass(frozen=True)
class Locks:
    """A whole record's bands (N,) [Hz] of the joints' motion, and held positions (N,) [m]."""

    bands: Array
    held: Array


def overlap(rig: Rig, rate: float, filtering: Filtering, bands: Array) -> int:
    """Return the number of samples on either side that a row depends on, plus one grid step."""
    rows = 0 if filtering.rows is None else filtering.rows.reach
    reach = filtering.channels.reach + rows + align_reach(rig, rate) + band_reach(rate, bands)
    return reach + filtering.step


def divisible(filtering: Filtering) -> bool:
    """Return whether the filters are finite, so that a record may be read in chunks."""
    return isinstance(filtering.channels, FirSmoother)


def stretch_rows(
    rig: Rig,
    terms: Sequence[Used],
    part: Record,
    offset: int,
    samples: tuple[int, int],
    filtering: Filtering,
    locks: Locks,
    families: Collection[str] = tuple(FAMILIES),
) -> dict[str, Rows]:
    """Return the rows of the samples samples[0] .. samples[1] - 1 of a record from a part of it.

    `part` starts at the record's sample `offset`, a multiple of the filtering's step; times of the
    rows count from the record's start.
    """
    rate = part.sample_rate
    within = ((samples[0] - offset - 0.5) / rate, (samples[1] - offset - 0.5) / rate)
    signals = condition(rig, part, filtering.channels, locks.bands, locks.held)
    stretch = record_rows(rig, terms, signals, filtering, families, within)
    if offset == 0:
        return stretch
    return {name: replace(rows, time=rows.time + offset / rate) for name, rows in stretch.items()}


def source_rows(
    rig: Rig,
    terms: Sequence[Used],
    source: Source,
    filtering: Filtering,
    bands: Array,
    stretch: int = REGRESSION.chunk_samples,
) -> Iterator[dict[str, Rows]]:
    """Yield all rows of a record, in chunks of `stretch` samples.

    `bands` (N,) [Hz] is the decision for all repeats of the step (`analysis.signals.locks`). A term
    that prepares signals may depend on all earlier samples, as does a filter of infinite length:
    then the record is read at once.
    """
    n = source.head.samples
    parts = (source.read(a, min(a + stretch, n)) for a in range(0, n, stretch))
    locks = Locks(bands, held_positions(rig, parts))
    prepares = any(type(used.term).prepare is not Term.prepare for used in terms)
    if n <= stretch or prepares or not divisible(filtering):
        yield stretch_rows(rig, terms, source.read(), 0, (0, n), filtering, locks)
        return
    spare = overlap(rig, source.head.sample_rate, filtering, bands)
    for start in range(0, n, stretch):
        stop = min(start + stretch, n)
        offset = max(0, start - spare) // filtering.step * filtering.step
        part = source.read(offset, min(stop + spare, n))
        yield stretch_rows(rig, terms, part, offset, (start, stop), filtering, locks)
