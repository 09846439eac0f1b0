"""Regression data: averaged records, their whitened residuals, every candidate's columns on them.

Repeats of one excitation (a group: run and step) are averaged channel by channel. The columns are
those of the average; each repeat has its own residual. So 12 records of 10 s become a few thousand
rows for the whole catalogue, and a sign flip costs one product. Where repeats move so differently
that the rows of the averaged channels are not the average of their rows (a position loop near its
limit of stability), their rows are averaged.
Rows are divided by the noise floor of their group and equation, and multiplied by the root of the
number of repeats: noise then adds 1 per row to a residual's energy, whatever unit and repeats.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import Evidence
from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.least_squares import shortest
from analysis.regression.rows import Rows, in_common, matrix_of, mean_rows
from analysis.signals.conditioning import Signals
from analysis.terms.base import FAMILIES, Used, family_of, joint_of
from analysis.trace.data.cache import RowCache
from analysis.trace.data.conditioned_record import (
    acting_on,
    added_columns,
    changes_rows,
    is_hidden_by_lock,
    model_rows,
    prepared_signals,
    row_residual,
    shared_rows,
)
from analysis.trace.data.noise_floor import Floor, Group, floors
from analysis.trace.settings import DATA, TRACE
from analysis.workers.pool import Pool, Serial
from rig.model.parse import InputError
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """The rows (`where`) of one equation of one group, averaged over `repeats` records.

    `noise` is the noise floor of one record [SI].
    """

    group: Group
    equation: str
    where: slice
    noise: float
    repeats: int

    @property
    def count(self) -> int:
        """The number of its rows."""
        return int(self.where.stop - self.where.start)


@dataclass(frozen=True)
class RegressionData:
    """Whitened rows of records under a model with coefficients `beta`.

    `base` (M, k) holds the columns of the coefficients `names`; `residual` (R, M) the residual of
    each repeat over its noise, NaN on segments with fewer repeats. `records` are the averaged
    records, `rows` their rows before whitening [SI], `floors` the split of the residuals.
    `relative`: rows of a model with effects that rescale signals are scaled to their size without
    these effects; otherwise a gain below 1 would reduce the residual by the scaling alone.
    """

    rig: Rig
    terms: tuple[Used, ...]
    beta: Mapping[str, float]
    names: tuple[str, ...]
    base: Array
    residual: Array
    segments: tuple[Segment, ...]
    floors: tuple[Floor, ...]
    records: tuple[ConditionedRecord, ...]
    rows: tuple[Mapping[str, Rows], ...]
    cache: RowCache = field(default_factory=RowCache, repr=False, compare=False)
    relative: bool = False

    @functools.cached_property
    def mean_residual(self) -> Array:
        """The averaged residual (M,) over its own noise, that of one record over root repeats."""
        weights = np.zeros(self.residual.shape[1])
        for segment in self.segments:
            weights[segment.where] = np.sqrt(segment.repeats)
        return np.asarray(np.nanmean(self.residual, axis=0) * weights)

    @functools.cached_property
    def family_rows(self) -> dict[str, NDArray[np.int64]]:
        """The numbers (m,) of each family's rows, in the order of the segments."""
        parts: dict[str, list[NDArray[np.int64]]] = {}
        for s in self.segments:
            rows = np.arange(s.where.start, s.where.stop)
            parts.setdefault(family_of(s.equation), []).append(rows)
        return {family: np.concatenate(rows) for family, rows in parts.items()}

    @property
    def row_counts(self) -> Counter[str]:
        """The number of rows of each equation."""
        rows: Counter[str] = Counter()
        for s in self.segments:
            rows[s.equation] += s.count
        return rows

    def in_equations(self, equations: Collection[str]) -> NDArray[np.bool_]:
        """Return a mask (M,) of the rows of some equations."""
        mask = np.zeros(self.base.shape[0], dtype=bool)
        for s in self.segments:
            mask[s.where] = s.equation in equations
        return mask

    def source(self, segment: Segment) -> tuple[ConditionedRecord, Rows]:
        """Return the averaged record of a segment, and its rows of the segment's equation [SI]."""
        k = [conditioned.group for conditioned in self.records].index(segment.group)
        return self.records[k], self.rows[k][segment.equation]

    def at(self, mask: NDArray[np.bool_]) -> RegressionData:
        """Return the data with the rows of a mask (M,); noise floors stay those of all rows."""
        index = {conditioned.group: k for k, conditioned in enumerate(self.records)}
        rows: tuple[dict[str, Rows], ...] = tuple({} for _ in self.records)
        segments, start = [], 0
        for s in self.segments:
            kept, k = mask[s.where], index[s.group]
            if kept.any():
                all_rows = self.rows[k][s.equation]
                rows[k][s.equation] = _rows_at(all_rows, all_rows.time[kept])
                segments.append(replace(s, where=slice(start, start + int(kept.sum()))))
                start = segments[-1].where.stop
        return replace(
            self, base=self.base[mask], residual=self.residual[:, mask],
            segments=tuple(segments), rows=rows, cache=RowCache(),
        )  # fmt: skip


