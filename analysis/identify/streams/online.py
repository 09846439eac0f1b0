"""Identify while the bench runs: a square-root information filter, updated row by row.

The rows equal those of `analysis.identify.identify`: samples are filtered in chunks with the
overlap that zero-phase filters need, so that a row is available `RowFeed.delay` seconds late. A
chunk's rows are folded into the triangle R of all before,

    R'R  <-  w R'R + [X y]' W [X y],     w = exp(-dt/memory),

(Bierman, Factorization Methods, ch. V; with memory infinite, w = 1, this is the batch solution).
Forgetting goes by the device's clock, so that a changing parameter is followed whatever is excited.
Information on an unexcited parameter fades, but never below `online_floor` of its column's largest:
from there its value is held and marked as held, to keep rounding errors out.

By default the flow rows are used (b and the gains), which do not depend on the locked joints.
Torque rows can be used as well; locked joints then count as moving as measured, whereas `identify`
decides from all repeats of a step (`analysis.signals.locks`).
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.result import estimates_of
from analysis.identify.settings import IDENTIFY
from analysis.regression.chunks import Locks, overlap, stretch_rows
from analysis.regression.rows import Filtering, Rows, default_filtering, parameters_of
from analysis.regression.solve import Accumulator, RowCluster, Solution, merge, solve
from analysis.simulation.model import Estimate
from analysis.terms import baseline_of
from analysis.terms.base import Used, family_of
from rig.model.parse import InputError
from rig.model.records import Record, RecordHead, head_of
from rig.model.rig import Rig

Array = NDArray[np.float64]


class RowFeed:
    """Rows of one record, built while its samples arrive; the filters must be of finite length."""

    def __init__(
        self,
        rig: Rig,
        terms: Sequence[Used],
        head: RecordHead,
        filtering: Filtering,
        families: Collection[str],
    ) -> None:
        N = len(rig.joints)
        self.head = head
        self._rig, self._terms, self._filtering = rig, terms, filtering
        self._families = families
        self._chunk = round(IDENTIFY.online_chunk * head.sample_rate)
        self._locks = Locks(np.full(N, np.inf), np.zeros(N))
        self._overlap = overlap(rig, head.sample_rate, filtering, self._locks.bands)
        self._waiting: list[Mapping[str, Array]] = []
        self._offset = self._next = self._received = 0

    @property
    def delay(self) -> float:
        """The largest delay of a row [s]."""
        return (self._overlap + self._chunk) / self.head.sample_rate

    def feed(self, channels: Mapping[str, Array]) -> dict[str, Rows]:
        """Add the next samples, NaN where lost; return the completed rows by equation, if any."""
        self._waiting.append(channels)
        self._received += len(next(iter(channels.values())))
        last = self._received - self._overlap
        return self._rows_until(last) if last - self._next >= self._chunk else {}

    def finish(self) -> dict[str, Rows]:
        """Return the remaining rows, up to the record's end."""
        return self._rows_until(self._received) if self._received else {}

    def _rows_until(self, last: int) -> dict[str, Rows]:
        names = self._waiting[0]
        part: dict[str, Array] = {n: np.concatenate([w[n] for w in self._waiting]) for n in names}
        interval = (self._next, last)
        rows = stretch_rows(
            self._rig, self._terms, self.head.record(part), self._offset, interval,
            self._filtering, self._locks, self._families,
        )  # fmt: skip
        step = self._filtering.step
        offset = max(0, last - self._overlap) // step * step
        cut = offset - self._offset
        self._waiting = [{name: x[cut:] for name, x in part.items()}]
        self._offset, self._next = offset, last
        return rows


@dataclass(frozen=True)
class OnlineResidual:
    """Prediction error of a chunk by the estimates before it: `rms` of y - X beta, `size` of y.

    Both are in the rows' unit. The rows were not yet in the estimates, as with held-out rows.
    """

    rms: float
    size: float


@dataclass(frozen=True)
class _Segment:
    """The rows of one chunk as a triangle, with weight 1 at `time` [s]."""

    step: str
    repeat: int
    index: int
    triangle: Array
    rows: int
    time: float


