"""Rows of conditioned records under a model; parts that many models share are computed once."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from analysis.effects.base import SENSOR, Effect, ordered
from analysis.identify import checks as ck
from analysis.regression.conditioned import ConditionedRecord, condition_runs
from analysis.regression.rows import (
    Filtering,
    Rows,
    TermPart,
    assembled,
    default_filtering,
    low_passed,
    mean_rows,
    parameters_of,
    places_of,
    record_rows,
    right_parts,
    sines_at,
    term_part,
    without_sines,
)
from analysis.signals.conditioning import Signals
from analysis.terms.base import FAMILIES, Term, Used
from analysis.trace.data.cache import RowCache
from rig.model.records import Record, Run
from rig.model.rig import Rig

Array = NDArray[np.float64]


def trace_filtering(record: Record) -> Filtering:
    """Return the default filters with a decimation that divides the period.

    Rows of successive periods then stand at the same phase and can be compared one by one.
    """
    default = default_filtering(record)
    if not record.period:
        return default
    step = next(k for k in range(default.step, 0, -1) if record.period % k == 0)
    return replace(default, step=max(step, (default.step + 1) // 2))


def moving_filtering(
    joints: Iterable[int], full_weight: float = 1.0
) -> Callable[[Record], Filtering]:
    """Return the trace's filters, with torque rows of `joints` (0-based) weighted by speed.

    The weight is 1 from `full_weight` times a record's rms speed on.
    """
    weighted = tuple(sorted(joints))
    return lambda record: replace(
        trace_filtering(record), in_motion=weighted, full_weight=full_weight
    )


def conditioned_records(
    rig: Rig,
    runs: Sequence[Run],
    filtering: Callable[[Record], Filtering] = trace_filtering,
    families: tuple[str, ...] = tuple(FAMILIES),
) -> list[ConditionedRecord]:
    """Condition every record of the runs; raises InputError for a record that cannot be used."""
    ck.refuse_constant_records(rig, runs)
    return condition_runs(rig, runs, filtering, families)


def is_hidden_by_lock(term: Term, conditioned: ConditionedRecord) -> bool:
    """Return whether an effect cannot show in a record because its joint is locked there.

    An error of a position sensor shows in a locked joint too, by the position where it stands.
    """
    where = term.where
    of_sensor = getattr(term, "stage", None) == SENSOR
    if not where.startswith("joint ") or (of_sensor and where.endswith(("piston", "position"))):
        return False
    return int(where.split()[1]) in conditioned.record.locked


def changes_rows(term: Term) -> bool:
    """Return whether a term changes the rows of others: signals, valid samples or columns."""
    kind = type(term)
    signals = kind.prepare is not Term.prepare or kind.valid is not Term.valid
    return signals or getattr(kind, "adds_to_gains", False)


def families_of(rig: Rig, term: Term) -> frozenset[str]:
    """Return the families of rows in which a term has columns or changes the signals."""
    altered = getattr(term, "alters", FAMILIES) if changes_rows(term) else ()
    return frozenset((*altered, *(c.family for c in term.coefficients(rig))))


def acting_on(rig: Rig, terms: Iterable[Used], family: str, cache: RowCache) -> tuple[Used, ...]:
    """Return the terms that have columns in a family's rows or change their signals."""
    terms = tuple(terms)
    for used in terms:
        if used.term not in cache.families:
            cache.families[used.term] = families_of(rig, used.term)
    return tuple(u for u in terms if family in cache.families[u.term])


def model_rows(rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord) -> dict[str, Rows]:
    """Return the rows of one record under a model (see `analysis.regression.rows.record_rows`)."""
    if conditioned.repeats:
        return mean_rows([model_rows(rig, terms, repeat) for repeat in conditioned.repeats])
    return record_rows(
        rig, ordered(terms), conditioned.signals, conditioned.filtering, conditioned.families
    )


def prepared_signals(rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord) -> Signals:
    """Return the signals of a record as changed by the terms of a model (`Term.prepare`)."""
    signals = conditioned.signals
    for used in ordered(terms):
        signals = used.term.prepare(rig, signals, used.shape)
    return signals


def filtered(
    columns: Mapping[str, Array], conditioned: ConditionedRecord, rows: Rows
) -> dict[str, Array]:
    """Filter point-by-point columns (n,) as `rows` were, at the instants of `rows`."""
    return _at_rows(conditioned, low_passed(columns, conditioned.filtering), rows)