def _averaged_record(rig: Rig, repeats: Sequence[ConditionedRecord]) -> ConditionedRecord:
    """Return the average of the repeats' channels, filtered like them."""
    reference = repeats[0]
    count = min(conditioned.record.samples for conditioned in repeats)
    names = [c for c in reference.record.channels if all(c in s.record.channels for s in repeats)]
    channels = {
        name: np.mean([np.asarray(s.record.channels[name])[:count] for s in repeats], axis=0)
        for name in names
    }
    average = reference.condition_alike(rig, replace(reference.record, channels=channels))
    valid = np.all([s.signals.valid[:count] for s in repeats], axis=0)
    weights = [s.signals.weight[:count] for s in repeats if s.signals.weight is not None]
    signals = replace(
        average.signals,
        valid=average.signals.valid & valid,
        weight=np.mean(weights, axis=0) if weights else None,
    )
    return replace(average, signals=signals)


def _average(
    rig: Rig, terms: Sequence[Used], repeats: Sequence[ConditionedRecord],
    of_repeats: Sequence[Mapping[str, Rows]], beta: Mapping[str, float],
    noise: Mapping[str, float],
) -> tuple[ConditionedRecord, dict[str, Rows]]:  # fmt: skip
    """Return the average of repeats, and its rows under a model.

    They are the rows of the averaged channels, or the mean of the repeats' rows (`of_repeats`)
    where the residuals of an equation differ by more than `DATA.averaging_error` times the noise of
    the mean. Rows weighted by speed do not count: the noise of a speed alone changes its weight.
    `noise` [SI] is that of one record, by equation.
    """
    if len(repeats) == 1:
        return repeats[0], dict(of_repeats[0])
    average = _averaged_record(rig, repeats)
    of_average, mean = model_rows(rig, terms, average), mean_rows(of_repeats)
    in_motion = average.filtering.in_motion
    weighted = {e for e in mean if e.startswith("torque") and joint_of(e) in in_motion}
    for name in of_average.keys() & mean.keys() - weighted:
        rows, others = of_average[name], mean[name]
        in_rows, in_others = in_common(rows, others)
        change = row_residual(rows, beta)[in_rows] - row_residual(others, beta)[in_others]
        limit = DATA.averaging_error * noise[name] / np.sqrt(len(repeats))
        if len(change) and np.sqrt(np.mean(change**2)) > limit:
            return replace(average, repeats=tuple(repeats)), mean
    return average, of_average


def least_squares(rig: Rig, rows: Sequence[Mapping[str, Rows]]) -> dict[str, float]:
    """Return the unweighted least-squares coefficients of all rows, the shortest if not unique."""
    out: dict[str, float] = {}
    for family in FAMILIES:
        parts = [r for record in rows for e, r in record.items() if family_of(e) == family]
        if not parts:
            continue
        X, y = np.concatenate([r.matrix for r in parts]), np.concatenate([r.rhs for r in parts])
        out |= zip(parts[0].names, shortest(X, y, TRACE.rank_limit), strict=True)
    return out