class _Filter:
    """The square-root information filter of one family, and the segments for its intervals."""

    def __init__(self, names: tuple[str, ...], memory: float) -> None:
        self.names = names
        self.held: frozenset[str] = frozenset()
        self._memory = memory
        self._sum = Accumulator(len(names))
        self._peak = np.zeros(len(names))
        self._time = -np.inf
        self._segments: list[_Segment] = []
        self.residual: OnlineResidual | None = None  # of the newest chunk that could be predicted

    def fold(self, head: RecordHead, equations: Sequence[Rows], start: float) -> None:
        """Fold the rows of a chunk, their times counting from `start` [s]."""
        matrix = np.concatenate([r.matrix for r in equations])
        rhs = np.concatenate([r.rhs for r in equations])
        time = start + np.concatenate([r.time for r in equations])
        if not len(rhs):
            return
        now = max(float(time.max()), self._time)
        if np.isfinite(self._time):
            self._fade(now - self._time)
        root = np.exp(0.5 * (time - now) / self._memory)
        piece = Accumulator(len(self.names))
        piece.fold(matrix * root[:, None], rhs * root)
        self.residual = self._predicted(piece) or self.residual
        self._sum.merge(piece.triangle, piece.rows)
        self._peak = np.maximum(self._peak, _norms(self._sum.triangle))
        self._time = now
        place = (head.step, head.repeat, len(self._segments))
        self._segments = [s for s in self._segments if self._weight(s) > IDENTIFY.online_spent]
        self._segments.append(_Segment(*place, piece.triangle, piece.rows, now))

    def _predicted(self, piece: Accumulator) -> OnlineResidual | None:
        """Return the prediction error of a chunk; None where it has unknown columns.

        With T'T = [X y]'[X y] of the chunk, |y - X beta| = |T [-beta; 1]|.
        """
        T = piece.triangle / max(piece.rows, 1) ** 0.5
        used = _norms(T) > 0.0
        beta = solve(self.names, [RowCluster(0, 0, self._sum.triangle, 1)]).value
        if not used.any() or np.isnan(beta[used]).any():
            return None
        error = np.linalg.norm(T @ np.append(np.where(used, -beta, 0.0), 1.0))
        return OnlineResidual(float(error), float(np.linalg.norm(T[:, -1])))

    def _weight(self, segment: _Segment) -> float:
        return float(np.exp((segment.time - self._time) / self._memory))

    def _fade(self, seconds: float) -> None:
        """Reduce the weight of old rows, and hold a parameter that has too little information."""
        self._sum.fade(float(np.exp(-seconds / self._memory)))
        R = self._sum.triangle
        size, least = _norms(R), IDENTIFY.online_floor * self._peak
        faint = size < least
        self.held = frozenset(n for n, low in zip(self.names, faint, strict=True) if low)
        if self.held:
            value = np.nan_to_num(solve(self.names, [RowCluster(0, 0, R, 1)]).value)
            lift = np.diag(np.sqrt(np.maximum(least**2 - size**2, 0.0)))[faint]
            self._sum.merge(np.column_stack((lift, lift @ value)), 0)

    def condense(self) -> None:
        """Merge a repeat's segments, if nothing is forgotten and its step has other repeats."""
        if np.isfinite(self._memory):
            return
        pieces: dict[tuple[str, object], _Segment] = {}
        for key, segment in zip(self._keys(), self._segments, strict=True):
            if key in pieces:
                both = merge((pieces[key].triangle, segment.triangle))
                pieces[key] = replace(segment, triangle=both, rows=segment.rows + pieces[key].rows)
            else:
                pieces[key] = segment
        self._segments = list(pieces.values())

    def _keys(self) -> list[tuple[str, object]]:
        """Return stratum and cluster of every segment: repeats where a step has several."""
        repeats: dict[str, set[int]] = {}
        for segment in self._segments:
            repeats.setdefault(segment.step, set()).add(segment.repeat)
        whole = np.isinf(self._memory)
        return [
            (s.step, s.repeat if whole and len(repeats[s.step]) > 1 else (s.repeat, s.index))
            for s in self._segments
        ]

    def solution(self) -> Solution:
        """Return the current estimate; its errors are NaN while there is only one segment."""
        keys = self._keys()
        count = Counter(step for step, _ in set(keys))
        # A step just begun has one segment, and no scatter yet.
        others = [step for step, pieces in count.items() if pieces > 1]
        scatter = []
        for (step, key), segment in zip(keys, self._segments, strict=True):
            alone = count[step] == 1 and others
            stratum, cluster = (others[0], (step, key)) if alone else (step, key)
            triangle = segment.triangle * np.sqrt(self._weight(segment))
            scatter.append(RowCluster(stratum, cluster, triangle, segment.rows))
        whole = RowCluster("all", "all", self._sum.triangle, self._sum.rows)
        return solve(self.names, [whole], scatter=scatter)


