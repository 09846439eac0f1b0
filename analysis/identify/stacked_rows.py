"""The regression rows of all records of a set of runs, built once and shared.

The solution, the estimators that refine it and the report all read the same `RecordRows`;
`with_columns` appends the columns that an estimator adds to the model's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from analysis.identify import checks as ck
from analysis.regression.conditioned import ConditionedRecord, condition_runs
from analysis.regression.rows import (
    Filtering,
    Rows,
    columns_at,
    default_filtering,
    parameters_of,
    places_of,
    prepared,
    record_rows,
    sines_at,
    term_part,
    without_sines,
)
from analysis.terms.base import FAMILIES, Used, family_of
from rig.model.records import Record, RecordHead, Run, with_common_bandwidth
from rig.model.rig import Rig


@dataclass(frozen=True)
class RecordRows:
    """The rows of one record by equation, and the conditioned record that they were built from."""

    conditioned: ConditionedRecord
    rows: Mapping[str, Rows]

    @property
    def record(self) -> Record:
        """The record itself."""
        return self.conditioned.record

    @property
    def group(self) -> tuple[int, str]:
        """The (run, step) that the repeat belongs to."""
        return self.conditioned.group

    def family(self, family: str) -> list[Rows]:
        """Return the rows of the equations of one family that have any."""
        return [r for name, r in self.rows.items() if family_of(name) == family and len(r.rhs)]


def build_rows(
    rig: Rig,
    runs: Sequence[Run],
    terms: Sequence[Used],
    filtering: Callable[[Record], Filtering] = default_filtering,
    progress: Callable[[float], None] | None = None,
) -> list[RecordRows]:
    """Return the filtered, decimated rows of every record; raises InputError for an unusable one.

    `progress` receives the share of the runs that is done.
    """
    ck.refuse_constant_records(rig, runs)
    out: list[RecordRows] = []
    for number, run in enumerate(with_common_bandwidth(runs)):
        for conditioned in condition_runs(rig, [run], filtering):
            rows = record_rows(rig, terms, conditioned.signals, conditioned.filtering)
            out.append(RecordRows(replace(conditioned, run=number), rows))
        if progress is not None:
            progress((number + 1) / len(runs))
    return out


def with_columns(
    rig: Rig, terms: Sequence[Used], built: Sequence[RecordRows], extra: Sequence[Used]
) -> list[RecordRows]:
    """Return the rows of `terms` with the columns of the terms `extra` appended, in their order.

    The extra terms may neither change the signals nor mask rows; equations without any of their
    columns are unchanged.
    """
    if not extra:
        return list(built)
    names = {family: parameters_of(rig, extra, family) for family in FAMILIES}
    out = []
    for record in built:
        filtering, rows = record.conditioned.filtering, dict(record.rows)
        signals = prepared(rig, terms, record.conditioned.signals)
        for family in filter(names.get, FAMILIES):
            parts = [term_part(rig, used, signals, filtering, family, signals) for used in extra]
            for r in record.family(family):
                at = places_of(r, signals, filtering)
                appended = columns_at(names[family], parts, r.equation, at)
                appended = without_sines(appended, sines_at(r, signals, filtering))
                rows[r.equation] = replace(
                    r, names=(*r.names, *names[family]), matrix=np.hstack((r.matrix, appended))
                )
        out.append(replace(record, rows=rows))
    return out


def repeats_of(records: Iterable[tuple[int, Record | RecordHead]]) -> dict[tuple[int, str], int]:
    """Count the repeats of every (run, step) among the records, each with its run's number."""
    repeats: dict[tuple[int, str], set[int]] = {}
    for run, record in records:
        repeats.setdefault((run, record.step), set()).add(record.repeat)
    return {key: len(numbers) for key, numbers in repeats.items()}


def repeats_in_motion(
    rig: Rig, records: Iterable[tuple[int, Record | RecordHead]]
) -> dict[tuple[int, str], int]:
    """Count the repeats as `repeats_of`, without holds, which have no equations of motion."""
    return repeats_of((run, record) for run, record in records if not ck.is_hold(rig, record))