def regression_data(
    rig: Rig,
    terms: Sequence[Used],
    members: Sequence[ConditionedRecord],
    beta: Mapping[str, float] | None = None,
    cache: RowCache | None = None,
    others: Sequence[Floor] = (),
    noise_ratio: Mapping[str, float] | None = None,
) -> RegressionData:
    """Return the whitened rows of records under a model (see the module).

    Without `beta` the coefficients are fitted to these records; `cache` may hold rows of the same
    records and filters; `others` and `noise_ratio` are those of `noise_floor.floors`. Raises
    InputError where filter edges leave no rows.
    """
    rows_of_records = [model_rows(rig, terms, conditioned) for conditioned in members]
    beta = least_squares(rig, rows_of_records) if beta is None else beta
    noise_floors = floors(rig, terms, members, rows_of_records, beta, others, noise_ratio)
    groups: dict[Group, list[int]] = {}
    for k, conditioned in enumerate(members):
        groups.setdefault(conditioned.group, []).append(k)
    noise = {(f.group, f.equation): f.noise for f in noise_floors}
    averages, averaged_rows = [], []
    for group, numbers in groups.items():
        repeats = [members[k] for k in numbers]
        of_repeats = [rows_of_records[k] for k in numbers]
        of_group = {equation: value for (g, equation), value in noise.items() if g == group}
        average, rows = _average(rig, terms, repeats, of_repeats, beta, of_group)
        averages.append(average)
        averaged_rows.append(rows)
    all_rows = [r for rows in averaged_rows for r in rows.values()]
    names = tuple(dict.fromkeys(name for r in all_rows for name in r.names))
    most_repeats = max(map(len, groups.values()))
    base, residual, segments, start = [], [], [], 0
    rows_of_groups: list[dict[str, Rows]] = [{} for _ in averages]
    for conditioned, rows, kept in zip(averages, averaged_rows, rows_of_groups, strict=True):
        of_repeats = [rows_of_records[k] for k in groups[conditioned.group]]
        for equation, mean in rows.items():
            time = mean.time
            for record in of_repeats:
                time = np.intersect1d(time, record[equation].time)
            if len(time) < 5:
                continue
            kept[equation] = _rows_at(mean, time)
            sigma = max(noise[conditioned.group, equation], 1e-30)
            base.append(matrix_of(kept[equation], names) * np.sqrt(len(of_repeats)) / sigma)
            residuals = np.full((most_repeats, len(time)), np.nan)
            for k, record in enumerate(of_repeats):
                residuals[k] = row_residual(_rows_at(record[equation], time), beta) / sigma
            residual.append(residuals)
            where = slice(start, start := start + len(time))
            segments.append(Segment(conditioned.group, equation, where, sigma, len(of_repeats)))
    if not segments:
        raise InputError(
            "the records are too short: no rows are left after filter edges; take longer records"
        )
    return RegressionData(
        rig, tuple(terms), beta, names, np.concatenate(base), np.concatenate(residual, axis=1),
        tuple(segments), tuple(noise_floors), tuple(averages), tuple(rows_of_groups),
        cache or RowCache(),
    )  # fmt: skip


def _rows_at(rows: Rows, time: Array) -> Rows:
    return rows.at(np.isin(rows.time, time))


@dataclass(frozen=True)
class VariantColumns:
    """Whitened columns (M, c) of a candidate at a shape: names, and equations they act in."""

    used: Used
    names: tuple[str, ...]
    columns: Array
    touched: frozenset[str]


def evidence(data: RegressionData, residual: Array) -> Evidence:
    """Return signals and residuals for effects whose shape grid depends on the data.

    `residual` (M,) is the whitened residual of a model. Samples outside a record's rows are marked
    as not valid.
    """
    signals: list[Signals] = []
    residuals: list[dict[str, tuple[Array, Array]]] = []
    for conditioned, rows, prepared in zip(data.records, data.rows, signals_of(data), strict=True):
        segments = [s for s in data.segments if s.group == conditioned.group]
        residuals.append({s.equation: (rows[s.equation].time, residual[s.where]) for s in segments})
        times = np.concatenate([time for time, _ in residuals[-1].values()] or [prepared.t[:0]])
        start, end = (times.min(), times.max()) if len(times) else (np.inf, -np.inf)
        inside = (prepared.t >= start) & (prepared.t <= end)
        signals.append(replace(prepared, valid=prepared.valid & inside[:, None]))
    return Evidence(signals, residuals)


def signals_of(data: RegressionData) -> list[Signals]:
    """Return every record's signals as changed by the data's own terms (`prepare`)."""
    return [prepared_signals(data.rig, data.terms, conditioned) for conditioned in data.records]


