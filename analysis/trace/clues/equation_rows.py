"""One equation's rows of a set of records, and fits of columns to their residual."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.regression.conditioned import ConditionedRecord
from analysis.regression.least_squares import shortest
from analysis.regression.rows import Rows
from analysis.signals.conditioning import Signals
from analysis.trace.data.conditioned_record import filtered, prepared_signals
from analysis.trace.data.regression_data import RegressionData
from analysis.trace.search.linear_fit import orthonormal

Array = NDArray[np.float64]


@dataclass(frozen=True)
class EquationPart:
    """A record's rows of one equation, signals as the model's terms see them, whitening weight."""

    conditioned: ConditionedRecord
    rows: Rows
    signals: Signals
    weight: float


@dataclass(frozen=True)
class EquationRows:
    """The rows of one equation in a set of records.

    `residual` (m,) is whitened and orthogonal to the model's orthonormal `base` (m, r).
    """

    parts: tuple[EquationPart, ...]
    residual: Array
    base: Array


def equation_rows(data: RegressionData, residual: Array, equation: str) -> EquationRows | None:
    """Return the rows of an equation with its `residual` (M,), None where it has no rows."""
    parts, rest, base = [], [], []
    for s in data.segments:
        if s.equation != equation:
            continue
        conditioned, rows = data.source(s)
        signals = prepared_signals(data.rig, data.terms, conditioned)
        weight = float(np.sqrt(s.repeats)) / s.noise
        parts.append(EquationPart(conditioned, rows, signals, weight))
        rest.append(residual[s.where])
        base.append(data.base[s.where])
    if not parts:
        return None
    B = orthonormal(np.concatenate(base))
    r = np.concatenate(rest)
    return EquationRows(tuple(parts), r - B @ (B.T @ r), B)


def whitened_columns(side: EquationRows, made: Sequence[Array]) -> Array:
    """Return columns (m, k): filtered like the rows, whitened, orthogonal to the model's own.

    `made` holds the unfiltered columns (n, k) of each part.
    """
    stack = []
    for part, columns in zip(side.parts, made, strict=True):
        named = {str(k): columns[:, k] for k in range(columns.shape[1])}
        clue_columns = filtered(named, part.conditioned, part.rows)
        stack.append(np.column_stack(list(clue_columns.values())) * part.weight)
    D = np.concatenate(stack)
    return np.asarray(D - side.base @ (side.base.T @ D))


def fitted_coefficients(columns: Array, side: EquationRows) -> Array:
    """Return the least-squares coefficients (k,) of columns (m, k) for a residual."""
    return shortest(columns, side.residual, 1e-2)


def explained_share(
    fitted: Array, side: EquationRows, judging: Array, other: EquationRows
) -> float:
    """Return the share of energy above noise in `other` that columns fitted to `side` remove.

    `fitted` and `judging` are the same columns on either rows.
    """
    curve = fitted_coefficients(fitted, side)
    q = other.residual
    before = float(q @ q) - len(q)
    after = float(np.sum((q - judging @ curve) ** 2)) - len(q)
    return min(1.0, (before - after) / before) if before > 0 else 0.0
