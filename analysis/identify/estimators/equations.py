"""Estimating equations on the rows of one family: solve, influences of repeats and segments.

sum_b Z_b' w_b (y_b - X_b beta) = 0 over blocks b (one equation of one record); with
A = sum Z'wX the influence of a set of rows c on beta is A^-1 sum_c Z'w e.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import RecordRows
from analysis.regression.least_squares import scaled_inverse
from analysis.regression.solve import numbered, sums_of
from rig.model import channels as ch
from rig.model.records import Record, bridged

Array = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class RepeatBlock:
    """Rows of one equation of one record: X (m, k), y (m,), time (m,) [s].

    `segment` (m,) is the part of the excitation's period that each row lies in, `level` (m,) the
    bin of the equation's own state.
    """

    run: int
    step: str
    repeat: int
    record: str
    equation: str
    X: Array
    y: Array
    time: Array
    segment: Indices
    level: Indices

    @property
    def stratum(self) -> tuple[int, str]:
        """The (run, step) that the repeat belongs to."""
        return self.run, self.step

    @property
    def shared(self) -> tuple[int, str, str]:
        """Run, step and equation, which the repeats of a step have in common."""
        return self.run, self.step, self.equation

    @property
    def ticks(self) -> Array:
        """The rows' times (m,) [s] without rounding errors, equal in repeats."""
        return np.round(self.time, 9)


@dataclass(frozen=True)
class FamilyBlocks:
    """A family's blocks, nuisance columns last, with the names of all columns.

    The first `parameters` columns are the model's. `omitted` holds, for each nuisance that the data
    contradict, how much leaving it out shifts their coefficients (k,).
    """

    family: str
    names: tuple[str, ...]
    parameters: int
    blocks: tuple[RepeatBlock, ...]
    omitted: tuple[Array, ...] = ()


@dataclass(frozen=True)
class EquationFit:
    """A solution beta (k,) with A^-1 (k, k), the instruments and the weights used."""

    blocks: tuple[RepeatBlock, ...]
    Z: tuple[Array, ...]
    w: tuple[Array, ...]
    beta: Array
    inverse: Array

    def residuals(self) -> list[Array]:
        """Return y - X beta of every block."""
        return [b.y - b.X @ self.beta for b in self.blocks]


def segments(time: Array, period: float, shared: tuple[float, float] | None = None) -> Indices:
    """Return the part of the excitation's period that each row (m,) lies in.

    Without a period [s] (0) the time from the first to the last row is divided, or the interval
    `shared` [s] of all repeats, whose end parts take the rows outside it. Rows of the same part of
    later periods belong together, because an error of the model repeats with the excitation.
    """
    begin, span = 0.0, period
    if period <= 0:
        begin, end = shared or ((time[0], time[-1]) if len(time) else (0.0, 1.0))
        span = float(end - begin) + 1e-9
    count = int(np.clip(span / IDENTIFY.shortest_segment, 1, IDENTIFY.period_segments))
    phase = (time - begin) / span
    part = np.floor((phase % 1.0 if period > 0 else phase) * count)
    return np.asarray(np.clip(part, 0, count - 1), dtype=np.int64)


def blocks_of(built: Sequence[RecordRows], family: str, chosen: Sequence[int]) -> list[RepeatBlock]:
    """Return one family's blocks of the columns `chosen`, sorted into segments and levels."""
    pairs = [(record_rows, rows) for record_rows in built for rows in record_rows.family(family)]
    shared: dict[tuple[int, str, str], tuple[float, float]] = {}
    for record_rows, rows in pairs:
        key, (begin, end) = (*record_rows.group, rows.equation), (rows.time[0], rows.time[-1])
        span = shared.get(key, (begin, end))
        shared[key] = max(begin, span[0]), max(min(end, span[1]), begin)
    blocks = []
    for record_rows, rows in pairs:
        record, group = record_rows.record, record_rows.group
        period = record.period / record.sample_rate
        blocks.append(
            RepeatBlock(
                *group, record.repeat, record.name, rows.equation,
                rows.matrix[:, list(chosen)], rows.rhs, rows.time,
                segments(rows.time, period, shared[*group, rows.equation]),
                np.zeros(len(rows.rhs), dtype=np.int64),
            )
        )  # fmt: skip
    return _with_levels(blocks, {(*r.group, r.record.name): r.record for r in built})


def solve(blocks: Sequence[RepeatBlock], Z: Sequence[Array], w: Sequence[Array]) -> EquationFit:
    """Solve the estimating equations, columns scaled to unit norm first."""
    k = blocks[0].X.shape[1]
    A, c = np.zeros((k, k)), np.zeros(k)
    for b, z, weight in zip(blocks, Z, w, strict=True):
        weighted = z * weight[:, None]
        A += weighted.T @ b.X
        c += weighted.T @ b.y
    inverse = scaled_inverse(A)
    return EquationFit(tuple(blocks), tuple(Z), tuple(w), inverse @ c, inverse)


def least_squares(blocks: Sequence[RepeatBlock], w: Sequence[Array] | None = None) -> EquationFit:
    """Solve with Z = X and weights w (default 1)."""
    weights = [np.ones(len(b.y)) for b in blocks] if w is None else w
    return solve(blocks, [b.X for b in blocks], weights)


@dataclass(frozen=True)
class Pieces:
    """Scores g = Z'w e and information A of every (stratum, repeat, part) that has rows.

    Arrays of the length of the pieces: `stratum`, `repeat`, `part` (c,), `score` (c, k),
    `information` (c, k, k), None where every step has repeats: only a single repeat needs it.
    """

    stratum: Indices
    repeat: Indices
    part: Indices
    score: Array
    information: Array | None

    def grouped(self, key: Indices, values: Array) -> tuple[Indices, Array]:
        """Sum values (c, ...) of pieces of equal stratum and `key`: (stratum (g,), sums)."""
        first, number = numbered(self.stratum, key)
        return self.stratum[first], sums_of(values, number)