def variant_columns(
    data: RegressionData, chosen: Sequence[Used],
    progress: Callable[[float], None] | None = None, equations: Collection[str] = (),
    pool: Pool | None = None,
) -> list[VariantColumns]:  # fmt: skip
    """Return the columns of every candidate `chosen` that acts in the data, in their order.

    `progress` is called after each with the share of them done. With `equations`, columns
    are computed in their rows only and are zero elsewhere. `pool` computes them.
    """
    searched = equations or {s.equation for s in data.segments}
    families = {family_of(e) for e in searched}
    records = [
        replace(c, families=tuple(f for f in c.families if f in families)) for c in data.records
    ]
    segments = [s for s in data.segments if s.equation in searched]
    signals_of_records = signals_of(data)
    columns = []

    def of_candidate(used: Used) -> VariantColumns | None:
        return _columns_of(data, records, segments, used, signals_of_records)

    for entry in (pool or Serial()).map(of_candidate, chosen):
        columns.append(entry)
        if progress is not None:
            progress(len(columns) / len(chosen))
    return [entry for entry in columns if entry is not None]


def candidate_columns(
    data: RegressionData, conditioned: ConditionedRecord, prepared: Signals,
    rows: Mapping[str, Rows], used: Used,
) -> dict[str, dict[str, Array]]:  # fmt: skip
    """Return the columns that a candidate adds to a record's rows: equation -> name -> column (m,).

    `prepared` and `rows` are the record's signals and rows under the model of `data`. The result is
    empty where the lock of its joint hides the effect. Effects that change the signals (`prepare`)
    enter as a pseudo-column, named '': with X, y the rows before and X', y' the rows after the
    change, and beta the coefficients of `data`,
     d = (y - X beta) - (y' - X' beta),
    which to first order in the change is what the effect adds to the residual.
    """
    if is_hidden_by_lock(used.term, conditioned):
        return {}
    if not changes_rows(used.term) and not conditioned.repeats:
        return added_columns(data.rig, conditioned, lambda: prepared, rows, used, data.cache)
    families = tuple(f for f in conditioned.families if acting_on(data.rig, (used,), f, data.cache))
    parameters = [c.parameter for c in used.term.coefficients(data.rig)]
    of_families = replace(conditioned, families=families)
    out: dict[str, dict[str, Array]] = {}
    for name, after in shared_rows(data.rig, (*data.terms, used), of_families, data.cache).items():
        if name not in rows:
            continue
        before = rows[name]
        in_before, in_after = in_common(before, after)
        # Column by column, so that an unchanged column gives a difference of exactly 0.
        matrix_change = matrix_of(after, before.names)[in_after] - before.matrix[in_before]
        rhs_change = after.rhs[in_after] - before.rhs[in_before]
        columns = {"": np.zeros(len(before.rhs))}
        beta = np.array([data.beta.get(n, 0.0) for n in before.names])
        columns[""][in_before] = matrix_change @ beta - rhs_change
        for k, parameter in enumerate(after.names):
            if parameter in parameters and np.any(after.matrix[:, k]):
                columns[parameter] = np.zeros(len(before.rhs))
                columns[parameter][in_before] = after.matrix[in_after, k]
        columns = {key: column for key, column in columns.items() if np.any(column)}
        if columns:
            out[name] = columns
    return out


def _columns_of(
    data: RegressionData, records: Sequence[ConditionedRecord], segments: Sequence[Segment],
    used: Used, signals_of_records: Sequence[Signals],
) -> VariantColumns | None:  # fmt: skip
    """Return a candidate's columns in some segments' rows, None where it does not act there."""
    columns: dict[str, Array] = {}
    touched = set()
    M = data.base.shape[0]
    for conditioned, signals, rows in zip(records, signals_of_records, data.rows, strict=True):
        candidate = candidate_columns(data, conditioned, signals, rows, used)
        for segment in segments:
            if segment.group == conditioned.group and segment.equation in candidate:
                touched.add(segment.equation)
                for name, column in candidate[segment.equation].items():
                    all_rows = columns.setdefault(name, np.zeros(M))
                    all_rows[segment.where] += column * np.sqrt(segment.repeats) / segment.noise
    if not columns or not all(np.isfinite(c).all() for c in columns.values()):
        return None
    return VariantColumns(
        used, tuple(columns), np.column_stack(list(columns.values())), frozenset(touched)
    )
