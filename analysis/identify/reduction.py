"""Reduce one record to the quantities that an identification needs: triangles, counts, noise.

A reduction has a few kilobytes for any length of the record; `analysis.identify.coupled` joins
those of all records. Every record is kept in `record_segments` parts of its duration: a step of one
record has no repeats to compare, and compares its parts.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.identify.settings import IDENTIFY
from analysis.identify.stacked_rows import RecordRows, repeats_in_motion, repeats_of
from analysis.regression.noise import record_moments
from analysis.regression.nonlinear import reduced
from analysis.regression.rows import Rows, parameters_of
from analysis.regression.solve import Accumulator, RowCluster, Solution, solve
from analysis.signals.conditioning import lost_samples
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model.parse import InputError
from rig.model.records import RecordHead, head_of
from rig.model.rig import Rig

Array = NDArray[np.float64]
Part = tuple[Array, int]  # triangle (k+1, k+1) of [X y] and its rows


@dataclass(frozen=True)
class RecordReduction:
    """The reduction of one record: by family, a triangle per part, masked rows, noise moments.

    `run` numbers the run; `noise` is the part of [X y]'[X y] that sensor noise makes, by family,
    None where another record of the step represents it.
    """

    run: int
    head: RecordHead
    parts: Mapping[str, tuple[Part, ...]]
    masked: int
    lost: int
    clipped: Mapping[str, int]
    noise: Mapping[str, Array] | None = None


def reduce_rows(
    rig: Rig, terms: Sequence[Used], built: Sequence[RecordRows]
) -> list[RecordReduction]:
    """Reduce the rows of all records of runs in memory."""
    with_noise: set[tuple[int, str]] = set()
    out = []
    for item in built:
        record, noise = item.record, None
        if item.group not in with_noise:
            with_noise.add(item.group)
            noise = record_moments(rig, terms, item.conditioned, item.rows)
        duration = record.samples / record.sample_rate
        parts, masked = folded(rig, terms, [item.rows], duration, IDENTIFY.record_segments)
        lost = int(lost_samples(rig, record).any(axis=1).sum())
        clipped = ck.clipped_counts(rig, record)
        run = item.conditioned.run
        out.append(RecordReduction(run, head_of(record), parts, masked, lost, clipped, noise))
    return out


def folded(
    rig: Rig,
    terms: Sequence[Used],
    chunks: Iterable[Mapping[str, Rows]],
    duration: float = 0.0,
    segments: int = 1,
) -> tuple[dict[str, tuple[Part, ...]], int]:
    """Return, by family, a triangle for each of `segments` equal parts of a duration [s].

    Also the number of masked rows. `chunks` are rows by equation, in order of time.
    """
    columns = {family: len(parameters_of(rig, terms, family)) for family in FAMILIES}
    sums = {f: [Accumulator(count) for _ in range(segments)] for f, count in columns.items()}
    edges = np.linspace(0.0, duration, segments + 1)[1:-1]
    masked = 0
    for rows_by_equation in chunks:
        for name, rows in rows_by_equation.items():
            masked += rows.masked
            cuts = np.searchsorted(rows.time, edges)
            pieces = zip(np.split(rows.matrix, cuts), np.split(rows.rhs, cuts), strict=True)
            for total, (matrix, rhs) in zip(sums[family_of(name)], pieces, strict=True):
                total.fold(matrix, rhs)
    return {f: tuple((part.triangle, part.rows) for part in s) for f, s in sums.items()}, masked


def clusters_of(reductions: Sequence[RecordReduction], family: str) -> list[RowCluster]:
    """Return the parts of all records, with one key for those of a repeat.

    Where a step has one record only, its parts replace repeats and have a key each.
    """
    repeats = repeats_of((reduction.run, reduction.head) for reduction in reductions)
    out: list[RowCluster] = []
    for reduction in reductions:
        stratum, repeat = (reduction.run, reduction.head.step), reduction.head.repeat
        for n, (R, rows) in enumerate(reduction.parts[family]):
            if rows:
                key: Hashable = repeat if repeats[stratum] > 1 else (repeat, n)
                out.append(RowCluster(stratum, key, R, rows))
    return out


def noise_of(reductions: Sequence[RecordReduction], family: str) -> Array | None:
    """Return the noise moments (k+1, k+1) of all records, each step's from one of its records."""
    counts = Counter((reduction.run, reduction.head.step) for reduction in reductions)
    weighted = [
        counts[reduction.run, reduction.head.step] * reduction.noise[family]
        for reduction in reductions
        if reduction.noise is not None and family in reduction.noise
    ]
    return np.sum(weighted, axis=0) if weighted else None


def solve_reductions(
    rig: Rig,
    terms: Sequence[Used],
    reductions: Sequence[RecordReduction],
    reject_noise: bool = True,
) -> dict[str, Solution]:
    """Solve each family once from the triangles of all records.

    Raises InputError where no record has rows of a family.
    """
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, terms, family)
        if names:
            clusters, noise = clusters_of(reductions, family), noise_of(reductions, family)
            if not clusters:
                raise InputError(
                    f"no rows of the {family} equations remain: {_why_no_rows(rig, reductions)}"
                )
            linear = solve(names, clusters, noise, reject_noise)
            out[family] = reduced(rig, terms, linear, clusters, noise, reject_noise)
    return out


def _why_no_rows(rig: Rig, reductions: Sequence[RecordReduction]) -> str:
    """Return the likely cause of records without rows, and what to do."""
    clipping = ck.clipping(rig, [(reduction.head, reduction.clipped) for reduction in reductions])
    clipped = next((check.detail for check in clipping if not check.ok), "")
    if clipped:
        return f"{clipped}; check the sensor, its range in the rig file, and its unit in the data"
    return (
        "the records are too short for the filters, or all their samples are masked; take longer "
        "records"
    )


def record_checks(
    rig: Rig, reductions: Sequence[RecordReduction], rows: Mapping[str, int]
) -> list[ck.Check]:
    """State repeats, excited joints, clipping, creep, lost and masked samples of the records.

    `rows` counts the rows that the solution used, by family.
    """
    heads = [reduction.head for reduction in reductions]
    return [
        ck.repeats(repeats_in_motion(rig, ((part.run, part.head) for part in reductions))),
        ck.joints_excited(rig, heads),
        *ck.supply_measured(rig),
        *ck.clipping(rig, [(reduction.head, reduction.clipped) for reduction in reductions]),
        *ck.leak_down(rig, heads),
        ck.lost_samples([(reduction.head, reduction.lost) for reduction in reductions]),
        ck.masked(sum(rows.values()), sum(reduction.masked for reduction in reductions)),
    ]