def _at_rows(
    conditioned: ConditionedRecord, columns: Mapping[str, Array], rows: Rows
) -> dict[str, Array]:
    """Return filtered columns at the instants (m,) of rows, without the sines that these lack."""
    at = places_of(rows, conditioned.signals, conditioned.filtering)
    sines = sines_at(rows, conditioned.signals, conditioned.filtering)
    return {name: without_sines(column[at], sines) for name, column in columns.items()}


def shared_rows(
    rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord, cache: RowCache
) -> dict[str, Rows]:
    """Return a record's rows under the terms that no lock hides; models share parts in `cache`.

    The columns of an effect that changes no signal are filtered separately and appended to the rows
    of the other terms.
    """
    if conditioned.repeats:
        alike = (replace(r, families=conditioned.families) for r in conditioned.repeats)
        return mean_rows([shared_rows(rig, terms, repeat, cache) for repeat in alike])
    visible = [u for u in terms if not is_hidden_by_lock(u.term, conditioned)]
    out: dict[str, Rows] = {}
    for family in conditioned.families:
        acting = acting_on(rig, visible, family, cache)
        appended = [u for u in acting if isinstance(u.term, Effect) and not changes_rows(u.term)]
        others = tuple(u for u in acting if u not in appended)
        one_family = replace(conditioned, families=(family,))
        key = conditioned.key, family, others
        # Signals depend only on the terms that change them, so that families of rows share them.
        changing = tuple(u for u in others if type(u.term).prepare is not Term.prepare)
        prepared = partial(
            cache.signals.get,
            (conditioned.key, changing),
            partial(prepared_signals, rig, changing, one_family),
        )
        common: dict[str, Rows] = cache.rows.get(
            key, partial(_rows_of_family, rig, others, one_family, prepared, cache)
        )
        rows = common
        for u in appended:
            further = cache.rows.get(
                (*key, u), partial(added_columns, rig, one_family, prepared, common, u, cache)
            )
            rows = {e: _with_columns(r, further.get(e, {})) for e, r in rows.items()}
        out |= rows
    return out


def _rows_of_family(
    rig: Rig, terms: Sequence[Used], conditioned: ConditionedRecord,
    prepared: Callable[[], Signals], cache: RowCache,
) -> dict[str, Rows]:  # fmt: skip
    """Return the rows of a record of one family under `terms`, from the signals `prepared`."""
    (family,), filtering = conditioned.families, conditioned.filtering
    terms, signals = ordered(terms), prepared()
    parts = [_term_part(rig, u, conditioned, family, signals, cache) for u in terms]
    key = conditioned.key, family
    sides = cache.parts.get(key, signals, lambda x: right_parts(rig, x, filtering, family))
    return assembled(parameters_of(rig, terms, family), parts, sides, filtering)


def _term_part(
    rig: Rig, used: Used, conditioned: ConditionedRecord, family: str, signals: Signals,
    cache: RowCache,
) -> TermPart:  # fmt: skip
    key, filtering = (conditioned.key, family, used), conditioned.filtering
    part: TermPart = cache.parts.get(
        key, signals, lambda x: term_part(rig, used, x, filtering, family, conditioned.signals)
    )
    return part


def added_columns(
    rig: Rig, conditioned: ConditionedRecord, prepared: Callable[[], Signals],
    rows: Mapping[str, Rows], used: Used, cache: RowCache,
) -> dict[str, dict[str, Array]]:  # fmt: skip
    """Return the columns of a term that changes no signal: equation -> parameter -> column (m,)."""
    out: dict[str, dict[str, Array]] = {}
    for family in conditioned.families:
        part = _term_part(rig, used, conditioned, family, prepared(), cache)
        for name, columns in part.columns.items():
            if name in rows and any(np.any(v) for v in columns.values()):
                out[name] = _at_rows(conditioned, columns, rows[name])
    return {name: out[name] for name in rows if name in out}


def _with_columns(rows: Rows, columns: Mapping[str, Array]) -> Rows:
    """Return rows with appended columns (m,) of further parameters."""
    if not columns:
        return rows
    matrix = np.column_stack([rows.matrix, *columns.values()])
    return replace(rows, names=(*rows.names, *columns), matrix=matrix)


def row_residual(rows: Rows, beta: Mapping[str, float]) -> Array:
    """Return y - X beta (m,), coefficients that `beta` lacks being zero."""
    vector = np.array([beta.get(name, 0.0) for name in rows.names])
    return np.asarray(rows.rhs - rows.matrix @ vector)
