"""The rows of all records of a set of runs, stacked by step and repeat, and solved."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.identify import checks as ck
from analysis.identify.reduction import SEGMENTS
from analysis.regression.nonlinear import reduced
from analysis.regression.rows import Filtering, Rows, default_filtering, parameters_of, record_rows
from analysis.regression.solve import RowCluster, Solution, solve, triangle
from analysis.signals.conditioning import condition
from analysis.signals.locks import moving_by_step
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model.records import Record, Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RecordRows:
    """The rows of one record by equation, and which run, step and repeat it is."""

    run: int
    record: str
    step: str
    repeat: int
    rows: Mapping[str, Rows]


def build_rows(
    rig: Rig,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering] = default_filtering,
) -> list[RecordRows]:
    """Return the filtered, decimated rows of every record; raises InputError for a bad one."""
    built = []
    for index, run in enumerate(runs):
        moving = moving_by_step(rig, run)
        for record in run.records:
            ck.refuse_dead_channels(rig, record)
            filters = filtering(record)
            signals = condition(rig, record, filters.channels, moving.get(record.step))
            rows = record_rows(rig, terms, signals, filters)
            built.append(RecordRows(index, record.name, record.step, record.repeat, rows))
    return built


def repeats_of(per_record: Sequence[RecordRows]) -> dict[tuple[int, str], int]:
    """Count the repeats of every (run, step)."""
    seen: dict[tuple[int, str], set[int]] = {}
    for one in per_record:
        seen.setdefault((one.run, one.step), set()).add(one.repeat)
    return {key: len(values) for key, values in seen.items()}


def solve_rows(
    rig: Rig,
    terms: Sequence[Used],
    per_record: Sequence[RecordRows],
    noise: Mapping[str, Array] | None = None,
    reject_noise: bool = True,
) -> dict[str, Solution]:
    """Reduce the rows to one triangle per cluster and solve each family once."""
    repeats = repeats_of(per_record)
    out = {}
    for family in FAMILIES:
        names = parameters_of(rig, terms, family)
        clusters: list[RowCluster] = []
        for one in per_record:
            clusters += clusters_of(one, family, repeats)
        if names:
            moments = noise[family] if noise else None
            linear = solve(names, clusters, moments, reject_noise)
            out[family] = reduced(rig, terms, linear, clusters, moments, reject_noise)
    return out


def clusters_of(
    one: RecordRows, family: str, repeats: Mapping[tuple[int, str], int]
) -> list[RowCluster]:
    """Reduce a record's rows of one family to a triangle, or to several of an only repeat."""
    pieces = 1 if repeats[one.run, one.step] > 1 else SEGMENTS
    out = []
    rows = [r for name, r in one.rows.items() if family_of(name) == family]
    for piece in range(pieces):
        parts = [_piece(r, piece, pieces) for r in rows]
        count = sum(len(rhs) for _, rhs in parts)
        if count:
            matrix = np.concatenate([m for m, _ in parts])
            rhs = np.concatenate([y for _, y in parts])
            key: Hashable = one.repeat if pieces == 1 else (one.repeat, piece)
            out.append(RowCluster((one.run, one.step), key, triangle(matrix, rhs), count))
    return out


def _piece(rows: Rows, piece: int, pieces: int) -> tuple[Array, Array]:
    edges = np.linspace(0, len(rows.rhs), pieces + 1).astype(int)
    inside = slice(edges[piece], edges[piece + 1])
    return rows.matrix[inside], rows.rhs[inside]