def pieces(fit: EquationFit, by: str = "segment") -> Pieces:
    """Return scores and information of a fit by stratum, repeat and `segment` or `level`."""
    strata = {s: i for i, s in enumerate(sorted({b.stratum for b in fit.blocks}))}
    repeats = {(b.stratum, b.repeat) for b in fit.blocks}
    single = min(Counter(stratum for stratum, _ in repeats).values()) < 2
    keys, score, information = [], [], []
    for b, z, weight, e in zip(fit.blocks, fit.Z, fit.w, fit.residuals(), strict=True):
        labels = b.segment if by == "segment" else b.level
        parts = np.unique(labels)
        inside = (labels == parts[:, None]).astype(np.float64)
        score.append(inside @ (z * (weight * e)[:, None]))
        if single:
            information += [(z * (weight * selected)[:, None]).T @ b.X for selected in inside]
        keys += [(strata[b.stratum], b.repeat, part_label) for part_label in parts.tolist()]
    stratum, repeat, part = np.array(keys, dtype=np.int64).T
    first, number = numbered(stratum, repeat, part)
    return Pieces(
        stratum[first],
        repeat[first],
        part[first],
        sums_of(np.concatenate(score), number),
        sums_of(np.array(information), number) if single else None,
    )


def with_common_rows(blocks: Sequence[RepeatBlock]) -> list[RepeatBlock]:
    """Return the blocks with only those rows that every repeat of their step and equation has."""
    shared = shared_ticks(blocks)
    out = []
    for b in blocks:
        ticks = shared[b.shared]
        same = len(ticks) == len(b.time)  # nearly always
        out.append(b if same else rows_of(b, np.isin(b.ticks, ticks)))
    return out


def shared_ticks(blocks: Sequence[RepeatBlock]) -> dict[tuple[int, str, str], Array]:
    """Return, by (run, step, equation), the times [s] of rows that every repeat has."""
    shared: dict[tuple[int, str, str], Array] = {}
    for b in blocks:
        ticks = b.ticks
        before = shared.setdefault(b.shared, ticks)
        if not np.array_equal(before, ticks):
            shared[b.shared] = np.intersect1d(before, ticks)
    return shared


def groups(blocks: Sequence[RepeatBlock]) -> dict[tuple[int, str, str], list[int]]:
    """Return the indices of the blocks of all repeats, by run, step and equation."""
    indices: dict[tuple[int, str, str], list[int]] = {}
    for k, b in enumerate(blocks):
        indices.setdefault(b.shared, []).append(k)
    return indices


def rows_of(b: RepeatBlock, selected: NDArray[np.bool_]) -> RepeatBlock:
    """Return a block with only the rows `selected` (m,)."""
    return replace(
        b, X=b.X[selected], y=b.y[selected], time=b.time[selected], segment=b.segment[selected],
        level=b.level[selected],
    )  # fmt: skip


def _with_levels(
    blocks: Sequence[RepeatBlock], records: Mapping[tuple[int, str, str], Record]
) -> list[RepeatBlock]:
    """Return the blocks with `level`, the bin of the state that the equation's law depends on.

    Flow rows are sorted by their chamber's pressure, torque rows by their joint's position, into
    bins of equally many rows. The mean over the repeats is sorted, so that noise hardly affects the
    order. A law that is wrong at some states has its residual in few of the bins.
    """
    out = list(blocks)
    for number, (_, indices) in enumerate(sorted(groups(blocks).items())):
        group = [blocks[k] for k in indices]
        ticks = np.concatenate([b.ticks for b in group])
        state = np.concatenate([_state(b, records[*b.stratum, b.record]) for b in group])
        times, tick_index = np.unique(ticks, return_inverse=True)
        mean = np.bincount(tick_index, state) / np.bincount(tick_index)
        rank = np.empty(len(times), dtype=np.int64)
        rank[np.argsort(mean, kind="stable")] = np.arange(len(times))
        label = number * IDENTIFY.state_levels + rank * IDENTIFY.state_levels // len(times)
        ends = np.cumsum([len(b.time) for b in group])[:-1]
        for k, level in zip(indices, np.split(label[tick_index], ends), strict=True):
            out[k] = replace(blocks[k], level=level)
    return out


def _state(b: RepeatBlock, record: Record) -> Array:
    kind, joint = b.equation.rsplit("_", 1)
    position = ch.POSITION if ch.channel(ch.POSITION, int(joint)) in record.channels else ch.PISTON
    channel = {"flow_cap": ch.CAP, "flow_rod": ch.ROD}.get(kind, position)
    x = bridged(np.asarray(record.channels[ch.channel(channel, int(joint))], dtype=np.float64))
    width = max(1, round(IDENTIFY.averaging_time * record.sample_rate))
    smooth = np.convolve(x, np.full(width, 1.0 / width), mode="same")
    return np.asarray(np.interp(b.time, record.time, smooth))


def over_repeats(blocks: Sequence[RepeatBlock], arrays: Sequence[Array]) -> list[tuple[Array, int]]:
    """Return, for each block, the sum of `arrays` over all its repeats and the number of repeats.

    `arrays` holds one array for each block, of equal shape among the repeats of a step's equation.
    """
    total: dict[tuple[int, str, str], Array] = {}
    count: dict[tuple[int, str, str], int] = {}
    for b, array in zip(blocks, arrays, strict=True):
        total[b.shared] = total[b.shared] + array if b.shared in total else array.copy()
        count[b.shared] = count.get(b.shared, 0) + 1
    return [(total[b.shared], count[b.shared]) for b in blocks]