def _norms(R: Array) -> Array:
    return np.asarray(np.linalg.norm(R[:, :-1], axis=0))


class Tracker:
    """Track the parameters through the records of a run: `begin`, `feed` ..., `end` or `discard`.

    `memory` [s] is the time constant of forgetting, infinite for none. Raises InputError for one
    that is not positive.
    """

    def __init__(
        self,
        rig: Rig,
        memory: float = np.inf,
        families: Collection[str] | None = None,
    ) -> None:
        if not memory > 0.0:
            raise InputError(f"a memory of {memory:g} s; expected more than 0")
        if families is None:  # the families that do not depend on locked joints, if any
            families = rig.families[-1:]
        self._rig, self._families = rig, tuple(families)
        self._terms = tuple(
            Used(term)
            for term in baseline_of(rig)
            if any(c.family in self._families for c in term.coefficients(rig))
        )
        names = {family: parameters_of(rig, self._terms, family) for family in families}
        self._finished = {family: _Filter(columns, memory) for family, columns in names.items()}
        self._running = self._finished
        self._feed: RowFeed | None = None
        self._start = 0.0
        self._clock = -np.inf
        self.record_rows = 0  # of the present record, or of the last one

    def begin(self, head: RecordHead) -> None:
        """Begin the record `head`, at its device time `start` [s]; its `samples` may be unknown."""
        # Imported records all start at 0: they are then placed one after the other.
        self._start = max(head.start, self._clock)
        self.record_rows = 0
        filters = default_filtering(head.record({}))
        self._feed = RowFeed(self._rig, self._terms, head, filters, self._families)
        self._running = copy.deepcopy(self._finished)

    def feed(self, channels: Mapping[str, Array]) -> bool:
        """Add the record's next samples, NaN where lost; return whether the estimates changed."""
        return self._feed is not None and self._fold(self._feed.head, self._feed.feed(channels))

    def end(self) -> None:
        """End the record and keep its rows."""
        if self._feed is not None:
            self._fold(self._feed.head, self._feed.finish())
            for running in self._running.values():
                running.condense()
        self._finished, self._feed = self._running, None

    def discard(self) -> None:
        """End the record and drop its rows."""
        self._running, self._feed = self._finished, None

    def _fold(self, head: RecordHead, by_equation: Mapping[str, Rows]) -> bool:
        if not by_equation:
            return False
        for family, running in self._running.items():
            rows = [r for name, r in by_equation.items() if family_of(name) == family]
            if rows:
                running.fold(head, rows, self._start)
                self.record_rows += sum(len(r.rhs) for r in rows)
                self._clock = max([self._clock, *(self._start + r.time[-1:].sum() for r in rows)])
        return True

    def estimates(self) -> dict[str, Estimate]:
        """Return every parameter followed; NaN until determined; without interval while held."""
        solutions = {family: running.solution() for family, running in self._running.items()}
        values, _ = estimates_of(self._rig, self._terms, solutions)
        no_interval = (float("nan"), float("nan"))
        for running in self._running.values():
            for name in running.held & values.keys():
                note = "not excited for long; the value is held"
                values[name] = replace(values[name], std=float("nan"), ci95=no_interval, note=note)
        return values

    def residuals(self) -> dict[str, OnlineResidual]:
        """Return, by family of rows, the prediction error of the newest chunk."""
        by_family = {family: running.residual for family, running in self._running.items()}
        return {family: residual for family, residual in by_family.items() if residual is not None}


def track(tracker: Tracker, record: Record, block: int = 10) -> None:
    """Feed a stored record to a tracker, `block` samples at a time, as a bench would."""
    tracker.begin(head_of(record))
    for first in range(0, record.samples, block):
        part = slice(first, first + block)
        tracker.feed({name: x[part] for name, x in record.channels.items()})
    tracker.end()
